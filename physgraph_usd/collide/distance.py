"""Closest points of a point and a triangle and of two edges, in double precision."""

# Warp's functions are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportIndexIssue=false
from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

FLAT = wp.constant(wp.float64(1.0e-20))
"""Squared sine under which a triangle counts as its sides, and two edges as parallel."""


@wp.func
def along(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """Where on the edge from a to b the point closest to p lies, in [0, 1]."""
    side = b - a
    length = wp.dot(side, side)
    if length <= wp.float64(0.0):
        return wp.float64(0.0)
    return wp.clamp(wp.dot(p - a, side) / length, wp.float64(0.0), wp.float64(1.0))


@wp.func
def to_edge(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """Way to p from the closest point of an edge."""
    return p - a - along(p, a, b) * (b - a)


@wp.func
def shorter(u: wp.vec3d, v: wp.vec3d):
    """The shorter one of two vectors."""
    return wp.where(wp.dot(v, v) < wp.dot(u, u), v, u)


@wp.func
def to_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Way to a point from the closest point of a triangle."""
    first, second, way = b - a, c - a, p - a
    normal = wp.cross(first, second)
    size = wp.dot(normal, normal)
    if size > FLAT * wp.dot(first, first) * wp.dot(second, second):
        # Inside all three sides the foot of the perpendicular is the closest point.
        v = wp.dot(wp.cross(way, second), normal)
        w = wp.dot(wp.cross(first, way), normal)
        if v >= wp.float64(0.0) and w >= wp.float64(0.0) and v + w <= size:
            return wp.dot(way, normal) / size * normal
    return shorter(shorter(to_edge(p, a, b), to_edge(p, b, c)), to_edge(p, c, a))


@wp.func
def between_edges(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Shortest way from the edge c-d to the edge a-b."""
    first, second, way = b - a, d - c, a - c
    aa, cc, ac = wp.dot(first, first), wp.dot(second, second), wp.dot(first, second)
    wa, wc = wp.dot(way, first), wp.dot(way, second)
    size = aa * cc - ac * ac
    if size > FLAT * aa * cc:
        s = (ac * wc - wa * cc) / size
        t = (aa * wc - ac * wa) / size
        zero, one = wp.float64(0.0), wp.float64(1.0)
        if s >= zero and s <= one and t >= zero and t <= one:
            return way + s * first - t * second
    best = shorter(to_edge(a, c, d), to_edge(b, c, d))
    return shorter(best, shorter(-to_edge(c, a, b), -to_edge(d, a, b)))
