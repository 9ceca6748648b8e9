"""Search of a level's cloth: near pairs, pairs that come too near on straight paths, and crossings.

Every search is complete and keeps nothing: boxes of all clusters at both ends of the move, pairs of clusters that no
axis separates at both ends, and their parts in the same way.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.threads import argument, run
from .boxes import CROSSING, MOVE, MOVE_NEAR, NEAR, Boxes, Query, bound_clusters, bound_parts, boxes_near, query_of
from .narrow_phase import Found, check_pairs, find_pairs
from .pairs import NearAt, Pairs, Reach
from .parts import Parts
from .topology import LANES, Topology

wp.set_module_options(KERNELS)

CLUSTERS = 32
"""Room for pairs of clusters per cluster before these are counted."""
PAIRS, LEAST, MOST = 2**19, 16, 64
"""Room for pairs of parts, shared by pairs of clusters, and its bounds for each; what has no room is searched twice."""


@wp.kernel
def find_clusters(
    first: wp.int32,
    parts: Topology,
    query: Query,
    boxes: Boxes,
    tree: wp.uint64,
    room: wp.int32,
    out: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
):
    """Clusters that no axis keeps away from each queried one at both ends, each pair once; counted without room too."""
    i, j, n = first + wp.tid(), wp.int32(0), wp.int32(0)
    if boxes.asked[i]:
        around = wp.bvh_query_aabb(tree, boxes.low[i], boxes.high[i])
        while wp.bvh_query_next(around, j):
            if j >= query.clusters or (j < i and boxes.asked[j]):
                continue
            if parts.meets[parts.garment[i] * parts.garments + parts.garment[j]] == 0:
                continue
            room_of_both = boxes.radius[i] + boxes.radius[j]
            near = boxes_near(boxes.clusters, i, boxes.clusters, j // LANES, 1, room_of_both)
            if (wp.int32(near) >> (j % LANES)) & 1 == 1:
                if n < room:
                    out[i * room + n] = j
                n += 1
    count[i] = n


def near_parts(
    parts: Parts,
    x: Float[Tensor, "vertices 3"],
    reach: Reach,
    *,
    asked: Bool[Tensor, " vertices"] | None = None,
    inside: Bool[Tensor, " vertices"] | None = None,
) -> NearAt:
    """All near pairs that contain cloth at x [m], but not of cloth inside a body with bodies.

    Arguments are as for `blocking_pairs`. Positions of the cloth alone give pairs of the cloth alone, in all searches.
    """
    asked = _of_cloth(parts, x) if asked is None else asked
    given = {"radius": reach.radius.double(), "play": reach.play.double(), "half": reach.half}
    return NearAt(_search(parts, query_of(x.double(), kind=NEAR, asked=asked, inside=inside, **given)), reach)


def blocking_pairs(
    parts: Parts,
    start: Float[Tensor, "vertices 3"],
    end: Float[Tensor, "vertices 3"],
    *,
    floor: float,
    asked: Bool[Tensor, " vertices"],
    tangle: Int[Tensor, " vertices"] | None = None,
    inside: Bool[Tensor, " vertices"] | None = None,
    near: NearAt | None = None,
) -> Pairs:
    """All pairs of parts that no plane keeps apart on straight paths (`separation`), some of them twice.

    With near pairs at the start, only these are checked, and other pairs of vertices that move too far for parts that
    are not near (`NearAt.leaving`).

    Args:
        parts: The parts.
        start: Positions [m].
        end: End positions [m].
        floor: Gap that pairs keep [m]; a pair that is already closer keeps most of its distance.
        asked: Vertices of which each pair must contain at least one.
        tangle: The tangle of each vertex, int32, -1 outside tangles; pairs inside a single tangle are skipped; or None.
        inside: Cloth vertices inside a body, whose pairs with bodies are skipped; or None.
        near: All near pairs at the start that contain cloth and may block; None if unknown.
    """
    given = {"kind": MOVE, "floor": floor, "asked": asked, "tangle": tangle, "inside": inside}
    start, end = start.double(), end.double()
    if near is None:
        return _search(parts, query_of(start, end, **given)) if bool(asked.any()) else Pairs.empty(0, asked.device)
    found = _blocking_among(near.pairs, parts, query_of(start, end, **given))
    given["asked"] = asked & near.leaving(end - start, floor)
    if not bool(given["asked"].any()):
        return found
    return found.joined(_search(parts, query_of(start, end, **given)))


def blocking_and_near(
    parts: Parts,
    start: Float[Tensor, "vertices 3"],
    end: Float[Tensor, "vertices 3"],
    reach: Reach,
    *,
    floor: float,
    asked: Bool[Tensor, " vertices"] | None = None,
) -> tuple[Pairs, NearAt]:
    """All pairs that block a move, and all near pairs at its end, by one search.

    Arguments are as for `blocking_pairs`; ``asked`` contains all vertices that may move, and is all cloth when None.
    """
    asked = _of_cloth(parts, start) if asked is None else asked
    given = {"radius": reach.radius.double(), "play": reach.play.double(), "half": reach.half, "floor": floor}
    found = _search(parts, query_of(start.double(), end.double(), kind=MOVE_NEAR, asked=asked, **given))
    blocking, near = (found.where(mask) for mask in (found.value < 0.0, found.value >= 0.0))
    return replace(blocking, value=blocking.value + 1.0), NearAt(near, reach)


def piercing_edges(
    parts: Parts, x: Float[Tensor, "vertices 3"], asked: Bool[Tensor, " vertices"] | None = None
) -> Int[Tensor, "crossings 2"]:
    """Indices of each edge and face that cross at x [m], sorted; clusters without an asked vertex may be left out."""
    asked = _of_cloth(parts, x) if asked is None else asked
    found = _search(parts, query_of(x.double(), kind=CROSSING, asked=asked)).corners[:, :2].long()
    return found[torch.argsort(found[:, 0] * max(parts.faces, 1) + found[:, 1])]


def _of_cloth(parts: Parts, x: Tensor) -> Bool[Tensor, " vertices"]:
    """Mask of the cloth's vertices."""
    return torch.arange(len(x), device=x.device) < parts.level.vertex_count


