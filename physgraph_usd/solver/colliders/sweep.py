"""How often points pass through the faces of a mesh while both move from one pose to the next.

Points and corners move straight and evenly. A point p is in the plane of a triangle (a, b, c) where
f(s) = ((b - a) x (c - a)) . (p - a) vanishes, a cubic in time s; each root with p inside the triangle is a passage
(Provot 1997). Roots are bracketed on `KNOTS` equal steps of the way and bisected.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false
# pyright: reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int

from ..mesh.kernels import KERNELS
from ..mesh.threads import Launch
from .pose import ShapePose
from .primitives import ShapeSurface

wp.set_module_options(KERNELS)

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


class Sweep:
    """Counts passages of points through one mesh in motion; its hierarchy is built once and refitted."""

    def __init__(self, triangles: Int[np.ndarray, "triangles 3"], *, device: str = "cpu", threads: int = 1) -> None:
        """Take a topology.

        Args:
            triangles: Corners.
            device: "cpu" or a CUDA device.
            threads: Most threads that it uses on the CPU.
        """
        self._triangles, self._device, self._threads = triangles, device, threads
        self._boxes: tuple[wp.array, ...] = ()

    def passages(
        self,
        before: Float[np.ndarray, "vertices 3"],
        after: Float[np.ndarray, "vertices 3"],
        *,
        start: Float[np.ndarray, "points 3"],
        end: Float[np.ndarray, "points 3"],
    ) -> tuple[Int[np.ndarray, " points"], Bool[np.ndarray, " points"]]:
        """Count passages of points through the mesh, both moving from one pose to the next.

        Args:
            before: Mesh positions at the first pose [m].
            after: At the second.
            start: Points at the first [m].
            end: At the second.

        Returns:
            How often: odd where a point ends on the other side of the surface; and whether the faces that it passes
            look away from one another: it comes out at the other side of a body.
        """
        if not len(self._triangles) or not len(start):
            return np.zeros(len(start), np.int32), np.zeros(len(start), bool)
        corners = before[self._triangles].reshape(-1, 3)
        middle, nudge = corners.mean(axis=0), NUDGE * max(np.ptp(corners[:, axis]) for axis in range(3))
        poses = [
            np.ascontiguousarray(each - middle, np.float32) for each in (before, after, start + nudge, end + nudge)
        ]
        self._take(*poses[:2])
        count = wp.zeros(len(start), dtype=wp.int32, device=self._device)
        arrays = [wp.array(each, dtype=wp.vec3f, device=self._device) for each in poses]
        total = wp.zeros(len(start), dtype=wp.vec3f, device=self._device)
        inputs = [self._tree.id, self._faces, *arrays, count, total]
        Launch(_count, len(start), inputs, device=self._device, threads=self._threads)({})
        # Of two unit normals the sum's square is 2 + 2 cos.
        found, length = count.numpy(), np.square(total.numpy()).sum(axis=1)
        return found, length < (1.0 - OPPOSED) * found

    def _take(self, before: np.ndarray, after: np.ndarray) -> None:
        """Put each face between both poses into the hierarchy; those that are not finite pass nothing."""
        corners = [pose[self._triangles[:, corner]] for pose in (before, after) for corner in range(3)]
        boxes = [each.reduce(corners) for each in (np.minimum, np.maximum)]
        whole = np.isfinite(boxes[0] + boxes[1])
        arrays = [wp.array(np.where(whole, box, 0.0), dtype=wp.vec3f, device=self._device) for box in boxes]
        if not self._boxes:
            self._faces = wp.array(np.ascontiguousarray(self._triangles, np.int32), dtype=wp.vec3i, device=self._device)
            self._boxes = tuple(arrays)
            self._tree = wp.Bvh(*self._boxes)
            return
        for box, array in zip(self._boxes, arrays, strict=True):
            wp.copy(box, array)
        self._tree.refit()


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
