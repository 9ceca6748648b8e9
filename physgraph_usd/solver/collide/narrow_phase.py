"""Narrow phase: pairs of parts of two clusters that are near, come too near on straight paths, or cross."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

from typing import Any, cast

import warp as wp

from ..mesh.kernels import ALONE, KERNELS
from ..mesh.piercing import passes_through
from .boxes import Ask, Boxes, Query, boxes_near, lowest_bit, without_lowest
from .separation import distance_of, gap_along, safe_fraction
from .topology import LANES, Part, Topology

wp.set_module_options(KERNELS)

WITHIN = wp.constant(wp.float64(20.0))
"""Largest distance at which edges and vertices of a body push cloth, in plays; an edge is twenty plays long."""
ALL = wp.constant(8)
"""Most blocks compared at a time."""
PAIR_KINDS = wp.constant(3)
"""Kinds of pairs of two clusters: parts of the first with faces of the second, the reverse, and edges with edges."""


@wp.struct
class SearchResults:
    """Output of a search, in any order; results beyond the room are counted too.

    Attributes:
        candidates: Number of noted pairs of parts whose boxes meet, shape (1,).
        candidate_key: Sort key of each candidate.
        parts: Kind of the first part of each candidate, and numbers of both parts.
        count: Number of results, shape (1,).
        key: Sort key of each result.
        corners, value, face: The fields of `Pairs`.
    """

    candidates: wp.array(dtype=wp.int32)
    candidate_key: wp.array(dtype=wp.int64)
    parts: wp.array(dtype=wp.vec3i)
    count: wp.array(dtype=wp.int32)
    key: wp.array(dtype=wp.int64)
    corners: wp.array(dtype=wp.vec4i)
    value: wp.array(dtype=wp.float64)
    face: wp.array(dtype=wp.bool)


@wp.func
def sum_of(face: wp.bool, a: wp.float64, b: wp.float64, c: wp.float64, d: wp.float64):
    """Largest value in a pair's first part plus the largest in the second part."""
    if face:
        return a + wp.max(b, wp.max(c, d))
    return wp.max(a, b) + wp.max(c, d)


@wp.func
def nearness(face: wp.bool, c: wp.vec4i, parts: Topology, query: Query, within: wp.float64):
    """Distance of a pair at the end over the search distance, at most 1; pairs near at rest have a smaller distance."""
    p, rest = query.play, parts.rest
    distance = distance_of(face, query.end[c[0]], query.end[c[1]], query.end[c[2]], query.end[c[3]])
    if distance < within and parts.owner[c[0]] == parts.owner[c[3]]:
        at_rest = distance_of(face, rest[c[0]], rest[c[1]], rest[c[2]], rest[c[3]])
        play = sum_of(face, p[c[0]], p[c[1]], p[c[2]], p[c[3]])
        within = wp.min(within, query.half * at_rest + play)
    return wp.min(distance / within, wp.float64(1.0))


@wp.func
def is_queried(parts: Topology, query: Query, c: wp.vec4i):
    """True if a vertex of a pair is queried; not for cloth in one tangle, nor for cloth inside a body and the body."""
    if not (query.queried[c[0]] or query.queried[c[1]] or query.queried[c[2]] or query.queried[c[3]]):
        return False
    if parts.owner[c[0]] >= parts.cloths or parts.owner[c[3]] >= parts.cloths:
        return not (query.inside[c[0]] or query.inside[c[1]] or query.inside[c[2]] or query.inside[c[3]])
    tangle = query.tangle[c[0]]
    in_one = query.tangle[c[1]] == tangle and query.tangle[c[2]] == tangle and query.tangle[c[3]] == tangle
    return tangle < 0 or not in_one


