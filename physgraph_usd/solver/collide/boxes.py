"""Boxes of clusters and of parts at the start and at the end of a move, compared eight at a time.

Two sets of points that one axis separates at both ends, in equal order, are apart throughout a straight move: the
theorem of `separation` with the axis as its direction. Positions alone are a move whose ends are equal.

Boxes are stored in blocks of eight: twelve rows of low, high, low at the end and high at the end by axis, a lane for
each part.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportReturnType=false
from __future__ import annotations

import functools
from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.piercing import ROUNDING
from .topology import LANES, Topology

wp.set_module_options(KERNELS)

ROWS = 12
"""Rows of a block of boxes."""
FAR = wp.constant(wp.float64(1.0e30))
"""Corner of an empty box, and distance to missing parts [m]."""
ROUNDED_UP = wp.constant(wp.float64(1.000001))
"""Factor on search distances, for rounding to single precision."""


class Ask(IntEnum):
    """Parts that come too near on straight paths, near parts, edges through faces, and both first kinds at once."""

    MOVE = 0
    NEAR = 1
    CROSSING = 2
    MOVE_NEAR = 3


_OVERLAPPING = """
    const float* a = (const float*)boxes.data + (part / 8) * 96 + part % 8;
    const float* all = (const float*)blocks.data + block * 96;
    unsigned long long mask = 0;
    float low[3], high[3], to_low[3], to_high[3];
    for (int axis = 0; axis < 3; ++axis) {
        low[axis] = a[8 * axis] - room;
        high[axis] = a[24 + 8 * axis] + room;
        to_low[axis] = a[48 + 8 * axis] - room;
        to_high[axis] = a[72 + 8 * axis] + room;
    }
#if defined(__CUDA_ARCH__)
    for (int n = 0; n < count; ++n, all += 96)
        for (int lane = 0; lane < 8; ++lane) {
            bool apart = false;
            for (int axis = 0; axis < 3; ++axis) {
                const float* b = all + 8 * axis + lane;
                apart |= b[0] > high[axis] && b[48] > to_high[axis];
                apart |= b[24] < low[axis] && b[72] < to_low[axis];
            }
            if (!apart) mask |= 1ull << (8 * n + lane);
        }
#else
    typedef float Floats __attribute__((vector_size(32), aligned(4)));
    typedef int Ints __attribute__((vector_size(32)));
    const Ints bits = {1, 2, 4, 8, 16, 32, 64, 128};
    for (int n = 0; n < count; ++n, all += 96) {
        Ints apart = {0, 0, 0, 0, 0, 0, 0, 0};
        for (int axis = 0; axis < 3; ++axis) {
            const Floats* b = (const Floats*)(all + 8 * axis);
            apart |= (Ints)(b[0] > high[axis]) & (Ints)(b[6] > to_high[axis]);
            apart |= (Ints)(b[3] < low[axis]) & (Ints)(b[9] < to_low[axis]);
        }
        mask |= (unsigned long long)__builtin_reduce_or(~apart & bits) << (8 * n);
    }
#endif
    return mask;
"""
_LOWEST = """
#if defined(__CUDA_ARCH__)
    return __ffsll(mask) - 1;
#else
    return __builtin_ctzll(mask);
