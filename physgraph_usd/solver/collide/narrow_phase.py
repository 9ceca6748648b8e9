"""Narrow phase: pairs of parts of near clusters that are near, or that would touch on straight paths."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.threads import LEAST_QUERIES, argument, run
from .boxes import Boxes, Motion, highest_of, lowest_of, outside, overlap, pass_by, room_of
from .broad_phase import launch
from .impact import distance_of, impact_of
from .parts import Parts
from .topology import Topology

wp.set_module_options(KERNELS)

ROOM, MOST_ROOM = 2**19, 64
"""Minimum room for pairs of parts, shared by the pairs of clusters, and most room for two clusters; cluster pairs with
more are searched twice."""


@wp.struct
class Found:
    """Output of a search: start and count of each cluster pair's pairs of parts, and the fields of `Pairs`."""

    begin: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    corners: wp.array(dtype=wp.vec4i)
    value: wp.array(dtype=wp.float64)
    face: wp.array(dtype=wp.bool)


@dataclass(frozen=True, eq=False)
class Reach:
    """Search radii of near pairs.

    Attributes:
        radius: Two parts are near within the sum of their radii, the largest of their corners' radii [m], shape (V,),
            float64.
        play: Parts of one garment are near only within `half` of their distance at rest plus twice the least play [m],
            shape (V,).
        half: Fraction of the distance at rest. Pairs proved by m of a patch to keep more are omitted at any play; a
            large number omits none.
    """

    radius: Float[Tensor, " vertices"]
    play: Float[Tensor, " vertices"]
    half: float


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of parts.

    Attributes:
        corners: A vertex and the corners of a face, or the ends of two edges, shape (N, 4).
        value: For impacts, the safe fraction of the paths, in (0, 1); for near pairs, the distance over the search
            distance; shape (N,).
        face: True for a vertex and a face, shape (N,).
    """

    corners: Int[Tensor, "pairs 4"]
    value: Float[Tensor, " pairs"]
    face: Bool[Tensor, " pairs"]

    @staticmethod
    def none(device: torch.device | str) -> Pairs:
        """No pairs."""
        return _room(0, device)

    def joined(self, other: Pairs) -> Pairs:
        """Both lists of pairs."""
        if not len(self.value) or not len(other.value):
            return self if len(self.value) else other
        parts = ((getattr(self, name), getattr(other, name)) for name in ("corners", "value", "face"))
        return Pairs(*(torch.cat(each) for each in parts))

    def where(self, kept: Bool[Tensor, " pairs"] | Int[Tensor, " kept"]) -> Pairs:
        """The selected pairs."""
        if kept.dtype == torch.bool:  # Once for all three.
            kept = torch.nonzero(kept).squeeze(1)
        return Pairs(self.corners[kept], self.value[kept], self.face[kept])


@wp.func
def has(t: wp.vec3i, v: wp.int32):
    """True if a triangle contains a vertex."""
    return t[0] == v or t[1] == v or t[2] == v


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
    """True if two vertices are equal, or sewn together."""
    return parts.label[a] == parts.label[b]


@wp.func
def sum_of(face: wp.bool, a: wp.float64, b: wp.float64, c: wp.float64, d: wp.float64):
    """Largest value in a pair's first part plus the largest in the second part."""
    if face:
        return a + wp.max(b, wp.max(c, d))
    return wp.max(a, b) + wp.max(c, d)


