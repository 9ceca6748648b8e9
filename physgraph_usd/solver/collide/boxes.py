"""Bounding boxes of clusters and of their parts while all vertices move along straight paths."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

import functools
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ..mesh.kernels import KERNELS
from .domains import single
from .parts import Parts
from .topology import Topology

wp.set_module_options(KERNELS)

FAR = wp.constant(wp.float64(1.0e30))
"""Corner of an empty box."""
ROUNDING = wp.constant(wp.float64(2.4e-7))
"""Widening of single-precision boxes, as a fraction of their corners' distance from the origin."""


@wp.struct
class Motion:
    """Positions, displacements, queried vertices, gap to keep, and search radii without motion."""

    start: wp.array(dtype=wp.vec3d)
    path: wp.array(dtype=wp.vec3d)
    asked: wp.array(dtype=wp.bool)
    tangle: wp.array(dtype=wp.int32)
    floor: wp.float64
    is_still: wp.bool
    radius: wp.array(dtype=wp.float64)
    play: wp.array(dtype=wp.float64)
    slack: wp.array(dtype=wp.float64)
    half: wp.float64


@wp.struct
class Boxes:
    """Per cluster: start box, mean path, deviation from the path, search distance, boxes of edges and faces."""

    low: wp.array(dtype=wp.vec3d)
    high: wp.array(dtype=wp.vec3d)
    mean: wp.array(dtype=wp.vec3d)
    spread: wp.array(dtype=wp.float64)
    radius: wp.array(dtype=wp.float64)
    asked: wp.array(dtype=wp.int32)
    edge_low: wp.array(dtype=wp.vec3f)
    edge_high: wp.array(dtype=wp.vec3f)
    face_low: wp.array(dtype=wp.vec3f)
    face_high: wp.array(dtype=wp.vec3f)


@wp.struct
class Swept:
    """Per cluster: swept box, widened by search distance and path tolerance; and the search distance."""

    low: wp.array(dtype=wp.vec3f)
    high: wp.array(dtype=wp.vec3f)
    near: wp.array(dtype=wp.float64)


@wp.func
def overlap(low: wp.vec3f, high: wp.vec3f, other_low: wp.vec3f, other_high: wp.vec3f):
    """True if two boxes overlap. All six comparisons are made: a mispredicted branch costs more."""
    first = wp.where(low[0] <= other_high[0], 1, 0) & wp.where(low[1] <= other_high[1], 1, 0)
    second = wp.where(low[2] <= other_high[2], 1, 0) & wp.where(other_low[0] <= high[0], 1, 0)
    third = wp.where(other_low[1] <= high[1], 1, 0) & wp.where(other_low[2] <= high[2], 1, 0)
    return (first & second & third) == 1


@wp.func
def outside(low: wp.vec3d, high: wp.vec3d, other_low: wp.vec3d, other_high: wp.vec3d, reach: wp.float64):
    """True if two boxes are farther apart than a reach along an axis."""
    for axis in range(3):
        if low[axis] > other_high[axis] + reach or other_low[axis] > high[axis] + reach:
            return True
    return False


@wp.func
def lowest_of(v: wp.vec3d):
    """A corner in single precision, rounded down."""
    return single(v - ROUNDING * wp.abs(v))


@wp.func
def highest_of(v: wp.vec3d):
    """A corner in single precision, rounded up."""
    return single(v + ROUNDING * wp.abs(v))


@wp.func
def room_of(boxes: Boxes, motion: Motion, i: wp.int32, j: wp.int32):
    """Distance from which parts of two clusters are ignored: the search distance, or the gap to keep in a move."""
    return boxes.radius[i] + boxes.radius[j] + motion.floor