def _search(parts: Parts, query: Any) -> Pairs:
    """The pairs of parts of a query."""
    table = parts.topology
    query.clusters = table.clusters if len(query.start) > parts.level.vertex_count else table.cloth_clusters
    if not query.clusters:
        return Pairs.empty(0, parts.level.device)
    tree = parts.tree
    _launch(parts, bound_clusters, query.clusters, query, parts.boxes)
    tree.refit()
    clusters = _near_clusters(parts, query, tree)
    if not len(clusters):
        return Pairs.empty(0, clusters.device)
    which = torch.zeros(parts.topology.clusters, dtype=torch.bool, device=clusters.device)
    which[clusters.reshape(-1).long()] = True
    active = torch.nonzero(which).squeeze(1).int()
    _launch(parts, bound_parts, len(active), query, argument(active), parts.boxes)
    return _pairs_of(parts, clusters, query)


def _blocking_among(pairs: Pairs, parts: Parts, query: Any) -> Pairs:
    """The pairs that block a query's move."""
    value = torch.empty_like(pairs.value)
    inputs = [query, argument(pairs.corners, wp.vec4i), argument(pairs.face), argument(value)]
    _launch(parts, check_pairs, len(value), *inputs)
    return Pairs(pairs.corners, value, pairs.face).where(value < 1.0)


def _near_clusters(parts: Parts, query: Any, tree: wp.Bvh) -> Int[Tensor, "pairs 2"]:
    """Pairs of clusters that no axis separates at both ends, int32."""
    size, room, device = query.clusters, CLUSTERS, parts.level.device
    while True:
        slots = torch.empty((size, room), dtype=torch.int32, device=device)
        count = torch.empty(size, dtype=torch.int32, device=device)
        inputs = [query, parts.boxes, tree.id, room, argument(slots.view(-1)), argument(count)]
        _launch(parts, find_clusters, size, *inputs)
        most = int(count.max())
        if most <= room:
            break
        room = most
    total = int(count.sum())
    first = torch.arange(size, dtype=torch.int32, device=device).repeat_interleave(count, output_size=total)
    second = slots.view(-1)[_used(torch.arange(size, device=device) * room, count, total)]
    order = torch.argsort(first.long() * size + second)  # Not the tree's, which the pose decides in which it was built.
    return torch.stack([first[order], second[order]], dim=1)


def _pairs_of(parts: Parts, clusters: Int[Tensor, "clusters 2"], query: Any) -> Pairs:
    """The pairs of parts in pairs of clusters; what has no room is searched again, now that it is counted."""
    size, device = len(clusters), clusters.device
    room = min(max(PAIRS // size, LEAST), MOST)
    begin = torch.arange(size + 1, dtype=torch.int32, device=device) * room
    found, count = _write(parts, clusters, query, begin)
    kept = torch.where(count <= room, count, 0)
    found = found.where(_used(begin[:-1], kept, int(kept.sum())))
    over = torch.nonzero(count > room).squeeze(1)
    if not len(over):
        return found
    begin = torch.nn.functional.pad(count[over].cumsum(dim=0, dtype=torch.int32), (1, 0))
    return found.joined(_write(parts, clusters[over], query, begin)[0])


def _used(begin: Int[Tensor, " rows"], count: Int[Tensor, " rows"], total: int) -> Int[Tensor, " total"]:
    """Places in use: ``count`` of each row, from ``begin`` on."""
    before = begin - (count.cumsum(dim=0) - count)
    return before.repeat_interleave(count, output_size=total) + torch.arange(total, device=count.device)


def _write(
    parts: Parts, clusters: Int[Tensor, "clusters 2"], query: Any, begin: Int[Tensor, " bounds"]
) -> tuple[Pairs, Int[Tensor, " clusters"]]:
    """The pairs of parts of each two clusters from given places on, and their number."""
    count = torch.zeros(len(clusters), dtype=torch.int32, device=clusters.device)
    out, found = Pairs.empty(int(begin[-1]), clusters.device), Found()
    found.begin, found.count = wp.from_torch(begin), wp.from_torch(count)
    found.corners = wp.from_torch(out.corners, dtype=wp.vec4i)
    found.value, found.face = wp.from_torch(out.value), wp.from_torch(out.face)
    inputs = [argument(clusters.contiguous(), wp.vec2i), query, parts.boxes, found]
    _launch(parts, find_pairs, len(clusters), *inputs)
    return out, count


def _launch(parts: Parts, kernel: wp.Kernel, size: int, *inputs: object) -> None:
    """Run a kernel over clusters or pairs of clusters."""
    run(kernel, size, [parts.topology, *inputs], device=parts.level.device, threads=parts.level.threads)
