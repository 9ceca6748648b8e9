"""Every pair of parts that is near, or that would touch where all vertices move along straight lines."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.threads import LEAST_QUERIES, Launch
from .impact import distance_of, impact_of
from .parts import Parts, Topology

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(wp.float64(1.0e30))
"""Corner of a box that holds nothing."""
IMPACTS, NEAR = 8, 128
"""Pairs of a cluster that there is room for before they are counted: few meet on their way, many are near."""
SPARE = 0.05
"""What is left at least, as a part of a reach, between parts of a pair that is not listed."""
ROUNDING = wp.constant(wp.float64(2.4e-7))
"""What boxes in single precision are widened by, of their corners' distance from the origin."""


@wp.struct
class Motion:
    """Where vertices are, how far they want to go, which pairs are asked, and what is near where nothing moves."""

    start: wp.array(dtype=wp.vec3d)
    way: wp.array(dtype=wp.vec3d)
    asked: wp.array(dtype=wp.bool)
    tangle: wp.array(dtype=wp.int32)
    share: wp.float64
    floor: wp.float64
    is_still: wp.bool
    radius: wp.array(dtype=wp.float64)
    play: wp.array(dtype=wp.float64)
    may: wp.array(dtype=wp.float64)
    half: wp.float64


@wp.struct
class Sweep:
    """Of each cluster: the boxes that its parts sweep and start in, their mean way, how far they leave it, and how
    near it looks."""

    low: wp.array(dtype=wp.vec3f)
    high: wp.array(dtype=wp.vec3f)
    from_low: wp.array(dtype=wp.vec3d)
    from_high: wp.array(dtype=wp.vec3d)
    mean: wp.array(dtype=wp.vec3d)
    spread: wp.array(dtype=wp.float64)
    radius: wp.array(dtype=wp.float64)
    asked: wp.array(dtype=wp.int32)
    edge_low: wp.array(dtype=wp.vec3f)
    edge_high: wp.array(dtype=wp.vec3f)
    face_low: wp.array(dtype=wp.vec3f)
    face_high: wp.array(dtype=wp.vec3f)


@wp.struct
class Found:
    """Where each cluster's pairs begin, how many it has, and what `Pairs` holds."""

    begin: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    corners: wp.array(dtype=wp.vec4i)
    value: wp.array(dtype=wp.float64)
    face: wp.array(dtype=wp.bool)


@dataclass(frozen=True, eq=False)
class Reach:
    """How near what is near is.

    Attributes:
        radius: Two parts are near within the sum of their radii, the greatest of their corners' [m], shape (V,),
            float64.
        play: Those of one garment only within a part of their distance at rest and twice the least of these [m], shape
            (V,).
        half: That part.
    """

    radius: Float[Tensor, " vertices"]
    play: Float[Tensor, " vertices"]
    half: float


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of parts.

    Attributes:
        corners: A vertex and the corners of a face, or the ends of two edges, shape (N, 4).
        value: Of impacts the part of their way that they may go, in (0, 1); of near pairs their distance over the
            one asked for; shape (N,).
        face: Whether it is a vertex and a face, shape (N,).
    """

    corners: Int[Tensor, "pairs 4"]
    value: Float[Tensor, " pairs"]
    face: Bool[Tensor, " pairs"]


@wp.func
def has(t: wp.vec3i, v: wp.int32):
    """Whether a triangle has a vertex."""
    return t[0] == v or t[1] == v or t[2] == v


@wp.func
def overlap(low: wp.vec3f, high: wp.vec3f, other_low: wp.vec3f, other_high: wp.vec3f):
    """Whether two boxes meet; all six comparisons are made, for a wrong guess at a branch costs more."""
    first = wp.where(low[0] <= other_high[0], 1, 0) & wp.where(low[1] <= other_high[1], 1, 0)
    second = wp.where(low[2] <= other_high[2], 1, 0) & wp.where(other_low[0] <= high[0], 1, 0)
    third = wp.where(other_low[1] <= high[1], 1, 0) & wp.where(other_low[2] <= high[2], 1, 0)
    return (first & second & third) == 1


@wp.func
def single(v: wp.vec3d):
    """The same in single precision."""
    return wp.vec3f(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def lowest_of(v: wp.vec3d):
    """In single precision, no higher."""
    return single(v - ROUNDING * wp.abs(v))


@wp.func
def highest_of(v: wp.vec3d):
    """In single precision, no lower."""
    return single(v + ROUNDING * wp.abs(v))


@wp.kernel
def sweep_boxes(first: wp.int32, parts: Topology, motion: Motion, sweep: Sweep):
    """The boxes of a cluster's corners, where they start and all along, and those of its edges and faces."""
    i = first + wp.tid()
    least, most = wp.vec3d(FAR), wp.vec3d(-FAR)
    lowest, highest = wp.vec3d(FAR), wp.vec3d(-FAR)
    radius = wp.float64(0.0)
    for k in range(parts.first_corner[i], parts.first_corner[i + 1]):
        v = parts.corners[k]
        at, way = motion.start[v], motion.way[v]
        least, most = wp.min(least, at), wp.max(most, at)
        lowest, highest = wp.min(lowest, wp.min(at, at + way)), wp.max(highest, wp.max(at, at + way))
        radius = wp.max(radius, motion.radius[v] + motion.may[v])
    slack = ROUNDING * wp.max(wp.abs(lowest), wp.abs(highest)) + wp.vec3d(radius)
    sweep.low[i] = single(lowest - slack)
    sweep.high[i] = single(highest + slack)
    sweep.from_low[i] = least
    sweep.from_high[i] = most
    sweep.radius[i] = radius
    for k in range(parts.first_edge[i], parts.first_edge[i + 1]):
        a, b = motion.start[parts.edges[k][0]], motion.start[parts.edges[k][1]]
        sweep.edge_low[k] = lowest_of(wp.min(a, b))
        sweep.edge_high[k] = highest_of(wp.max(a, b))
    for k in range(parts.first_face[i], parts.first_face[i + 1]):
        t = parts.faces[k]
        p, q, r = motion.start[t[0]], motion.start[t[1]], motion.start[t[2]]
        sweep.face_low[k] = lowest_of(wp.min(p, wp.min(q, r)))
        sweep.face_high[k] = highest_of(wp.max(p, wp.max(q, r)))