@wp.func
def value_of(face: wp.bool, c: wp.vec4i, parts: Topology, query: Query):
    """Safe fraction of the paths of a vertex and a face or of two edges, or their distance over the search distance.

    The value is 1 for pairs that are not written. Most of these are separated along the line through their middles. If
    moves and near pairs are searched together, the safe fraction is less by 1, and thus negative.
    """
    one, zero = wp.float64(1.0), wp.vec3d()
    if not is_queried(parts, query, c):
        return one
    at, to = query.start[c[0]], query.end[c[0]]
    b, d, f = query.start[c[1]] - at, query.start[c[2]] - at, query.start[c[3]] - at
    v, p, q = query.end[c[1]] - to, query.end[c[2]] - to, query.end[c[3]] - to
    middles = wp.where(face, -(b + d + f), wp.float64(1.5) * (b - d - f))
    r = query.radius
    room = wp.max(query.floor, sum_of(face, r[c[0]], r[c[1]], r[c[2]], r[c[3]]))
    least = room * wp.length(middles)
    if gap_along(middles, face, zero, b, d, f) >= least and gap_along(middles, face, zero, v, p, q) >= least:
        return one
    if query.kind != Ask.NEAR:
        fraction = safe_fraction(face, b, d, f, v - b, p - d, q - f, query.floor)
        if query.kind == Ask.MOVE:
            return fraction
        if fraction < one:
            return fraction - one
    with_body = parts.owner[c[0]] >= parts.cloths or parts.owner[c[3]] >= parts.cloths
    if with_body and not (face and parts.owner[c[0]] < parts.cloths):
        # A body's edges and vertices matter to cloth with larger faces; else the cloth's vertices see the body's faces.
        play = query.play
        room = wp.min(room, WITHIN * wp.max(wp.max(play[c[0]], play[c[1]]), wp.max(play[c[2]], play[c[3]])))
    return nearness(face, c, parts, query, room)


@wp.func
def is_pierced(query: Query, e: wp.vec3i, t: wp.vec3i):
    """True if an edge passes through a face."""
    x = query.start
    return passes_through(x[e[0]], x[e[1]], t, x[t[0]], x[t[1]], x[t[2]])


@wp.func
def shares(p: wp.vec3i, q: wp.vec3i):
    """True if two parts share a vertex, by the labels of their corners."""
    first = p[0] == q[0] or p[0] == q[1] or p[0] == q[2]
    second = p[1] == q[0] or p[1] == q[1] or p[1] == q[2]
    return first or second or p[2] == q[0] or p[2] == q[1] or p[2] == q[2]


@wp.func
def blocks_left(parts: Topology, kind: wp.int32, i: wp.int32, block: wp.int32):
    """Number of blocks of a cluster from a given block on, up to `ALL`."""
    return wp.min(ALL, parts.first[kind * (parts.clusters + 1) + i + 1] - block)


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    return atomicAdd(count.data, 1);
#else
    return __atomic_fetch_add(count.data, 1, __ATOMIC_RELAXED);
#endif
"""
)
def next_slot(count: wp.array(dtype=wp.int32)) -> wp.int32:
    """The count before it is increased by 1; unlike Warp's `atomic_add`, atomic on the CPU too."""
    ...


@wp.func
def write(
    parts: Topology, query: Query, results: SearchResults, key: wp.int64, first: wp.int32, k: wp.int32, m: wp.int32
):
    """Append a pair of parts to the results if its value is below 1; for crossings edge and face numbers as corners."""
    p, q = parts.parts[k], parts.parts[m]
    c = wp.vec4i(p[0], q[0], q[1], q[2])
    if first == Part.EDGE:
        c = wp.vec4i(p[0], p[1], q[0], q[1])
    value = wp.float64(0.0)
    if query.kind != Ask.CROSSING:
        value = value_of(first == Part.VERTEX, c, parts, query)
    elif is_pierced(query, p, q):
        c = wp.vec4i(parts.number[k], parts.number[m], 0, 0)
    else:
        value = wp.float64(1.0)
    if value >= wp.float64(1.0):
        return
    slot = next_slot(results.count)
    if slot < results.key.shape[0]:
        results.key[slot] = key
        results.corners[slot] = c
        results.value[slot] = value
        results.face[slot] = first == Part.VERTEX


@wp.func
def note(
    parts: Topology, query: Query, results: SearchResults, key: wp.int64, first: wp.int32, k: wp.int32, m: wp.int32
):
    """Note two parts as candidates."""
    slot = next_slot(results.candidates)
    if slot < results.candidate_key.shape[0]:
        results.candidate_key[slot] = key
        results.parts[slot] = wp.vec3i(first, k, m)