@wp.func
def box_gap(face: wp.bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Largest distance along an axis between the boxes of two parts."""
    low, high, other_low, other_high = a, a, wp.min(c, d), wp.max(c, d)
    if face:
        other_low, other_high = wp.min(b, other_low), wp.max(b, other_high)
    else:
        low, high = wp.min(a, b), wp.max(a, b)
    apart = wp.max(low - other_high, other_low - high)
    return wp.max(apart[0], wp.max(apart[1], apart[2]))


@wp.func
def boxes_apart(
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
    """True if the boxes of two parts are a floor apart along an axis, in equal order at the start and at the end."""
    low, high, other_low, other_high = a, a, wp.min(c, d), wp.max(c, d)
    to_low, to_high, other_to_low, other_to_high = e, e, wp.min(g, h), wp.max(g, h)
    if face:
        other_low, other_high = wp.min(b, other_low), wp.max(b, other_high)
        other_to_low, other_to_high = wp.min(f, other_to_low), wp.max(f, other_to_high)
    else:
        low, high = wp.min(a, b), wp.max(a, b)
        to_low, to_high = wp.min(e, f), wp.max(e, f)
    above = wp.min(low - other_high, to_low - other_to_high)
    below = wp.min(other_low - high, other_to_low - to_high)
    most = wp.max(above, below)
    return wp.max(most[0], wp.max(most[1], most[2])) >= floor


@wp.func
def nearness(face: wp.bool, a: wp.int32, b: wp.int32, c: wp.int32, d: wp.int32, parts: Topology, motion: Motion):
    """Distance of a pair of parts over its contact range, which is smaller for pairs near at rest; at most 1."""
    one = wp.float64(1.0)
    r, p, m = motion.radius, motion.play, motion.slack
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
def is_asked(motion: Motion, a: wp.int32, b: wp.int32, c: wp.int32, d: wp.int32):
    """True if a vertex of a pair is queried, and the vertices are not all in one tangle."""
    if not (motion.asked[a] or motion.asked[b] or motion.asked[c] or motion.asked[d]):
        return False
    tangle = motion.tangle[a]
    in_one = motion.tangle[b] == tangle and motion.tangle[c] == tangle and motion.tangle[d] == tangle
    return tangle < 0 or not in_one


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
    """Safe fraction of the paths of a vertex and a face, or of two edges; or their distance over the search distance.

    The value is 1 for skipped pairs.
    """
    none = wp.float64(1.0)
    if is_one(parts, a, c) or is_one(parts, a, d) or is_one(parts, b, wp.where(face, a, c)):
        return none
    if not face and is_one(parts, b, d):
        return none
    if not is_asked(motion, a, b, c, d):
        return none
    x, y, z, w = motion.start[a], motion.start[b], motion.start[c], motion.start[d]
    if motion.is_still:
        return nearness(face, a, b, c, d, parts, motion)
    u, v, p, q = motion.path[a], motion.path[b], motion.path[c], motion.path[d]
    if boxes_apart(face, x, y, z, w, x + u, y + v, z + p, w + q, motion.floor):
        return none
    return impact_of(face, x, y, z, w, u, v, p, q, motion.floor)


@wp.func
def faces_met(
    parts: Topology,
    motion: Motion,
    boxes: Boxes,
    found: Found,
    owner: wp.int32,
    i: wp.int32,
    j: wp.int32,
    count: wp.int32,
):
    """Write pairs of a cluster's vertices and another cluster's faces; returns the number of pairs so far."""
    reach = room_of(boxes, motion, i, j)
    for k in range(parts.first_vertex[i], parts.first_vertex[i + 1]):
        v = parts.vertices[k]
        if boxes.asked[j] == 0 and not motion.asked[v]:
            continue
        at = motion.start[v]
        way = motion.path[v] - boxes.mean[j]
        lowest = at + wp.min(way, wp.vec3d()) - wp.vec3d(reach + boxes.spread[j])
        highest = at + wp.max(way, wp.vec3d()) + wp.vec3d(reach + boxes.spread[j])
        if outside(lowest, highest, boxes.low[j], boxes.high[j], wp.float64(0.0)):
            continue
        low, high = lowest_of(lowest), highest_of(highest)
        for m in range(parts.first_face[j], parts.first_face[j + 1]):
            if not overlap(low, high, boxes.face_low[m], boxes.face_high[m]):
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
def edges_met(
    parts: Topology,
    motion: Motion,
    boxes: Boxes,
    found: Found,
    owner: wp.int32,
    i: wp.int32,
    j: wp.int32,
    count: wp.int32,
):
    """Write pairs of the edges of two clusters, each once; returns the number of pairs so far."""
    reach = room_of(boxes, motion, i, j)
    for k in range(parts.first_edge[i], parts.first_edge[i + 1]):
        e = parts.edges[k]
        if boxes.asked[j] == 0 and not motion.asked[e[0]] and not motion.asked[e[1]]:
            continue
        near, far = motion.start[e[0]], motion.start[e[1]]
        end, other = motion.path[e[0]] - boxes.mean[j], motion.path[e[1]] - boxes.mean[j]
        lowest = wp.min(near + wp.min(end, wp.vec3d()), far + wp.min(other, wp.vec3d()))
        highest = wp.max(near + wp.max(end, wp.vec3d()), far + wp.max(other, wp.vec3d()))
        lowest -= wp.vec3d(reach + boxes.spread[j])
        highest += wp.vec3d(reach + boxes.spread[j])
        if outside(lowest, highest, boxes.low[j], boxes.high[j], wp.float64(0.0)):
            continue
        low, high = lowest_of(lowest), highest_of(highest)
        for m in range(wp.where(i == j, k + 1, parts.first_edge[j]), parts.first_edge[j + 1]):
            if not overlap(low, high, boxes.edge_low[m], boxes.edge_high[m]):
                continue
            f = parts.edges[m]
            if e[0] == f[0] or e[0] == f[1] or e[1] == f[0] or e[1] == f[1]:
                continue
            value = value_of(False, e[0], e[1], f[0], f[1], parts, motion)
            if value < wp.float64(1.0):
                write(found, owner, count, wp.vec4i(e[0], e[1], f[0], f[1]), value, False)
                count += 1
    return count


@wp.kernel
def choose_clusters(
    first: wp.int32,
    parts: Topology,
    clusters: wp.array(dtype=wp.vec2i),
    motion: Motion,
    boxes: Boxes,
    asked: wp.array(dtype=wp.bool),
):
    """Keep the queried pairs of clusters that contain a queried vertex and do not pass by each other."""
    n = first + wp.tid()
    i, j = clusters[n][0], clusters[n][1]
    if not asked[n]:
        return
    if boxes.asked[i] == 0 and boxes.asked[j] == 0:
        asked[n] = False
    elif pass_by(boxes, i, j, room_of(boxes, motion, i, j)):
        asked[n] = False


@wp.kernel
def find_pairs(
    first: wp.int32, parts: Topology, clusters: wp.array(dtype=wp.vec2i), motion: Motion, boxes: Boxes, found: Found
):
    """Vertex-face and edge-edge pairs of each two clusters, up to the room."""
    n = first + wp.tid()
    i, j = clusters[n][0], clusters[n][1]
    if found.begin[n + 1] == found.begin[n]:
        return
    count = faces_met(parts, motion, boxes, found, n, i, j, 0)
    if i != j:
        count = faces_met(parts, motion, boxes, found, n, j, i, count)
    found.count[n] = edges_met(parts, motion, boxes, found, n, i, j, count)


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


@wp.kernel
def pack(
    first: wp.int32,
    room: wp.int32,
    found: Found,
    ends: wp.array(dtype=wp.int32),
    corners: wp.array(dtype=wp.vec4i),
    value: wp.array(dtype=wp.float64),
    face: wp.array(dtype=wp.bool),
    owner: wp.array(dtype=wp.int64),
):
    """Copy the pairs of parts of cluster pairs with enough room into one list, with the number of the cluster pair."""
    n = first + wp.tid()
    count = found.count[n]
    if count > room:
        return
    for k in range(count):
        place = ends[n] - count + k
        corners[place] = found.corners[found.begin[n] + k]
        value[place] = found.value[found.begin[n] + k]
        face[place] = found.face[found.begin[n] + k]
        owner[place] = wp.int64(n)


def find(
    parts: Parts,
    clusters: Int[Tensor, "clusters 2"],
    kernel: wp.Kernel,
    motion: Any,
    boxes: Any,
    *,
    room: int,
    asked: Bool[Tensor, " clusters"] | None = None,
) -> tuple[Pairs, Int[Tensor, " pairs"]]:
    """The pairs of parts found by a kernel, with the parameters of `find_pairs`, in pairs of clusters.

    Args:
        parts: The parts.
        clusters: The pairs of clusters, int32.
        kernel: The kernel.
        motion: Positions, displacements and query of the vertices.
        boxes: Boxes of the clusters in pairs.
        room: Minimum room for pairs of parts per two clusters before the pairs are counted.
        asked: Queried pairs of clusters; all if None.

    Returns:
        The pairs, and the cluster pair of each.
    """
    device = clusters.device
    asked = torch.ones(len(clusters), dtype=torch.bool, device=device) if asked is None else asked.clone()
    chosen = [argument(clusters, wp.vec2i), motion, boxes, argument(asked)]
    launch(parts, choose_clusters, len(clusters), *chosen)
    which = torch.nonzero(asked).squeeze(1)
    clusters, size = clusters[which], len(which)
    if not size:
        return _room(0, device), which
    inputs, room = (parts, clusters, kernel, motion, boxes), max(room, min(MOST_ROOM, ROOM // size))
    begin = torch.arange(size + 1, dtype=torch.int32, device=device) * room
    count = torch.zeros_like(begin[:size])
    found = _write(*inputs, begin=begin, count=count, out=_room(room * size, device))
    over = count > room
    ends = torch.where(over, 0, count).cumsum(dim=0, dtype=torch.int32)
    total, most = torch.stack([ends[-1], count.amax()]).tolist()
    first, owner = _packed(parts, found, ends, size=size, room=room, total=total)
    if most <= room:
        return first, which[owner]
    begin[0] = 0  # Those without room are written again, now that they are counted.
    begin[1:] = (count * over).cumsum(dim=0)
    rest = _room(int(begin[-1]), device)
    _write(*inputs, begin=begin, count=count, out=rest)
    more = torch.arange(size, device=device).repeat_interleave(count * over)
    return first.joined(rest), which[torch.cat([owner, more])]


def _packed(
    parts: Parts, found: Any, ends: Int[Tensor, " clusters"], *, size: int, room: int, total: int
) -> tuple[Pairs, Int[Tensor, " pairs"]]:
    """The pairs that had room, packed up to the given ends, and the cluster pair of each."""
    out, owner = _room(total, ends.device), torch.empty(total, dtype=torch.int64, device=ends.device)
    if total:
        arrays = (argument(out.corners, wp.vec4i), *(argument(each) for each in (out.value, out.face)))
        inputs = [room, found, argument(ends), *arrays, argument(owner)]
        run(pack, size, inputs, device=str(ends.device), threads=parts.level.threads)
    return out, owner


def _write(
    parts: Parts,
    clusters: Tensor,
    kernel: wp.Kernel,
    motion: Any,
    boxes: Any,
    *,
    begin: Tensor,
    count: Tensor,
    out: Pairs,
) -> Any:
    """Count the pairs of each two clusters, and write them up to the room; returns the output arrays."""
    found = Found()
    found.begin, found.count = wp.from_torch(begin), wp.from_torch(count)
    found.corners = wp.from_torch(out.corners, dtype=wp.vec4i)
    found.value, found.face = wp.from_torch(out.value), wp.from_torch(out.face)
    pairs = argument(clusters, wp.vec2i)
    launch(parts, kernel, len(clusters), pairs, motion, boxes, found, least=LEAST_QUERIES)
    return found


def of_list(parts: Parts, pairs: Pairs, motion: Any) -> Pairs:
    """Pairs of a list that would come too near on the paths of a motion."""
    if not len(pairs.value):
        return pairs
    value = torch.ones_like(pairs.value)
    inputs = [parts.topology, motion, argument(pairs.corners, wp.vec4i)]
    inputs += [argument(pairs.face), argument(value)]
    run(values_of, len(value), inputs, device=str(value.device), threads=parts.level.threads)
    met = torch.nonzero(value < 1.0).squeeze(1)
    return Pairs(pairs.corners[met], value[met], pairs.face[met])


def _room(count: int, device: torch.device | str) -> Pairs:
    """Uninitialized pairs."""
    corners = torch.empty((count, 4), dtype=torch.int32, device=device)
    value = torch.empty(count, dtype=torch.float64, device=device)
    return Pairs(corners, value, torch.empty(count, dtype=torch.bool, device=device))
