"""Decides whether an edge passes through a triangle, consistently for all pairs with a common edge or side."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportIndexIssue=false
from __future__ import annotations

import warp as wp


@wp.func
def volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Six times the signed volume of a tetrahedron."""
    return wp.dot(b - a, wp.cross(c - a, d - a))


@wp.func
def wide(v: wp.vec3f):
    """A vector in double precision."""
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def turns_left(x: wp.array(dtype=wp.vec3f), e: wp.vec2i, p: wp.int32, q: wp.int32):
    """Whether the line from p to q passes an edge on its left; consistent for the two faces at a side."""
    low, high = wp.min(p, q), wp.max(p, q)
    left = volume(wide(x[e[0]]), wide(x[e[1]]), wide(x[low]), wide(x[high])) >= wp.float64(0.0)
    return left == (p < q)


@wp.func
def passes_through(x: wp.array(dtype=wp.vec3f), e: wp.vec2i, t: wp.vec3i):
    """Whether an edge passes through a triangle; an end in the plane does not count, a side belongs to one face.

    An end at a corner does not count: sewn cloth touches there, and rounding would decide the side.
    """
    for i in range(3):
        if x[e[0]] == x[t[i]] or x[e[1]] == x[t[i]]:
            return False
    p, q, r = wide(x[t[0]]), wide(x[t[1]]), wide(x[t[2]])
    if volume(p, q, r, wide(x[e[0]])) * volume(p, q, r, wide(x[e[1]])) >= wp.float64(0.0):
        return False
    first = turns_left(x, e, t[0], t[1])
    return turns_left(x, e, t[1], t[2]) == first and turns_left(x, e, t[2], t[0]) == first
