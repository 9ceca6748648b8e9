"""Search of a level's cloth: near pairs, pairs that come too near on straight paths, and crossings.

Every search is complete and keeps nothing. It bounds all clusters at both ends of the move, finds pairs of clusters
not separated by an axis at both ends, and treats the parts of these clusters in the same way.
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
from .boxes import Ask, Boxes, Query, bound_clusters, bound_parts, boxes_near, query_of
from .narrow_phase import PAIR_KINDS, Found, check_pairs, find_pairs
from .pairs import NearAt, Pairs, Reach
from .parts import Parts
from .topology import LANES, Topology

wp.set_module_options(KERNELS)

PAIRS, TASK_PAIRS = 2**21, 16
"""Room for pairs of parts, of all tasks, and at least of a task. Without enough room a search runs twice: with 2**19
frames of the sample `layers` take 1.15 times as long."""
TASKS, THREADS = 4 * PAIR_KINDS, 2**18
"""Tasks of a pair of clusters on CUDA, each with one kind of pairs and every fourth part; and threads running at once.
With more tasks than threads, a single task per pair is faster: tasks repeat box tests."""


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
    """Clusters not separated from each queried cluster by an axis at both ends; each pair once, counted even without
    room."""
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


@wp.kernel
def list_clusters(
    first: wp.int32,
    room: wp.int32,
    boxes: Boxes,
    found: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    end: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
):
    """Write the pairs of each cluster up to `end`, sorted: the order in the tree depends on the pose at its making."""
    i = first + wp.tid()
    if count[i] > 0:
        boxes.met[i] = True
    for n in range(count[i]):
        j = found[i * room + n]
        k = wp.int32(n)
        boxes.met[j] = True
        while k > 0 and found[i * room + k - 1] > j:
            found[i * room + k] = found[i * room + k - 1]
            k -= 1
        found[i * room + k] = j
    for n in range(count[i]):
        pairs[end[i] - count[i] + n] = wp.vec2i(i, found[i * room + n])


@wp.kernel
def gather_pairs(
    first: wp.int32,
    room: wp.int32,
    corners: wp.array(dtype=wp.vec4i),
    value: wp.array(dtype=wp.float64),
    face: wp.array(dtype=wp.bool),
    end: wp.array(dtype=wp.int32),
    out_corners: wp.array(dtype=wp.vec4i),
    out_value: wp.array(dtype=wp.float64),
    out_face: wp.array(dtype=wp.bool),
):
    """Write the pairs of each task, from the end of the previous task on."""
    i = first + wp.tid()
    begin = wp.int32(0)
    if i > 0:
        begin = end[i - 1]
    for n in range(end[i] - begin):
        out_corners[begin + n] = corners[i * room + n]
        out_value[begin + n] = value[i * room + n]
        out_face[begin + n] = face[i * room + n]


def near_parts(
    parts: Parts,
    x: Float[Tensor, "vertices 3"],
    reach: Reach,
    *,
    asked: Bool[Tensor, " vertices"] | None = None,
    inside: Bool[Tensor, " vertices"] | None = None,
) -> NearAt:
    """All near pairs with cloth at x [m], without pairs of bodies and cloth inside a body.

    Arguments are as for `blocking_pairs`. Positions of the cloth alone give pairs of the cloth alone, in all searches.
    """
    asked = _of_cloth(parts, x) if asked is None else asked
    given = {"radius": reach.radius.double(), "play": reach.play.double(), "half": reach.half}
    return NearAt(_search(parts, query_of(x.double(), kind=Ask.NEAR, asked=asked, inside=inside, **given)), reach)


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
    """All pairs of parts not kept apart by a plane on straight paths (`separation`), some of them twice.

    Given near pairs at the start, checks only near pairs, and pairs of vertices with large moves (`NearAt.leaving`).

    Args:
        start: Positions [m].
        end: End positions [m].
        floor: Gap that pairs keep [m]; a pair that is already closer keeps most of its distance.
        asked: Queried vertices; each pair contains at least one.
        tangle: The tangle of each vertex, int32, -1 outside tangles; pairs inside a single tangle are skipped; or None.
        inside: Cloth vertices inside a body, without pairs with bodies; or None.
        near: All near pairs with cloth at the start; None if unknown.
    """
    given = {"kind": Ask.MOVE, "floor": floor, "asked": asked, "tangle": tangle, "inside": inside}
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
    """All pairs blocking a move, and all near pairs at the end of the move, by one search.

    Arguments are as for `blocking_pairs`; ``asked`` contains all vertices able to move, and is all cloth when None.
    """
    asked = _of_cloth(parts, start) if asked is None else asked
    given = {"radius": reach.radius.double(), "play": reach.play.double(), "half": reach.half, "floor": floor}
    found = _search(parts, query_of(start.double(), end.double(), kind=Ask.MOVE_NEAR, asked=asked, **given))
    blocks = found.value < 0.0
    blocking = found.where(blocks)
    near = found.where(~blocks) if len(blocking.face) else found
    return replace(blocking, value=blocking.value + 1.0), NearAt(near, reach)


def piercing_edges(
    parts: Parts, x: Float[Tensor, "vertices 3"], asked: Bool[Tensor, " vertices"] | None = None
) -> Int[Tensor, "crossings 2"]:
    """Indices of each crossing edge and face at x [m], sorted; clusters without a queried vertex may be left out."""
    asked = _of_cloth(parts, x) if asked is None else asked
    found = _search(parts, query_of(x.double(), kind=Ask.CROSSING, asked=asked)).corners[:, :2].long()
    return found[torch.argsort(found[:, 0] * max(parts.faces, 1) + found[:, 1])]


def _of_cloth(parts: Parts, x: Tensor) -> Bool[Tensor, " vertices"]:
    return torch.arange(len(x), device=x.device) < parts.level.vertex_count


def _search(parts: Parts, query: Any) -> Pairs:
    table = parts.topology
    query.clusters = table.clusters if len(query.start) > parts.level.vertex_count else table.cloth_clusters
    if not query.clusters:
        return Pairs.empty(0, parts.level.device)
    clusters = _near_clusters(parts, query, parts.tree)
    if not len(clusters):
        return Pairs.empty(0, clusters.device)
    _launch(parts, bound_parts, query.clusters, parts.topology, query, parts.boxes)
    return _pairs_of(parts, clusters, query)


def _blocking_among(pairs: Pairs, parts: Parts, query: Any) -> Pairs:
    value = torch.empty_like(pairs.value)
    inputs = [parts.topology, query, argument(pairs.corners, wp.vec4i), argument(pairs.face), argument(value)]
    _launch(parts, check_pairs, len(value), *inputs)
    return Pairs(pairs.corners, value, pairs.face).where(value < 1.0)


def _near_clusters(parts: Parts, query: Any, tree: wp.Bvh) -> Int[Tensor, "pairs 2"]:
    """Pairs of clusters not separated by an axis at both ends, sorted, int32; bounds the clusters."""
    size, device = query.clusters, parts.level.device
    _launch(parts, bound_clusters, size, parts.topology, query, parts.boxes)
    tree.refit()
    while True:
        room = parts.room
        slots = torch.empty(size * room, dtype=torch.int32, device=device)
        count = torch.empty(size, dtype=torch.int32, device=device)
        inputs = [parts.topology, query, parts.boxes, tree.id, room, argument(slots), argument(count)]
        _launch(parts, find_clusters, size, *inputs)
        end = count.cumsum(dim=0, dtype=torch.int32)
        total, most = torch.stack([end[-1], count.max()]).tolist()
        if most <= room:
            break
        parts.room = most
    out = torch.empty((total, 2), dtype=torch.int32, device=device)
    inputs = [argument(slots), argument(count), argument(end), argument(out, wp.vec2i)]
    _launch(parts, list_clusters, size, room, parts.boxes, *inputs)
    return out


def _pairs_of(parts: Parts, clusters: Int[Tensor, "clusters 2"], query: Any) -> Pairs:
    """The pairs of parts in pairs of clusters; pairs of clusters without enough room are searched again."""
    size = len(clusters)
    tasks = _tasks(size, cuda=clusters.is_cuda)
    room = max(PAIRS // (size * tasks), TASK_PAIRS)
    begin = torch.arange(0, (size * tasks + 1) * room, room, dtype=torch.int32, device=clusters.device)
    found, count = _write(parts, clusters, query, begin, size * tasks * room, tasks=tasks)
    count = count.reshape(size, tasks)
    fits = (count <= room).all(dim=1)
    end = torch.where(fits.unsqueeze(1), count, 0).reshape(-1).cumsum(dim=0, dtype=torch.int32)
    total, fitting = torch.stack([end[-1].long(), fits.sum()]).tolist()
    out = Pairs.empty(total, clusters.device)
    _launch(parts, gather_pairs, size * tasks, room, *_arguments(found), argument(end), *_arguments(out))
    if fitting == size:
        return out
    over = torch.nonzero(~fits).squeeze(1)
    begin = torch.nn.functional.pad(count[over].reshape(-1).cumsum(dim=0, dtype=torch.int32), (1, 0))
    return out.joined(_write(parts, clusters[over], query, begin, int(begin[-1]), tasks=tasks)[0])


def _tasks(size: int, *, cuda: bool) -> int:
    """Number of tasks of each of some pairs of clusters."""
    return TASKS if cuda and TASKS * size <= THREADS else 1


def _write(
    parts: Parts,
    clusters: Int[Tensor, "clusters 2"],
    query: Any,
    begin: Int[Tensor, " bounds"],
    room: int,
    *,
    tasks: int,
) -> tuple[Pairs, Int[Tensor, " tasks"]]:
    """The pairs of parts of each task from given places on, and the number of pairs of each task."""
    out, found = Pairs.empty(room, clusters.device), Found()
    count = torch.zeros(len(clusters) * tasks, dtype=torch.int32, device=clusters.device)
    found.begin, found.count = wp.from_torch(begin), wp.from_torch(count)
    found.corners = wp.from_torch(out.corners, dtype=wp.vec4i)
    found.value, found.face = wp.from_torch(out.value), wp.from_torch(out.face)
    inputs = [parts.topology, argument(clusters, wp.vec2i), tasks, query, parts.boxes, found]
    _launch(parts, find_pairs, len(clusters) * tasks, *inputs)
    return out, count


def _arguments(pairs: Pairs) -> list[Any]:
    return [argument(pairs.corners, wp.vec4i), argument(pairs.value), argument(pairs.face)]


def _launch(parts: Parts, kernel: wp.Kernel, size: int, *inputs: object) -> None:
    """Run a kernel over clusters or pairs of clusters."""
    run(kernel, size, inputs, device=parts.level.device, threads=parts.level.threads)