@wp.func
def pass_by(boxes: Boxes, i: wp.int32, j: wp.int32, room: wp.float64):
    """True if two clusters keep a distance on their paths, by the box swept by the first relative to the second."""
    way = boxes.mean[i] - boxes.mean[j]
    reach = room + boxes.spread[i] + boxes.spread[j]
    low, high = boxes.low[i] + wp.min(way, wp.vec3d()), boxes.high[i] + wp.max(way, wp.vec3d())
    if outside(low, high, boxes.low[j], boxes.high[j], reach):
        return True
    # Their middles on the segment that one goes, seen from the other, against the balls round them.
    between = wp.float64(0.5) * (boxes.low[j] + boxes.high[j] - boxes.low[i] - boxes.high[i])
    part = wp.clamp(
        wp.dot(between, way) / wp.max(wp.dot(way, way), wp.float64(1.0e-300)), wp.float64(0.0), wp.float64(1.0)
    )
    sizes = wp.length(boxes.high[i] - boxes.low[i]) + wp.length(boxes.high[j] - boxes.low[j])
    return wp.length(between - part * way) > wp.float64(0.5) * sizes + reach


@wp.kernel
def sweep_boxes(first: wp.int32, parts: Topology, motion: Motion, swept: Swept):
    """Box swept by each cluster, with each vertex anywhere on its path: some vertices may stop while others move on."""
    i = first + wp.tid()
    low, high = wp.vec3d(FAR), wp.vec3d(-FAR)
    reach, near = wp.float64(0.0), wp.float64(0.0)
    for k in range(parts.first_corner[i], parts.first_corner[i + 1]):
        v = parts.corners[k]
        at = motion.start[v]
        end = at + motion.path[v]
        low, high = wp.min(low, wp.min(at, end)), wp.max(high, wp.max(at, end))
        reach = wp.max(reach, motion.radius[v] + motion.slack[v])
        near = wp.max(near, motion.radius[v])
    widened = ROUNDING * wp.max(wp.abs(low), wp.abs(high)) + wp.vec3d(reach)
    swept.low[i] = single(low - widened)
    swept.high[i] = single(high + widened)
    swept.near[i] = near


@wp.func
def mean_path(parts: Topology, path: wp.array(dtype=wp.vec3d), i: wp.int32):
    """Mean path of a cluster's vertices, and the largest deviation of a vertex from it."""
    total, most = wp.vec3d(), wp.float64(0.0)
    begin, end = parts.first_corner[i], parts.first_corner[i + 1]
    for k in range(begin, end):
        total += path[parts.corners[k]]
    mean = total / wp.float64(wp.max(end - begin, 1))
    for k in range(begin, end):
        most = wp.max(most, wp.length(path[parts.corners[k]] - mean))
    return mean, most


@wp.kernel
def bound_parts(first: wp.int32, parts: Topology, motion: Motion, active: wp.array(dtype=wp.int32), boxes: Boxes):
    """Start boxes of some clusters, and of their edges and faces."""
    i = active[first + wp.tid()]
    lowest, highest = wp.vec3d(FAR), wp.vec3d(-FAR)
    for k in range(parts.first_corner[i], parts.first_corner[i + 1]):
        at = motion.start[parts.corners[k]]
        lowest, highest = wp.min(lowest, at), wp.max(highest, at)
    boxes.low[i] = lowest
    boxes.high[i] = highest
    for k in range(parts.first_edge[i], parts.first_edge[i + 1]):
        a, b = motion.start[parts.edges[k][0]], motion.start[parts.edges[k][1]]
        boxes.edge_low[k] = lowest_of(wp.min(a, b))
        boxes.edge_high[k] = highest_of(wp.max(a, b))
    for k in range(parts.first_face[i], parts.first_face[i + 1]):
        t = parts.faces[k]
        p, q, r = motion.start[t[0]], motion.start[t[1]], motion.start[t[2]]
        boxes.face_low[k] = lowest_of(wp.min(p, wp.min(q, r)))
        boxes.face_high[k] = highest_of(wp.max(p, wp.max(q, r)))


