"""When two moving parts come as near as they may: additive continuous detection (Li, Kaufman and Jiang 2021).

A point and a triangle, or two edges, move along straight lines. Their distance falls no faster than their relative
motion, so from distance d they may move on for (d - keep) / motion before they are ``keep`` apart. Such steps are added
up; each sum is safe, however rounded the rest.
"""

# Warp's functions are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

import warp as wp

from ..mesh.kernels import KERNELS
from .distance import weights_of

wp.set_module_options(KERNELS)

TIGHT = 0.9
"""Part of a distance under the floor that pairs keep."""
NEAR = wp.constant(wp.float64(1.0e-3))
"""Part of what is to be kept within which the way there is at its end."""
STEPS = wp.constant(256)
"""Most steps; the sum of fewer than it takes is safe, too."""


@wp.func
def distance_of(face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Distance of the vertex a from the triangle b, c, d, or of the edges a-b and c-d."""
    weight = weights_of(face, a, b, c, d)
    return wp.length(weight[0] * a + weight[1] * b + weight[2] * c + weight[3] * d)


@wp.func
def motion_of(face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Bound of how much nearer two parts can come, by the ways of their corners."""
    mean = wp.float64(0.25) * (a + b + c + d)
    u, v, p, q = wp.length(a - mean), wp.length(b - mean), wp.length(c - mean), wp.length(d - mean)
    if face:
        return u + wp.max(v, wp.max(p, q))
    return wp.max(u, v) + wp.max(p, q)


@wp.func
def kept_of(distance: wp.float64, share: wp.float64, most: wp.float64, floor: wp.float64):
    """What is kept of a distance: a share, up to so much, and all but a tenth of what is under a floor."""
    return wp.max(wp.min(share * distance, most), wp.min(wp.float64(TIGHT) * distance, floor))


@wp.func
def can_meet(distance: wp.float64, bound: wp.float64, share: wp.float64, most: wp.float64, floor: wp.float64):
    """Whether parts at least a distance apart that come nearer by at most a bound may come nearer than they may."""
    return distance - kept_of(distance, share, most, floor) < bound


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
    share: wp.float64,
    most: wp.float64,
    floor: wp.float64,
):
    """Part of their ways u, v, p, q that the corners a, b, c, d can go, in (0, 1]; 1 where the parts touch already."""
    one = wp.float64(1.0)
    bound = motion_of(face, u, v, p, q)
    # About their first corner: far from the origin differences lose no digits.
    zero = a - a
    b, c, d = b - a, c - a, d - a
    mean = wp.float64(0.25) * (u + v + p + q)
    u, v, p, q = u - mean, v - mean, p - mean, q - mean
    distance = distance_of(face, zero, b, c, d)
    keep = kept_of(distance, share, most, floor)
    if distance <= wp.float64(0.0) or distance - keep >= bound:
        return one
    time = wp.float64(0.0)
    for _ in range(STEPS):
        time += (distance - keep) / bound
        if time >= one:
            return one
        distance = distance_of(face, zero + time * u, b + time * v, c + time * p, d + time * q)
        if distance - keep <= NEAR * keep:
            break
    return time
