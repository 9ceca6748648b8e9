"""Decides whether an edge passes through a triangle, consistently for all pairs with a common edge or side."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
from __future__ import annotations

import warp as wp

ROUNDING = wp.constant(wp.float64(2.4e-7))
"""Rounding of positions to single precision, as a fraction of their distance from the origin."""


@wp.func
def wide(v: wp.vec3f):
    """A vector in double precision."""
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Six times the signed volume of a tetrahedron."""
    return wp.dot(b - a, wp.cross(c - a, d - a))


@wp.func
def turns_left(a: wp.vec3d, b: wp.vec3d, i: wp.int32, p: wp.vec3d, j: wp.int32, q: wp.vec3d):
    """Whether the line from vertex i at p to j at q passes the edge a-b on its left; one of two faces says True."""
    if i < j:
        return volume(a, b, p, q) >= wp.float64(0.0)
    return volume(a, b, q, p) < wp.float64(0.0)


@wp.func
def passes_through(a: wp.vec3d, b: wp.vec3d, t: wp.vec3i, p: wp.vec3d, q: wp.vec3d, r: wp.vec3d):
    """Whether the edge a-b passes through the triangle p, q, r with the vertices t.

    An end in the plane does not; a side belongs to one of its two faces. An edge within single-precision rounding of
    the plane counts as in the plane: parts of one flat face do not cross.
    """
    near, far = volume(p, q, r, a), volume(p, q, r, b)
    if near * far >= wp.float64(0.0):
        return False
    size = wp.max(wp.max(wp.abs(p), wp.abs(q)), wp.max(wp.abs(a), wp.abs(b)))
    rounding = ROUNDING * wp.max(size[0], wp.max(size[1], size[2])) * wp.length(wp.cross(q - p, r - p))
    if wp.abs(near) <= rounding and wp.abs(far) <= rounding:
        return False
    first = turns_left(a, b, t[0], p, t[1], q)
    return turns_left(a, b, t[1], q, t[2], r) == first and turns_left(a, b, t[2], r, t[0], p) == first
