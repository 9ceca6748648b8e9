"""Which pairs a plane keeps apart on straight paths.

Theorem. Let two sets of points A and B move on straight lines, all in the same time. If for one direction n

    max over B of n.x  <  min over A of n.x

at the start and at the end, then so at every time between, for n.(a - b) is linear in time.

Asked of a vertex and a triangle, or of two edges, for three directions: the shortest way between them at the start,
that at the end, and their mean.
"""

# Warp's functions are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

import warp as wp

from ..mesh.kernels import KERNELS
from .distance import weights_of

wp.set_module_options(KERNELS)

TIGHT = 0.9
"""Part of its distance that a pair keeps which is nearer than the floor already, and of the way there that it goes."""

LEAST = wp.constant(wp.float64(1.0 / 16.0))
"""Least part of the way for which a plane is asked."""


@wp.func
def between(face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """The shortest way to the vertex a from the triangle b, c, d, or to the edge a-b from the edge c-d."""
    weight = weights_of(face, a, b, c, d)
    return weight[0] * a + weight[1] * b + weight[2] * c + weight[3] * d


@wp.func
def distance_of(face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Distance of the vertex a from the triangle b, c, d, or of the edges a-b and c-d."""
    return wp.length(between(face, a, b, c, d))


@wp.func
def gap_along(n: wp.vec3d, face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """How far the first part lies beyond the second along a direction; negative where their extents overlap."""
    p, q, r, s = wp.dot(n, a), wp.dot(n, b), wp.dot(n, c), wp.dot(n, d)
    if face:
        return p - wp.max(q, wp.max(r, s))
    return wp.min(p, q) - wp.max(r, s)


@wp.func
def kept_of(distance: wp.float64, floor: wp.float64):
    """The gap that a pair of parts keeps: a floor, or most of its distance where that is less."""
    return wp.min(wp.float64(TIGHT) * distance, floor)


@wp.func
def part_kept(
    face: wp.bool,
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    d: wp.vec3d,
    e: wp.vec3d,
    f: wp.vec3d,
    g: wp.vec3d,
    h: wp.vec3d,
    floor: wp.float64,
):
    """Part of the straight ways from the corners a, b, c, d to e, f, g, h on which a plane keeps the parts apart.

    It is 1 where one keeps them all the way. Along the direction at the start the gap is a concave function of the part
    gone, so up to the part returned it is as much as is kept.
    """
    one = wp.float64(1.0)
    way = between(face, a, b, c, d)
    distance = wp.length(way)
    keep = kept_of(distance, floor)
    first = way / distance
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
def impact_of(
    face: wp.bool,
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    d: wp.vec3d,
    u: wp.vec3d,
    v: wp.vec3d,
    p: wp.vec3d,
    q: wp.vec3d,
    floor: wp.float64,
):
    """Part of their ways u, v, p, q that the corners a, b, c, d can go, in (0, 1]; 1 where the parts touch already.

    Where no plane keeps the parts apart all the way, it may turn: at halves of the way, quarters and so on.
    """
    one, zero = wp.float64(1.0), a - a
    # About their first corner: far from the origin differences lose no digits.
    b, c, d, v, p, q = b - a, c - a, d - a, v - u, p - u, q - u
    if distance_of(face, zero, b, c, d) <= wp.float64(0.0):
        return one
    time, step = wp.float64(0.0), wp.float64(1.0)
    while time < one:
        end = time + step
        i, j, k = b + time * v, c + time * p, d + time * q
        part = part_kept(face, zero, i, j, k, zero, b + end * v, c + end * p, d + end * q, floor)
        if part == one:
            time = end
        elif step <= LEAST:
            return time + part * step
        else:
            step *= wp.float64(0.5)
    return one