@wp.kernel
def mean_ways(first: wp.int32, parts: Topology, motion: Motion, sweep: Sweep):
    """The mean way of a cluster's corners, how far they leave it, and whether one is asked."""
    i = first + wp.tid()
    total, asked = wp.vec3d(), wp.int32(0)
    begin, end = parts.first_corner[i], parts.first_corner[i + 1]
    for k in range(begin, end):
        v = parts.corners[k]
        total += motion.way[v]
        if motion.asked[v]:
            asked = 1
    mean = total / wp.float64(wp.max(end - begin, 1))
    spread = wp.float64(0.0)
    for k in range(begin, end):
        spread = wp.max(spread, wp.length(motion.way[parts.corners[k]] - mean))
    sweep.mean[i] = mean
    sweep.spread[i] = spread
    sweep.asked[i] = asked


@wp.func
def outside(low: wp.vec3d, high: wp.vec3d, other_low: wp.vec3d, other_high: wp.vec3d, reach: wp.float64):
    """Whether two boxes are farther apart than a reach along an axis."""
    for axis in range(3):
        if low[axis] > other_high[axis] + reach or other_low[axis] > high[axis] + reach:
            return True
    return False


@wp.func
def reach_of(sweep: Sweep, i: wp.int32, j: wp.int32):
    """How much nearer parts of two clusters can come, or the distance asked for."""
    move = wp.length(sweep.mean[i] - sweep.mean[j]) + sweep.spread[i] + sweep.spread[j]
    return move + sweep.radius[i] + sweep.radius[j]


@wp.func
def write(found: Found, i: wp.int32, count: wp.int32, corners: wp.vec4i, value: wp.float64, face: wp.bool):
    """Write a cluster's next pair, if there is room."""
    place = found.begin[i] + count
    if place < found.begin[i + 1]:
        found.corners[place] = corners
        found.value[place] = value
        found.face[place] = face


@wp.func
def is_one(parts: Topology, a: wp.int32, b: wp.int32):
    """Whether two vertices are one, or sewn together."""
    return parts.label[a] == parts.label[b]


@wp.func
def sum_of(face: wp.bool, a: wp.float64, b: wp.float64, c: wp.float64, d: wp.float64):
    """The greatest value of a pair's first part and that of its second."""
    if face:
        return a + wp.max(b, wp.max(c, d))
    return wp.max(a, b) + wp.max(c, d)