def _kind_search(put: Any) -> Any:
    """Warp function: calls `write` or `note` with each pair of parts of two clusters whose boxes meet."""

    @wp.func
    def search_kind(
        parts: Topology,
        query: Query,
        boxes: Boxes,
        results: SearchResults,
        first: wp.int32,
        second: wp.int32,
        i: wp.int32,
        j: wp.int32,
        key: wp.int64,
        share: wp.int32,
        bits: wp.int32,
    ):
        """Call ``put`` for pairs of parts, of cluster i those whose numbers end in ``share``; returns the next key."""
        room, size, alike = boxes.radius[i] + boxes.radius[j], parts.clusters + 1, first == second and i == j
        for b in range(parts.first[first * size + i], parts.first[first * size + i + 1], ALL):
            near = boxes_near(boxes.clusters, j, boxes.parts, b, blocks_left(parts, first, i, b), room)
            while near != wp.uint64(0):
                k = LANES * b + lowest_bit(near)
                near = without_lowest(near)
                if k & bits != share:
                    continue
                p = parts.parts[k]
                if not (boxes.queried[j] or query.queried[p[0]] or query.queried[p[1]] or query.queried[p[2]]):
                    continue
                begin = wp.where(alike, k // LANES, parts.first[second * size + j])  # Each pair of edges once.
                for c in range(begin, parts.first[second * size + j + 1], ALL):
                    partners = boxes_near(boxes.parts, k, boxes.parts, c, blocks_left(parts, second, j, c), room)
                    while partners != wp.uint64(0):
                        m = LANES * c + lowest_bit(partners)
                        partners = without_lowest(partners)
                        if (not alike or k < m) and not shares(parts.labels[k], parts.labels[m]):
                            put(parts, query, results, key, first, k, m)
                            key += wp.int64(1)
        return key

    return search_kind


def _finder(put: Any, name: str) -> wp.Kernel:
    """Kernel over pairs of clusters that calls `write` or `note` with each pair of parts whose boxes meet."""
    search_kind = _kind_search(put)

    def find(
        start: wp.int32,
        parts: Topology,
        clusters: wp.array(dtype=wp.vec2i),
        tasks: wp.int32,
        query: Query,
        boxes: Boxes,
        results: SearchResults,
    ):
        """Search pairs of clusters, each in one task or in a task for each kind and share.

        Pairs with negative numbers are skipped. With several tasks, their number is a power of two times `PAIR_KINDS`.
        """
        task = start + wp.tid()
        n, subtask = task // tasks, task % tasks
        i, j = clusters[n][0], clusters[n][1]
        if i < 0:
            return
        share, bits = subtask // PAIR_KINDS, wp.max(tasks // PAIR_KINDS, 1) - 1
        kind, key = wp.where(tasks == 1, -1, subtask % PAIR_KINDS), wp.int64(task) << wp.int64(20)
        first_kind, second_kind = wp.where(query.kind == Ask.CROSSING, Part.EDGE, Part.VERTEX), Part.FACE
        if kind <= 0:
            key = search_kind(parts, query, boxes, results, first_kind, second_kind, i, j, key, share, bits)
        if i != j and (kind < 0 or kind == 1):
            key = search_kind(parts, query, boxes, results, first_kind, second_kind, j, i, key, share, bits)
        if query.kind != Ask.CROSSING and (kind < 0 or kind == 2):
            key = search_kind(parts, query, boxes, results, Part.EDGE, Part.EDGE, i, j, key, share, bits)

    return cast(wp.Kernel, wp.kernel(find, name=name, **ALONE))


find_pairs, find_candidates = _finder(write, "find_pairs"), _finder(note, "find_candidates")


@wp.kernel
def judge_candidates(start: wp.int32, parts: Topology, query: Query, results: SearchResults):
    """Evaluate all candidates and write results."""
    i = start + wp.tid()
    if i < results.candidates[0]:
        candidate = results.parts[i]
        write(parts, query, results, results.candidate_key[i], candidate[0], candidate[1], candidate[2])


@wp.kernel
def check_pairs(
    start: wp.int32,
    parts: Topology,
    query: Query,
    corners: wp.array(dtype=wp.vec4i),
    face: wp.array(dtype=wp.bool),
    value: wp.array(dtype=wp.float64),
):
    """Values of given pairs."""
    i = start + wp.tid()
    value[i] = value_of(face[i], corners[i], parts, query)