#endif
"""


@wp.struct
class Query:
    """A search: the kind of query, positions at both ends, queried vertices, and distances.

    Attributes:
        kind: As in `Ask`.
        clusters: Number of clusters searched: those of the cloth, or all.
        start: Positions [m].
        end: Positions at the end; those at the start without a move [m].
        queried: True for queried vertices; each pair contains at least one.
        tangle: The tangle of each vertex, -1 outside tangles; pairs inside one tangle are skipped.
        inside: True for cloth vertices inside a body; their pairs with bodies are skipped.
        floor: Gap to keep in a move [m].
        radius: Search radius of near parts [m].
        play: As for `Reach` [m].
        half: As for `Reach`.
    """

    kind: wp.int32
    clusters: wp.int32
    start: wp.array(dtype=wp.vec3d)
    end: wp.array(dtype=wp.vec3d)
    queried: wp.array(dtype=wp.bool)
    tangle: wp.array(dtype=wp.int32)
    inside: wp.array(dtype=wp.bool)
    floor: wp.float64
    radius: wp.array(dtype=wp.float64)
    play: wp.array(dtype=wp.float64)
    half: wp.float64


@wp.struct
class Boxes:
    """Boxes of one search.

    Attributes:
        clusters: Boxes of the clusters, in blocks [m].
        parts: Boxes of the parts, in blocks [m].
        radius: Search distance of each cluster [m].
        queried: True for clusters with a queried vertex.
        met: True for clusters in a pair that no axis separates.
        low: Least corner of each cluster's paths, less the search distance [m].
        high: Greatest corner of each cluster's paths, plus the search distance [m].
    """

    clusters: wp.array(dtype=wp.float32)
    parts: wp.array(dtype=wp.float32)
    radius: wp.array(dtype=wp.float32)
    queried: wp.array(dtype=wp.bool)
    met: wp.array(dtype=wp.bool)
    low: wp.array(dtype=wp.vec3f)
    high: wp.array(dtype=wp.vec3f)


@wp.func_native(_OVERLAPPING)
def boxes_near(
    boxes: wp.array(dtype=wp.float32),
    part: wp.int32,
    blocks: wp.array(dtype=wp.float32),
    block: wp.int32,
    count: wp.int32,
    room: wp.float32,
) -> wp.uint64:
    """Bits of the boxes in up to eight blocks that no axis keeps farther than a distance from a box, at both ends."""
    ...


@wp.func_native(_LOWEST)
def lowest_bit(mask: wp.uint64) -> wp.int32:
    """Position of the lowest bit of a nonzero mask."""
    ...


@wp.func_native("return mask & (mask - 1);")
def without_lowest(mask: wp.uint64) -> wp.uint64:
    """A mask without its lowest bit."""
    ...


@wp.func
def lower(v: wp.float64):
    """A number in single precision, rounded down."""
    return wp.float32(v - ROUNDING * wp.abs(v))


@wp.func
def upper(v: wp.float64):
    """A number in single precision, rounded up."""
    return wp.float32(v + ROUNDING * wp.abs(v))


@wp.func
def put(
    boxes: wp.array(dtype=wp.float32),
    part: wp.int32,
    low: wp.vec3d,
    high: wp.vec3d,
    to_low: wp.vec3d,
    to_high: wp.vec3d,
):
    """Write a box into its lane."""
    start = (part // LANES) * (ROWS * LANES) + part % LANES
    for axis in range(3):
        boxes[start + LANES * axis] = lower(low[axis])
        boxes[start + LANES * (3 + axis)] = upper(high[axis])
        boxes[start + LANES * (6 + axis)] = lower(to_low[axis])
        boxes[start + LANES * (9 + axis)] = upper(to_high[axis])


@wp.kernel
def bound_clusters(first: wp.int32, parts: Topology, query: Query, boxes: Boxes):
    """Boxes and search distances of the clusters, and whether they are queried."""
    i = first + wp.tid()
    low, high, to_low, to_high = wp.vec3d(FAR), wp.vec3d(-FAR), wp.vec3d(FAR), wp.vec3d(-FAR)
    radius, queried = wp.float64(0.0), wp.int32(0)
    for k in range(parts.first_corner[i], parts.first_corner[i + 1]):
        v = parts.corners[k]
        low, high = wp.min(low, query.start[v]), wp.max(high, query.start[v])
        to_low, to_high = wp.min(to_low, query.end[v]), wp.max(to_high, query.end[v])
        radius = wp.max(radius, query.radius[v])
        if query.queried[v]:
            queried = 1
    put(boxes.clusters, i, low, high, to_low, to_high)
    radius = ROUNDED_UP * (radius + wp.float64(0.5) * query.floor)
    boxes.radius[i] = wp.float32(radius)
    boxes.queried[i] = queried == 1
    boxes.met[i] = False
    low, high = wp.min(low, to_low) - wp.vec3d(radius), wp.max(high, to_high) + wp.vec3d(radius)
    boxes.low[i] = wp.vec3f(lower(low[0]), lower(low[1]), lower(low[2]))
    boxes.high[i] = wp.vec3f(upper(high[0]), upper(high[1]), upper(high[2]))


@wp.func
def put_part(boxes: Boxes, query: Query, k: wp.int32, c: wp.vec3i):
    """Write the box of a part with the corners c."""
    p, q, r = query.start[c[0]], query.start[c[1]], query.start[c[2]]
    s, t, u = query.end[c[0]], query.end[c[1]], query.end[c[2]]
    low, high = wp.min(p, wp.min(q, r)), wp.max(p, wp.max(q, r))
    put(boxes.parts, k, low, high, wp.min(s, wp.min(t, u)), wp.max(s, wp.max(t, u)))


@wp.kernel
def bound_parts(first: wp.int32, parts: Topology, query: Query, boxes: Boxes):
    """Boxes of the parts of clusters marked in `Boxes.met`."""
    i = first + wp.tid()
    if not boxes.met[i]:
        return
    for kind in range(3):
        row = kind * (parts.clusters + 1) + i
        for k in range(LANES * parts.first[row], LANES * parts.first[row + 1]):
            if parts.parts[k][0] >= 0:
                put_part(boxes, query, k, parts.parts[k])


def boxes_for(topology: Any, device: str) -> Any:
    """Empty boxes of all clusters and parts."""
    boxes, count = Boxes(), topology.clusters
    block = np.repeat(np.float32(FAR) * np.repeat(np.float32([1, -1, 1, -1]), 3), LANES)
    for name, size in (("clusters", -(-count // LANES)), ("parts", len(topology.parts) // LANES)):
        setattr(boxes, name, wp.array(np.tile(block, size), dtype=wp.float32, device=device))
    boxes.low, boxes.high = (wp.empty(count, dtype=wp.vec3f, device=device) for _ in range(2))
    boxes.radius = wp.empty(count, dtype=wp.float32, device=device)
    boxes.queried, boxes.met = (wp.empty(count, dtype=wp.bool, device=device) for _ in range(2))
    return boxes


@functools.lru_cache(maxsize=16)
def _filled(value: float, count: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """A constant for each vertex, read-only in kernels."""
    return torch.full((count,), value, dtype=dtype, device=device)


def arrays_of(
    start: Tensor,
    end: Tensor | None = None,
    *,
    queried: Tensor | None = None,
    tangle: Tensor | None = None,
    inside: Tensor | None = None,
    radius: Tensor | None = None,
    play: Tensor | None = None,
) -> list[Tensor]:
    """The arrays of a query, in order, with constants in place of None; float64 positions of shape (V, 3)."""
    optional = (
        (queried, 1.0, torch.bool),
        (tangle, -1.0, torch.int32),
        (inside, 0.0, torch.bool),
        (radius, 0.0, torch.float64),
        (play, 0.0, torch.float64),
    )
    filled = [
        _filled(fill, len(start), start.device, dtype) if values is None else values for values, fill, dtype in optional
    ]
    return [values.contiguous() for values in (start, start if end is None else end, *filled)]


def query_of(arrays: Sequence[Tensor], *, kind: Ask = Ask.MOVE, floor: float = 0.0, half: float = 0.0) -> Any:
    """A query as a Warp struct, given its `arrays_of`; the numbers are as for `Query`."""
    query = Query()
    query.kind, query.floor, query.half = int(kind), floor, half
    for name, values in zip(("start", "end", "queried", "tangle", "inside", "radius", "play"), arrays, strict=True):
        setattr(query, name, wp.from_torch(values, dtype=wp.vec3d if values.ndim == 2 else None))
    return query
