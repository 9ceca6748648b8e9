"""Search of a level's cloth: near pairs, pairs that come too near on straight paths, and crossings.

Every search is complete and keeps nothing. It bounds all clusters at both ends of the move, finds pairs of clusters
not separated by an axis at both ends, and treats the parts of these clusters in the same way.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.kernels import KERNELS
from ..mesh.threads import argument, refit, run
from .boxes import Ask, Boxes, Query, arrays_of, bound_clusters, bound_parts, boxes_near, query_of
from .narrow_phase import SearchResults, check_pairs, find_candidates, find_pairs, judge_candidates
from .pairs import NearAt, Pairs, Reach
from .parts import Parts
from .topology import LANES, Topology

wp.set_module_options(KERNELS)


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
    """Clusters not separated from each queried cluster by an axis at both ends, each pair once.

    Pairs beyond the room are counted too.
    """
    i, j, n = first + wp.tid(), wp.int32(0), wp.int32(0)
    if boxes.queried[i]:
        around = wp.bvh_query_aabb(tree, boxes.low[i], boxes.high[i])
        while wp.bvh_query_next(around, j):
            if j >= query.clusters or (j < i and boxes.queried[j]):
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


@wp.kernel
def list_clusters(
    first: wp.int32,
    room: wp.int32,
    boxes: Boxes,
    slots: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    end: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
):
    """Write the pairs of each cluster up to `end`, sorted: the order in the tree depends on the pose at its making.

    Pairs without room are left out."""
    i = first + wp.tid()
    if count[i] > 0:
        boxes.met[i] = True
    for n in range(wp.min(count[i], room)):
        j = slots[i * room + n]
        k = wp.int32(n)
        boxes.met[j] = True
        while k > 0 and slots[i * room + k - 1] > j:
            slots[i * room + k] = slots[i * room + k - 1]
            k -= 1
        slots[i * room + k] = j
    for n in range(wp.min(wp.min(count[i], room), pairs.shape[0] - end[i] + count[i])):
        pairs[end[i] - count[i] + n] = wp.vec2i(i, slots[i * room + n])


def near_parts(
    parts: Parts,
    x: Float[Tensor, "vertices 3"],
    reach: Reach,
    *,
    queried: Bool[Tensor, " vertices"] | None = None,
    inside: Bool[Tensor, " vertices"] | None = None,
) -> NearAt:
    """All near pairs with cloth at x [m], without pairs of bodies and cloth inside a body.

    Arguments are as for `blocking_pairs`. In all searches, positions without the bodies' corners give pairs of cloth.
    """
    queried = _of_cloth(parts, x) if queried is None else queried
    arrays = arrays_of(
        x.double(), queried=queried, inside=inside, radius=reach.radius.double(), play=reach.play.double()
    )
    return NearAt(_search(parts, arrays, kind=Ask.NEAR, half=reach.half), reach)


def blocking_pairs(
    parts: Parts,
    start: Float[Tensor, "vertices 3"],
    end: Float[Tensor, "vertices 3"],
    *,
    floor: float,
    queried: Bool[Tensor, " vertices"],
    tangle: Int[Tensor, " vertices"] | None = None,
    inside: Bool[Tensor, " vertices"] | None = None,
    near: NearAt | None = None,
) -> Pairs:
    """All pairs of parts not kept apart by a plane on straight paths (`separation`), some of them twice.

    Given near pairs at the start, checks only near pairs, and pairs of vertices with large moves (`NearAt.leaving`).

    Args:
        start: Positions [m].
        end: End positions [m].
        floor: Gap that pairs keep [m]; a pair that is already closer keeps most of its distance.
        queried: Queried vertices; each pair contains at least one.
        tangle: The tangle of each vertex, int32, -1 outside tangles; pairs inside a single tangle are skipped; or None.
        inside: Cloth vertices inside a body, without pairs with bodies; or None.
        near: All near pairs with cloth at the start; None if unknown.
    """
    start, end = start.double(), end.double()

    def arrays(queried: Tensor) -> list[Tensor]:
        return arrays_of(start, end, queried=queried, tangle=tangle, inside=inside)

    blocking = Pairs.empty(0, queried.device)
    if near is not None:
        corners = near.pairs.corners
        are_queried = queried.index_select(0, corners.reshape(-1)).view_as(corners).any(dim=1)
        queried_pairs = near.pairs.where(are_queried)
        blocking = _blocking_among(queried_pairs, parts, query_of(arrays(queried), kind=Ask.MOVE, floor=floor))
        queried = queried & near.leaving(end - start, floor)
    if not bool(queried.any()):
        return blocking
    return blocking.joined(_search(parts, arrays(queried), kind=Ask.MOVE, floor=floor))


def blocking_and_near(
    parts: Parts,
    start: Float[Tensor, "vertices 3"],
    end: Float[Tensor, "vertices 3"],
    reach: Reach,
    *,
    floor: float,
    queried: Bool[Tensor, " vertices"] | None = None,
) -> tuple[Pairs, NearAt]:
    """All pairs blocking a move, and all near pairs at the end of the move, by one search.

    Arguments are as for `blocking_pairs`; ``queried`` contains all vertices able to move, and is all cloth when None.
    """
    queried = _of_cloth(parts, start) if queried is None else queried
    radius, play = reach.radius.double(), reach.play.double()
    arrays = arrays_of(start.double(), end.double(), queried=queried, radius=radius, play=play)
    pairs = _search(parts, arrays, kind=Ask.MOVE_NEAR, floor=floor, half=reach.half)
    blocks = pairs.value < 0.0
    blocking = pairs.where(blocks)
    near = pairs.where(~blocks) if len(blocking.face) else pairs
    return replace(blocking, value=blocking.value + 1.0), NearAt(near, reach)


def piercing_edges(
    parts: Parts, x: Float[Tensor, "vertices 3"], queried: Bool[Tensor, " vertices"] | None = None
) -> Int[Tensor, "crossings 2"]:
    """Indices of each crossing edge and face at x [m], sorted; clusters without a queried vertex may be left out."""
    queried = _of_cloth(parts, x) if queried is None else queried
    pairs = _search(parts, arrays_of(x.double(), queried=queried), kind=Ask.CROSSING).corners[:, :2].long()
    return pairs[torch.argsort(pairs[:, 0] * max(parts.faces, 1) + pairs[:, 1])]


def _of_cloth(parts: Parts, x: Tensor) -> Bool[Tensor, " vertices"]:
    return torch.arange(len(x), device=x.device) < parts.level.vertex_count


def _search(parts: Parts, arrays: Sequence[Tensor], *, kind: Ask, floor: float = 0.0, half: float = 0.0) -> Pairs:
    """All pairs of a query, ordered by cluster, given the arrays of `arrays_of`."""
    table, device = parts.topology, parts.level.device
    clusters = table.clusters if len(arrays[0]) > parts.level.vertex_count else table.cloth_clusters
    if not clusters:
        return Pairs.empty(0, device)

    def search_pass(*arrays: Tensor) -> tuple[Tensor, ...]:
        query = query_of(arrays, kind=kind, floor=floor, half=half)
        query.clusters = clusters
        return _search_pass(parts, query)

    while True:
        counts, order, *columns = parts.recordings.run((kind, floor, half, clusters), search_pass, *arrays)
        needed = counts.tolist()
        if not parts.room.lacks(*needed):
            break
        parts.recordings.clear()
    count = needed[-1]
    return Pairs(*(column[:count] for column in columns)).where(order[:count].argsort())


def _search_pass(parts: Parts, query: Any) -> tuple[Tensor, ...]:
    """One pass of a search with the present room.

    On a card each thread judges one candidate. If threads judged the candidates that they find, most threads would wait
    for a few.

    Returns:
        Largest number of partners of a cluster, and numbers of pairs of clusters, of candidates and of pairs of parts;
        the sort key of each pair of parts; and the fields of `Pairs`.
    """
    room, size, device, tree = parts.room, query.clusters, parts.level.device, parts.tree
    _launch(parts, bound_clusters, size, parts.topology, query, parts.boxes)
    refit(tree, device)
    slots = torch.empty(size * room.of_each, dtype=torch.int32, device=device)
    partner_counts = torch.empty(size, dtype=torch.int32, device=device)
    inputs = [parts.topology, query, parts.boxes, tree.id, room.of_each, argument(slots), argument(partner_counts)]
    _launch(parts, find_clusters, size, *inputs)
    last = partner_counts.cumsum(dim=0, dtype=torch.int32)
    near = torch.full((room.clusters, 2), -1, dtype=torch.int32, device=device)
    inputs = [argument(slots), argument(partner_counts), argument(last), argument(near, wp.vec2i)]
    _launch(parts, list_clusters, size, room.of_each, parts.boxes, *inputs)
    _launch(parts, bound_parts, size, parts.topology, query, parts.boxes)
    candidates, count = torch.zeros((2, 1), dtype=torch.int32, device=device)
    keys = [torch.empty(size, dtype=torch.int64, device=device) for size in (room.candidates, room.pairs)]
    out = Pairs.empty(room.pairs, device)
    candidate_parts = torch.empty((room.candidates, 3), dtype=torch.int32, device=device)
    results = SearchResults()
    results.candidates, results.count = wp.from_torch(candidates), wp.from_torch(count)
    results.candidate_key, results.key = (wp.from_torch(key) for key in keys)
    results.parts, results.corners = wp.from_torch(candidate_parts, wp.vec3i), wp.from_torch(out.corners, wp.vec4i)
    results.value, results.face = wp.from_torch(out.value), wp.from_torch(out.face)
    find = find_pairs if parts.tasks == 1 else find_candidates
    inputs = [parts.topology, argument(near, wp.vec2i), parts.tasks, query, parts.boxes, results]
    _launch(parts, find, len(near) * parts.tasks, *inputs)
    if find is find_candidates:
        _launch(parts, judge_candidates, room.candidates, parts.topology, query, results)
    counts = torch.stack([partner_counts.max(), last[-1], candidates[0], count[0]])
    return counts, keys[1], out.corners, out.value, out.face


def _blocking_among(pairs: Pairs, parts: Parts, query: Any) -> Pairs:
    value = torch.empty_like(pairs.value)
    inputs = [parts.topology, query, argument(pairs.corners, wp.vec4i), argument(pairs.face), argument(value)]
    _launch(parts, check_pairs, len(value), *inputs)
    return Pairs(pairs.corners, value, pairs.face).where(value < 1.0)


def _launch(parts: Parts, kernel: wp.Kernel, size: int, *inputs: object) -> None:
    """Run a kernel over clusters or pairs of clusters."""
    run(kernel, size, inputs, device=parts.level.device, threads=parts.level.threads)
