"""Closest points of a vertex and a triangle and of two edges, in double precision."""

# Warp's functions are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false
from __future__ import annotations

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.threads import argument, run

wp.set_module_options(KERNELS)

PARALLEL = wp.constant(wp.float64(1.0e-20))
"""Squared sine below which a triangle counts as its sides, and two edges as parallel."""


@wp.func
def along(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """Parameter in [0, 1] of the point closest to p on the edge from a to b."""
    side = b - a
    length = wp.dot(side, side)
    if length <= wp.float64(0.0):
        return wp.float64(0.0)
    return wp.clamp(wp.dot(p - a, side) / length, wp.float64(0.0), wp.float64(1.0))


@wp.func
def weights_on_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Weights of p and the corners in the vector from a triangle's closest point to p; the weights sum to 0."""
    zero, one = wp.float64(0.0), wp.float64(1.0)
    first, second, to_p = b - a, c - a, p - a
    normal = wp.cross(first, second)
    size = wp.dot(normal, normal)
    if size > PARALLEL * wp.dot(first, first) * wp.dot(second, second):
        # Inside all three sides the foot of the perpendicular is the closest point.
        v, w = wp.dot(wp.cross(to_p, second), normal), wp.dot(wp.cross(first, to_p), normal)
        if v >= zero and w >= zero and v + w <= size:
            return wp.vec4d(one, (v + w) / size - one, -v / size, -w / size)
    r, s, t = along(p, a, b), along(p, b, c), along(p, c, a)
    to_ab, to_bc, to_ca = p - a - r * (b - a), p - b - s * (c - b), p - c - t * (a - c)
    ab, bc, ca = wp.dot(to_ab, to_ab), wp.dot(to_bc, to_bc), wp.dot(to_ca, to_ca)
    if ab <= bc and ab <= ca:
        return wp.vec4d(one, r - one, -r, zero)
    if bc <= ca:
        return wp.vec4d(one, zero, s - one, -s)
    return wp.vec4d(one, -t, zero, t - one)


@wp.func
def weights_of_edges(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Weights of the ends in the shortest vector from the edge c-d to the edge a-b; the weights sum to 0."""
    zero, one = wp.float64(0.0), wp.float64(1.0)
    first, second, c_to_a = b - a, d - c, a - c
    aa, cc, ac = wp.dot(first, first), wp.dot(second, second), wp.dot(first, second)
    wa, wc = wp.dot(c_to_a, first), wp.dot(c_to_a, second)
    size = aa * cc - ac * ac
    best = wp.vec4d(one, zero, zero, zero)
    least = wp.float64(1.0e300)
    if size > PARALLEL * aa * cc:
        s, t = (ac * wc - wa * cc) / size, (aa * wc - ac * wa) / size
        if s >= zero and s <= one and t >= zero and t <= one:
            # Of edges that are all but parallel rounding decides where: an end may be nearer.
            best = wp.vec4d(one - s, s, t - one, -t)
            gap = c_to_a + s * first - t * second
            least = wp.dot(gap, gap)
    for end in range(4):
        # One edge's end, and the closest point of the other edge.
        from_first = end < 2
        p = wp.where(end == 0, a, wp.where(end == 1, b, wp.where(end == 2, c, d)))
        near, far = wp.where(from_first, c, a), wp.where(from_first, d, b)
        t = along(p, near, far)
        from_end = p - near - t * (far - near)
        if wp.dot(from_end, from_end) < least:
            least = wp.dot(from_end, from_end)
            last = wp.float64(end % 2)
            if from_first:
                best = wp.vec4d(one - last, last, t - one, -t)
            else:
                best = wp.vec4d(one - t, t, last - one, -last)
    return best


@wp.func
def weights_of(face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Weights in the shortest vector from triangle b, c, d to vertex a, or from edge c-d to edge a-b."""
    if face:
        return weights_on_triangle(a, b, c, d)
    return weights_of_edges(a, b, c, d)


@wp.kernel
def _closest(
    first: wp.int32,
    x: wp.array(dtype=wp.vec3d),
    corners: wp.array(dtype=wp.vec4i),
    face: wp.array(dtype=wp.bool),
    weight: wp.array(dtype=wp.vec4d),
):
    i = first + wp.tid()
    c = corners[i]
    weight[i] = weights_of(face[i], x[c[0]], x[c[1]], x[c[2]], x[c[3]])


def weights(
    x: Float[Tensor, "vertices 3"], corners: Int[Tensor, "pairs 4"], face: Bool[Tensor, " pairs"], *, threads: int = 1
) -> Float[Tensor, "pairs 4"]:
    """Weights of corners in the shortest vector from each pair's second part to its first, as `NearSprings`.

    Args:
        x: Positions [m], float64.
        corners: A vertex and the corners of a face, or the ends of two edges, int32.
        face: True for a vertex and a face.
        threads: Most threads on the CPU.
    """
    out = torch.zeros((len(face), 4), dtype=torch.float64, device=x.device)
    inputs = [argument(x.contiguous(), wp.vec3d), argument(corners, wp.vec4i)]
    inputs += [argument(face), argument(out, wp.vec4d)]
    run(_closest, len(out), inputs, device=str(x.device), threads=threads)
    return out