@wp.kernel
def average_paths(first: wp.int32, parts: Topology, motion: Motion, active: wp.array(dtype=wp.int32), boxes: Boxes):
    """Mean path of some clusters, largest deviation of a vertex from it, search distance, and whether it is queried."""
    i = active[first + wp.tid()]
    asked, radius = wp.int32(0), wp.float64(0.0)
    for k in range(parts.first_corner[i], parts.first_corner[i + 1]):
        v = parts.corners[k]
        radius = wp.max(radius, motion.radius[v] + motion.slack[v])
        if motion.asked[v]:
            asked = 1
    mean, spread = mean_path(parts, motion.path, i)
    boxes.mean[i] = mean
    boxes.spread[i] = spread
    boxes.radius[i] = radius
    boxes.asked[i] = asked


def room_for_swept(size: int, device: str) -> Any:
    """Uninitialized boxes of whole paths."""
    swept = Swept()
    swept.low, swept.high = (wp.empty(size, dtype=wp.vec3f, device=device) for _ in range(2))
    swept.near = wp.empty(size, dtype=wp.float64, device=device)
    return swept


def room_for_boxes(parts: Parts) -> Any:
    """Uninitialized boxes."""
    size, device = parts.count, parts.level.device
    boxes = Boxes()
    for name in ("low", "high", "mean"):
        setattr(boxes, name, wp.empty(size, dtype=wp.vec3d, device=device))
    boxes.spread, boxes.radius = (wp.empty(size, dtype=wp.float64, device=device) for _ in range(2))
    boxes.asked = wp.empty(size, dtype=wp.int32, device=device)
    for name, count in (("edge", len(parts.level.edges)), ("face", len(parts.level.triangles))):
        for end in ("low", "high"):
            setattr(boxes, f"{name}_{end}", wp.empty(count, dtype=wp.vec3f, device=device))
    return boxes


class _Nothing:
    """Default vertex arrays of a motion; kernels only read them.

    Attributes:
        all: True for each vertex.
        tangle: -1 for each vertex.
        zero: 0 for each vertex.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        """Fill the arrays."""
        self.all = wp.from_torch(torch.ones(count, dtype=torch.bool, device=device))
        self.tangle = wp.from_torch(torch.full((count,), -1, dtype=torch.int32, device=device))
        self.zero = wp.from_torch(torch.zeros(count, dtype=torch.float64, device=device))

    @staticmethod
    @functools.lru_cache(maxsize=4)
    def of(count: int, device: torch.device) -> _Nothing:
        """Cached arrays for a number of vertices."""
        return _Nothing(count, device)


def motion_of(
    start: Tensor,
    path: Tensor,
    *,
    asked: Tensor | None = None,
    tangle: Tensor | None = None,
    radius: Tensor | None = None,
    play: Tensor | None = None,
    slack: Tensor | None = None,
    half: float = 0.0,
) -> Any:
    """Vertex data as a Warp struct; a radius makes it a query for near pairs.

    Args:
        start: Positions [m], float64, shape (V, 3).
        path: Displacement of each vertex [m], float64, shape (V, 3).
        asked: Vertices of which each queried pair must contain at least one; all if None, shape (V,).
        tangle: The tangle of each vertex, int32, -1 outside tangles; or None.
        radius: Search radius, as for `Reach` [m], or None.
        play: As for `Reach` [m], or None.
        slack: Position tolerance of each vertex [m], or None.
        half: As for `Reach`.
    """
    motion, nothing = Motion(), _Nothing.of(len(start), start.device)
    motion.start, motion.path = (wp.from_torch(each.contiguous(), dtype=wp.vec3d) for each in (start, path))
    motion.asked = nothing.all if asked is None else wp.from_torch(asked.contiguous())
    motion.tangle = nothing.tangle if tangle is None else wp.from_torch(tangle.contiguous())
    motion.is_still, motion.half = radius is not None, half
    motion.radius, motion.play, motion.slack = (
        nothing.zero if each is None else wp.from_torch(each.contiguous()) for each in (radius, play, slack)
    )
    return motion