@wp.func
def box_gap(face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Greatest distance along an axis between the boxes of two parts."""
    low, high, other_low, other_high = a, a, wp.min(c, d), wp.max(c, d)
    if face:
        other_low, other_high = wp.min(b, other_low), wp.max(b, other_high)
    else:
        low, high = wp.min(a, b), wp.max(a, b)
    apart = wp.max(low - other_high, other_low - high)
    return wp.max(apart[0], wp.max(apart[1], apart[2]))


@wp.func
def nearness(face: wp.bool, a: wp.int32, b: wp.int32, c: wp.int32, d: wp.int32, parts: Topology, motion: Motion):
    """Distance of a pair over that within which it is near, which is less where it is near at rest; 1 beyond it."""
    one = wp.float64(1.0)
    r, p, m = motion.radius, motion.play, motion.may
    within, may = sum_of(face, r[a], r[b], r[c], r[d]), sum_of(face, m[a], m[b], m[c], m[d])
    x, y, z, w = motion.start[a], motion.start[b], motion.start[c], motion.start[d]
    if box_gap(face, x, y, z, w) >= within + may:
        return one
    distance = distance_of(face, x, y, z, w)
    if distance < within + may and parts.owner[a] == parts.owner[d]:
        at_rest = distance_of(face, parts.rest[a], parts.rest[b], parts.rest[c], parts.rest[d])
        play = wp.float64(2.0) * wp.min(wp.min(p[a], p[b]), wp.min(p[c], p[d]))
        within = wp.min(within, motion.half * at_rest + play)
    return wp.min(distance / (within + may), one)


@wp.func
def value_of(
    face: wp.bool,
    a: wp.int32,
    b: wp.int32,
    c: wp.int32,
    d: wp.int32,
    parts: Topology,
    motion: Motion,
):
    """Part of their ways that a vertex and a face, or two edges, may go, or their distance over the one asked for.

    It is 1 where they are not to be asked.
    """
    none = wp.float64(1.0)
    if is_one(parts, a, c) or is_one(parts, a, d) or is_one(parts, b, wp.where(face, a, c)):
        return none
    if not face and is_one(parts, b, d):
        return none
    if not (motion.asked[a] or motion.asked[b] or motion.asked[c] or motion.asked[d]):
        return none
    tangle = motion.tangle[a]
    if tangle >= 0 and motion.tangle[b] == tangle and motion.tangle[c] == tangle and motion.tangle[d] == tangle:
        return none
    x, y, z, w = motion.start[a], motion.start[b], motion.start[c], motion.start[d]
    if motion.is_still:
        return nearness(face, a, b, c, d, parts, motion)
    u, v, p, q = motion.way[a], motion.way[b], motion.way[c], motion.way[d]
    return impact_of(face, x, y, z, w, u, v, p, q, motion.share, motion.floor)


@wp.func
def faces_met(
    parts: Topology,
    motion: Motion,
    sweep: Sweep,
    found: Found,
    owner: wp.int32,
    i: wp.int32,
    j: wp.int32,
    count: wp.int32,
):
    """Write the pairs of a cluster's vertices and another's faces as a cluster's; the number of its pairs so far."""
    reach = reach_of(sweep, i, j)
    for k in range(parts.first_vertex[i], parts.first_vertex[i + 1]):
        v = parts.vertices[k]
        at = motion.start[v]
        if outside(at, at, sweep.from_low[j], sweep.from_high[j], reach):
            continue
        low, high = lowest_of(at - wp.vec3d(reach)), highest_of(at + wp.vec3d(reach))
        for m in range(parts.first_face[j], parts.first_face[j + 1]):
            if not overlap(low, high, sweep.face_low[m], sweep.face_high[m]):
                continue
            t = parts.faces[m]
            if has(t, v):
                continue
            value = value_of(True, v, t[0], t[1], t[2], parts, motion)
            if value < wp.float64(1.0):
                write(found, owner, count, wp.vec4i(v, t[0], t[1], t[2]), value, True)
                count += 1
    return count


@wp.func
def edges_met(parts: Topology, motion: Motion, sweep: Sweep, found: Found, i: wp.int32, j: wp.int32, count: wp.int32):
    """The same of the edges of two clusters, each pair once."""
    reach = reach_of(sweep, i, j)
    for k in range(parts.first_edge[i], parts.first_edge[i + 1]):
        e = parts.edges[k]
        near, far = motion.start[e[0]], motion.start[e[1]]
        if outside(wp.min(near, far), wp.max(near, far), sweep.from_low[j], sweep.from_high[j], reach):
            continue
        low = lowest_of(wp.min(near, far) - wp.vec3d(reach))
        high = highest_of(wp.max(near, far) + wp.vec3d(reach))
        for m in range(wp.where(i == j, k + 1, parts.first_edge[j]), parts.first_edge[j + 1]):
            if not overlap(low, high, sweep.edge_low[m], sweep.edge_high[m]):
                continue
            f = parts.edges[m]
            if e[0] == f[0] or e[0] == f[1] or e[1] == f[0] or e[1] == f[1]:
                continue
            value = value_of(False, e[0], e[1], f[0], f[1], parts, motion)
            if value < wp.float64(1.0):
                write(found, i, count, wp.vec4i(e[0], e[1], f[0], f[1]), value, False)
                count += 1
    return count


@wp.kernel
def pairs_of(
    first: wp.int32,
    parts: Topology,
    motion: Motion,
    sweep: Sweep,
    tree: wp.uint64,
    low: wp.array(dtype=wp.vec3f),
    high: wp.array(dtype=wp.vec3f),
    found: Found,
):
    """Count the pairs of a cluster's vertices with faces, and of its edges with those of no lower cluster.

    They are written from where a cluster's begin, so far as there is room; a cluster without any is not asked. Pairs
    with one that has no vertex asked are its own.
    """
    i = first + wp.tid()
    if low[i][0] > high[i][0] or found.begin[i + 1] == found.begin[i] or sweep.asked[i] == 0:
        return
    count, j = wp.int32(0), wp.int32(0)
    query = wp.bvh_query_aabb(tree, low[i], high[i])
    while wp.bvh_query_next(query, j):
        if parts.meets[parts.garment[i] * parts.garments + parts.garment[j]] == 0:
            continue
        reach = reach_of(sweep, i, j)
        if outside(sweep.from_low[i], sweep.from_high[i], sweep.from_low[j], sweep.from_high[j], reach):
            continue
        count = faces_met(parts, motion, sweep, found, i, i, j, count)
        if sweep.asked[j] == 0:
            count = faces_met(parts, motion, sweep, found, i, j, i, count)
        if j >= i or sweep.asked[j] == 0:
            count = edges_met(parts, motion, sweep, found, i, j, count)
    found.count[i] = count


@wp.kernel
def values_of(
    first: wp.int32,
    parts: Topology,
    motion: Motion,
    corners: wp.array(dtype=wp.vec4i),
    face: wp.array(dtype=wp.bool),
    value: wp.array(dtype=wp.float64),
):
    """The value of each pair of a list."""
    i = first + wp.tid()
    c = corners[i]
    value[i] = value_of(face[i], c[0], c[1], c[2], c[3], parts, motion)


class Swept:
    """All parts and the space that they sweep while each vertex moves along a straight line."""

    def __init__(
        self,
        parts: Parts,
        start: Float[Tensor, "vertices 3"],
        way: Float[Tensor, "vertices 3"],
        *,
        near: Reach | None = None,
        may: Float[Tensor, " vertices"] | None = None,
    ) -> None:
        """Build the hierarchy.

        Args:
            parts: The parts.
            start: Positions [m], float64.
            way: How far each vertex goes [m], float64.
            near: How near parts are asked for where nothing moves, or None.
            may: How much nearer each vertex may come [m], float64, or None.
        """
        self._near, self._may = near, may
        self._parts, self._device = parts, str(start.device)
        self._start = start - (start.mean(dim=0) if len(start) else start.new_zeros(3))
        self._boxes = _boxes(parts, self._device)
        none = torch.zeros(len(start), dtype=torch.bool, device=start.device)
        self._launch(sweep_boxes, self._motion(way, asked=none), self._boxes)
        self._tree = wp.Bvh(self._boxes.low, self._boxes.high)

    def impacts(
        self,
        way: Float[Tensor, "vertices 3"],
        *,
        share: float,
        floor: float,
        asked: Bool[Tensor, " vertices"],
        tangle: Int[Tensor, " vertices"] | None = None,
    ) -> Pairs:
        """Every pair of parts that would come too near.

        Args:
            way: How far each vertex goes [m], no farther along its line than was swept, float64.
            share: Part of their distance that pairs keep at least.
            floor: Distance under which they keep nine tenths of it [m].
            asked: Only pairs with one of these vertices are asked.
            tangle: The tangle that each vertex is in, int32, -1 where in none: pairs of one alone are not asked; or
                None.
        """
        motion = self._motion(way, asked=asked, tangle=tangle)
        motion.share, motion.floor = share, floor
        return self._found(pairs_of, motion, room=IMPACTS)

    def found(self, kernel: wp.Kernel, room: int) -> Pairs:
        """What a kernel with the parameters of `pairs_of` finds where nothing moves."""
        every = torch.ones(len(self._start), dtype=torch.bool, device=self._start.device)
        return self._found(kernel, self._motion(torch.zeros_like(self._start), asked=every), room=room)

    def _found(self, kernel: wp.Kernel, motion: Any, *, room: int) -> Pairs:
        """The pairs that are asked for; each cluster has room for so many before they are counted."""
        size, device = self._parts.count, self._start.device
        self._launch(mean_ways, motion, self._boxes)
        begin = torch.arange(size + 1, dtype=torch.int32, device=device) * room
        slots, count = _room(begin, room * size), torch.zeros_like(begin[:size])
        self._write(kernel, motion, begin=begin, count=count, out=slots)
        over = count > room
        kept = ((torch.arange(room, device=device) < count.unsqueeze(1)) & ~over.unsqueeze(1)).reshape(-1)
        first = Pairs(slots.corners[kept], slots.value[kept], slots.face[kept])
        if not bool(over.any()):
            return first
        begin[0] = 0  # Those without room are written again, now that they are counted.
        begin[1:] = (count * over).cumsum(dim=0)
        rest = _room(begin, int(begin[-1]))
        self._write(kernel, motion, begin=begin, count=count, out=rest)
        return joined(first, rest)

    def _write(self, kernel: wp.Kernel, motion: Any, *, begin: Tensor, count: Tensor, out: Pairs) -> None:
        """Count each cluster's pairs, and write those that there is room for."""
        found = Found()
        found.begin, found.count = wp.from_torch(begin), wp.from_torch(count)
        found.corners = wp.from_torch(out.corners, dtype=wp.vec4i)
        found.value, found.face = wp.from_torch(out.value), wp.from_torch(out.face)
        self._launch(kernel, motion, self._boxes, self._tree.id, self._boxes.low, self._boxes.high, found)

    def near(self) -> Pairs:
        """Every pair of parts as near as is asked for."""
        return self.found(pairs_of, NEAR)

    def _motion(self, way: Tensor, *, asked: Tensor, tangle: Tensor | None = None) -> Any:
        """What kernels are told of the vertices."""
        return _motion(self._start, way, asked=asked, tangle=tangle, near=self._near, may=self._may)

    def _launch(self, kernel: wp.Kernel, *inputs: object) -> None:
        """Run over the clusters."""
        given = {"device": self._device, "threads": self._parts.level.threads, "least": LEAST_QUERIES}
        Launch(kernel, self._parts.count, [self._parts.topology, *inputs], **given)({})


class Listed:
    """All pairs that are near, or can touch, while no vertex leaves where it is by more than it may: short moves ask
    them alone.

    Attributes:
        pairs: The pairs.
    """

    def __init__(
        self, parts: Parts, x: Float[Tensor, "vertices 3"], *, near: Reach, may: Float[Tensor, " vertices"]
    ) -> None:
        """Find the pairs.

        Args:
            parts: The parts.
            x: Positions [m].
            near: What is near.
            may: How far each vertex may go [m], float64.
        """
        self._x, self._may, self._parts = x.double(), may, parts
        still = torch.zeros_like(self._x)
        self.pairs = Swept(parts, self._x, still, near=near, may=(1.0 + SPARE) * may).near()

    def covers(self, x: Float[Tensor, "vertices 3"], part: float = 1.0) -> bool:
        """Whether no vertex at x [m] is farther from where it was than that part of what it may be."""
        return not bool(self.beyond(x, part).any())

    def beyond(self, x: Float[Tensor, "vertices 3"], part: float = 1.0) -> Bool[Tensor, " vertices"]:
        """Which vertices are."""
        return (x.double() - self._x).norm(dim=1) > part * self._may

    def impacts(
        self,
        start: Float[Tensor, "vertices 3"],
        way: Float[Tensor, "vertices 3"],
        *,
        share: float,
        floor: float,
        asked: Bool[Tensor, " vertices"],
        tangle: Int[Tensor, " vertices"] | None = None,
    ) -> Pairs:
        """As `Swept.impacts`, for ways that do not leave the reach."""
        motion, value = _motion(start, way, asked=asked, tangle=tangle), torch.ones_like(self.pairs.value)
        motion.share, motion.floor = share, floor
        inputs = [self._parts.topology, motion, wp.from_torch(self.pairs.corners, dtype=wp.vec4i)]
        inputs += [wp.from_torch(self.pairs.face), wp.from_torch(value)]
        Launch(values_of, len(value), inputs, device=str(start.device), threads=self._parts.level.threads)({})
        met = value < 1.0
        return Pairs(self.pairs.corners[met], value[met], self.pairs.face[met])


class ListedAndSwept:
    """Listed pairs for what stays within their reach, and all pairs of what does not."""

    def __init__(
        self,
        parts: Parts,
        start: Float[Tensor, "vertices 3"],
        way: Float[Tensor, "vertices 3"],
        listed: Listed | None,
    ) -> None:
        """Take what is swept and listed.

        Args:
            parts: The parts.
            start: Positions [m], float64.
            way: How far each vertex goes at most, along straight lines [m], float64.
            listed: The pairs, or None.
        """
        self._start, self._listed = start, listed
        self._far = None if listed is None else listed.beyond(start) | listed.beyond(start + way)
        covered = self._far is not None and not bool(self._far.any())
        self._swept = None if covered else Swept(parts, start, way)

    def impacts(
        self,
        way: Float[Tensor, "vertices 3"],
        *,
        share: float,
        floor: float,
        asked: Bool[Tensor, " vertices"],
        tangle: Int[Tensor, " vertices"] | None = None,
    ) -> Pairs:
        """As `Swept.impacts`."""
        given = {"share": share, "floor": floor, "tangle": tangle}
        if self._listed is None or self._far is None:
            assert self._swept is not None
            return self._swept.impacts(way, asked=asked, **given)
        near = self._listed.impacts(self._start, way, asked=asked, **given)
        # Of pairs with one that is asked and one that is far: all of whichever are fewer.
        fewer = asked if int(asked.sum()) < int(self._far.sum()) else self._far
        far = None if self._swept is None else self._swept.impacts(way, asked=fewer, **given)
        return near if far is None else joined(near, far)


def joined(first: Pairs, second: Pairs) -> Pairs:
    """Pairs of two lists."""
    parts = ((getattr(first, name), getattr(second, name)) for name in ("corners", "value", "face"))
    return Pairs(*(torch.cat(each) for each in parts))


def none_of(like: Float[Tensor, "vertices 3"]) -> Pairs:
    """No pairs, on the device of positions [m]."""
    return _room(torch.empty(0, dtype=torch.int32, device=like.device), 0)


def _motion(
    start: Tensor,
    way: Tensor,
    *,
    asked: Tensor,
    tangle: Tensor | None,
    near: Reach | None = None,
    may: Tensor | None = None,
) -> Any:
    """What kernels are told of the vertices."""
    motion = Motion()
    motion.start, motion.way = (wp.from_torch(each.contiguous(), dtype=wp.vec3d) for each in (start, way))
    motion.asked = wp.from_torch(asked.contiguous())
    none = torch.full_like(asked, -1, dtype=torch.int32) if tangle is None else tangle.contiguous()
    motion.tangle = wp.from_torch(none)
    motion.is_still = near is not None
    nothing = torch.zeros_like(start[:, 0])
    radius, play = (nothing, nothing) if near is None else (near.radius, near.play)
    motion.radius, motion.play, motion.may = (
        wp.from_torch(each.contiguous()) for each in (radius, play, nothing if may is None else may)
    )
    motion.half = 0.0 if near is None else near.half
    return motion


def _room(like: Tensor, count: int) -> Pairs:
    """Room for some pairs."""
    value = torch.empty(count, dtype=torch.float64, device=like.device)
    return Pairs(like.new_empty((count, 4)), value, torch.empty(count, dtype=torch.bool, device=like.device))


def _boxes(parts: Parts, device: str) -> Any:
    """Room for what is known of clusters."""
    size = parts.count
    sweep = Sweep()
    for name in ("low", "high"):
        setattr(sweep, name, wp.zeros(size, dtype=wp.vec3f, device=device))
        setattr(sweep, f"from_{name}", wp.zeros(size, dtype=wp.vec3d, device=device))
    sweep.mean = wp.zeros(size, dtype=wp.vec3d, device=device)
    sweep.radius = wp.zeros(size, dtype=wp.float64, device=device)
    sweep.spread = wp.zeros(size, dtype=wp.float64, device=device)
    sweep.asked = wp.zeros(size, dtype=wp.int32, device=device)
    for name, count in (("edge", len(parts.level.edges)), ("face", len(parts.level.triangles))):
        for end in ("low", "high"):
            setattr(sweep, f"{name}_{end}", wp.zeros(count, dtype=wp.vec3f, device=device))
    return sweep
