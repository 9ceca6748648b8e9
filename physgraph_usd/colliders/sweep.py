"""How often points pass through the faces of a mesh while both move from one pose to the next.

Points and corners move straight and evenly. A point p is in the plane of a triangle (a, b, c) where
f(s) = ((b - a) x (c - a)) . (p - a) vanishes, a cubic in time s; each root with p inside the triangle is a passage
(Provot 1997). Roots are bracketed on `KNOTS` equal steps of the way and bisected.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false
# pyright: reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

import numpy as np
import torch
import warp as wp

from ..mesh.lanes import Launch
from .pose import ShapePose
from .primitives import ShapeSurface

wp.set_module_options({"enable_backward": False})

KNOTS = wp.constant(8)
BISECTIONS = wp.constant(20)
NUDGE = 1e-5 * np.array([0.612, 0.354, 0.707])
"""Shift of the points, in sizes of the mesh, so that none passes exactly through an edge or a vertex."""

OPPOSED = 0.1
"""Two faces look away from one another when the cosine between their normals is under minus this: a point that slides
over a sharp edge of a body goes out at a right angle to where it came in."""
THIRDS = 60
"""How often a way is shortened by a third to find where it is deepest."""


@wp.func
def _side(a: wp.vec3f, b: wp.vec3f, c: wp.vec3f, p: wp.vec3f):
    return wp.dot(wp.cross(b - a, c - a), p - a)


@wp.func
def _is_over(a: wp.vec3f, b: wp.vec3f, c: wp.vec3f, p: wp.vec3f):
    normal = wp.cross(b - a, c - a)
    u = wp.dot(wp.cross(b - a, p - a), normal)
    v = wp.dot(wp.cross(c - b, p - b), normal)
    w = wp.dot(wp.cross(a - c, p - c), normal)
    return u > 0.0 and v > 0.0 and w > 0.0


@wp.func
def _at(before: wp.vec3f, after: wp.vec3f, s: wp.float32):
    return before + s * (after - before)


@wp.kernel
def _count(
    first: wp.int32,
    tree: wp.uint64,
    corners: wp.array(dtype=wp.vec3i),
    before: wp.array(dtype=wp.vec3f),
    after: wp.array(dtype=wp.vec3f),
    start: wp.array(dtype=wp.vec3f),
    end: wp.array(dtype=wp.vec3f),
    count: wp.array(dtype=wp.int32),
    total: wp.array(dtype=wp.vec3f),
):
    i = first + wp.tid()
    query = wp.bvh_query_aabb(tree, wp.min(start[i], end[i]), wp.max(start[i], end[i]))
    face = wp.int32(0)
    found = wp.int32(0)
    normals = wp.vec3f(0.0)
    while wp.bvh_query_next(query, face):
        ids = corners[face]
        a0, b0, c0 = before[ids[0]], before[ids[1]], before[ids[2]]
        a1, b1, c1 = after[ids[0]], after[ids[1]], after[ids[2]]
        last = _side(a0, b0, c0, start[i])
        for knot in range(KNOTS):
            low = wp.float32(knot) / wp.float32(KNOTS)
            high = wp.float32(knot + 1) / wp.float32(KNOTS)
            here = _side(_at(a0, a1, high), _at(b0, b1, high), _at(c0, c1, high), _at(start[i], end[i], high))
            if (last < 0.0) != (here < 0.0):
                for _ in range(BISECTIONS):
                    s = 0.5 * (low + high)
                    mid = _side(_at(a0, a1, s), _at(b0, b1, s), _at(c0, c1, s), _at(start[i], end[i], s))
                    if (mid < 0.0) == (last < 0.0):
                        low = s
                    else:
                        high = s
                point = _at(start[i], end[i], high)
                a, b, c = _at(a0, a1, high), _at(b0, b1, high), _at(c0, c1, high)
                if _is_over(a, b, c, point):
                    found += 1
                    normals += wp.normalize(wp.cross(b - a, c - a))
            last = here
    count[i] = found
    total[i] = normals


def passages(
    triangles: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    *,
    start: np.ndarray,
    end: np.ndarray,
    device: str = "cpu",
    lanes: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Count passages of points through a moving mesh.

    Args:
        triangles: Corners, shape (T, 3).
        before: Mesh positions at the first pose [m], shape (V, 3).
        after: At the second, shape (V, 3).
        start: Points at the first [m], shape (N, 3).
        end: At the second, shape (N, 3).
        device: "cpu" or a CUDA device.
        lanes: Most threads that it uses on the CPU.

    Returns:
        How often, shape (N,), int32: odd where a point ends on the other side of the surface; and whether the faces
        that it passes look away from one another, shape (N,), bool: it comes out at the other side of a body.
    """
    nowhere = np.zeros(len(start), np.int32), np.zeros(len(start), bool)
    if not len(triangles) or not len(start):
        return nowhere
    corners = before[triangles]
    middle, nudge = corners.mean(axis=(0, 1)), NUDGE * np.ptp(corners, axis=(0, 1)).max()
    poses = [np.ascontiguousarray(each - middle, np.float32) for each in (before, after, start + nudge, end + nudge)]
    both = np.concatenate([poses[0][triangles], poses[1][triangles]], axis=1)
    low, high = both.min(axis=1), both.max(axis=1)
    ways = np.concatenate(poses[2:])
    near = ((low <= ways.max(axis=0)) & (high >= ways.min(axis=0))).all(axis=1)
    if not near.any():
        return nowhere
    tree = wp.Bvh(*(wp.array(corner[near], dtype=wp.vec3f, device=device) for corner in (low, high)))
    faces = wp.array(np.ascontiguousarray(triangles[near], np.int32), dtype=wp.vec3i, device=device)
    count = wp.zeros(len(start), dtype=wp.int32, device=device)
    arrays = [wp.array(each, dtype=wp.vec3f, device=device) for each in poses]
    total = wp.zeros(len(start), dtype=wp.vec3f, device=device)
    Launch(_count, len(start), [tree.id, faces, *arrays, count, total], device=device, lanes=lanes)({})
    # Of two unit normals the sum's square is 2 + 2 cos.
    found, length = count.numpy(), np.square(total.numpy()).sum(axis=1)
    return found, length < (1.0 - OPPOSED) * found


