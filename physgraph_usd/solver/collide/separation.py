"""Pairs kept apart by a plane on straight paths.

Theorem. Let two sets of points A and B move on straight lines, all in the same time. If for one direction n

    max over B of n.x  <  min over A of n.x

at the start and at the end, then so at every time between, for n.(a - b) is linear in time.

Tested for a vertex and a triangle, or for two edges, with three directions: the shortest vector between them at the
start, the shortest vector at the end, and the mean of both.
"""

# Warp's functions are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

import warp as wp

from ..mesh.kernels import KERNELS
from .distance import weights_of

wp.set_module_options(KERNELS)

TIGHT = 0.9
"""Fraction of the present distance to keep for pairs below the floor, and used fraction of the safe path."""

TOUCHES = 1e-12
"""Distance up to which parts touch [m]: nearer, double precision does not tell the side."""

LEAST_TIME = wp.constant(wp.float64(1.0 / 16.0))
"""Least fraction of the path for which a plane is tried."""


@wp.func
def between(face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Shortest vector to the vertex a from the triangle b, c, d, or to the edge a-b from the edge c-d."""
    weight = weights_of(face, a, b, c, d)
    return weight[0] * a + weight[1] * b + weight[2] * c + weight[3] * d


@wp.func
def distance_of(face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Distance of the vertex a from the triangle b, c, d, or of the edges a-b and c-d."""
    return wp.length(between(face, a, b, c, d))


@wp.func
def gap_along(n: wp.vec3d, face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Gap of the first part beyond the second along a direction; negative if their extents overlap."""
    p, q, r, s = wp.dot(n, a), wp.dot(n, b), wp.dot(n, c), wp.dot(n, d)
    if face:
        return p - wp.max(q, wp.max(r, s))
    return wp.min(p, q) - wp.max(r, s)


@wp.func
def required_gap(distance: wp.float64, floor: wp.float64):
    """Gap required between a pair of parts: the floor, or most of the pair's distance if less."""
    return wp.min(wp.float64(TIGHT) * distance, floor)


@wp.func
def separated_fraction(
    face: wp.bool,
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    d: wp.vec3d,
    e: wp.vec3d,
    f: wp.vec3d,
    g: wp.vec3d,
    h: wp.vec3d,
    keep: wp.float64,
):
    """Fraction of the straight paths from the corners a, b, c, d to e, f, g, h on which a plane keeps a gap.

    The fraction is 1 if a plane does all the way. Along the start direction the gap is a concave function of the path
    fraction, so the gap is kept up to the returned fraction.
    """
    one = wp.float64(1.0)
    vector = between(face, a, b, c, d)
    distance = wp.length(vector)
    first = vector / distance
    gap = gap_along(first, face, e, f, g, h)
    if gap >= keep:
        return one
    last = wp.normalize(between(face, e, f, g, h))
    if gap_along(last, face, a, b, c, d) >= keep and gap_along(last, face, e, f, g, h) >= keep:
        return one
    mean = wp.normalize(first + last)
    if gap_along(mean, face, a, b, c, d) >= keep and gap_along(mean, face, e, f, g, h) >= keep:
        return one
    return wp.float64(TIGHT) * (distance - keep) / (distance - gap)


@wp.func
def safe_fraction(
    face: wp.bool, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d, v: wp.vec3d, p: wp.vec3d, q: wp.vec3d, floor: wp.float64
):
    """Fraction of their paths v, p, q that the corners b, c, d can move, in (0, 1]; 1 if the parts touch already.

    Positions and paths are relative to the first corner's: far from the origin differences lose no digits. If no plane
    keeps the parts apart all the way, the plane may change at halves of the path, quarters and so on.
    """
    one, zero = wp.float64(1.0), wp.vec3d()
    distance = distance_of(face, zero, b, c, d)
    if distance <= wp.float64(TOUCHES):
        return one
    keep = required_gap(distance, floor)
    time, step = wp.float64(0.0), wp.float64(1.0)
    while time < one:
        end = time + step
        i, j, k = b + time * v, c + time * p, d + time * q
        part = separated_fraction(face, zero, i, j, k, zero, b + end * v, c + end * p, d + end * q, keep)
        if part == one:
            time = end
        elif step <= LEAST_TIME:
            return time + part * step
        else:
            step *= wp.float64(0.5)
    return one