def through_shape(before: ShapePose, after: ShapePose, *, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Which points come in and out again at the other side of a primitive, both moving from one pose to the next.

    In the primitive's own axes a point moves straight and evenly. Distances to a convex shape are convex along its way,
    so the least is found by leaving out a third again and again.

    Args:
        before: The first pose.
        after: The second, of the same kind; its size is taken for both.
        start: Points at the first [m], shape (N, 3).
        end: At the second, shape (N, 3).

    Returns:
        Shape (N,), bool.
    """
    surface = ShapeSurface(after)
    ways = [torch.as_tensor((each - pose.centre) @ pose.turn) for each, pose in ((start, before), (end, after))]
    turn = torch.as_tensor(after.turn)

    def signed(part: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x = torch.lerp(*ways, part.unsqueeze(1)) @ turn.T
        found = surface.closest(x, torch.full_like(part, float("inf")))
        return found.distance * found.side, found.normal

    low, high = (torch.full((len(start),), each, dtype=torch.float64) for each in (0.0, 1.0))
    first, last = signed(low), signed(high)
    for _ in range(THIRDS):
        third = (high - low) / 3.0
        falls = signed(low + third)[0] > signed(high - third)[0]
        low, high = torch.where(falls, low + third, low), torch.where(falls, high, high - third)
    within = signed(0.5 * (low + high))[0] < 0
    opposed = (first[1] * last[1]).sum(dim=1) < -OPPOSED
    return (within & (first[0] > 0) & (last[0] > 0) & opposed).numpy()
