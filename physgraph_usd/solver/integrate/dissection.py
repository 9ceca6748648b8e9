"""Nested dissection (George 1973): a mesh is cut into halves by a line of vertices, and each half again.

With leaves eliminated first, all parts of one depth are independent of each other; `multifrontal` uses the
independence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

LEAF = 96
"""Most vertices of an uncut part: the inverse of an uncut part is dense."""


@dataclass(frozen=True)
class Dissection:
    """The order of elimination of a graph.

    Attributes:
        order: Vertices in elimination order, shape (V,).
        starts: First vertex of each node in elimination order, and the vertex count, shape (nodes + 1,); leaves first.
        parent: The separator node above each node; -1 at the root, shape (nodes,).
        stages: First node of each depth, deepest first, and the number of nodes.
    """

    order: np.ndarray
    starts: np.ndarray
    parent: np.ndarray
    stages: np.ndarray


def dissect(graph: sp.csr_matrix, *, leaf: int = LEAF) -> Dissection:
    """Cut a graph into halves until the parts are small.

    Args:
        graph: Symmetric pattern, shape (V, V).
        leaf: Most vertices of an uncut part.
    """
    count = graph.shape[0]
    depths = max(0, int(np.ceil(np.log2(max(count, 1) / leaf))))
    part, depth_of = np.zeros(count, np.int64), np.full(count, depths)
    pairs = sp.coo_matrix(graph)
    ends = np.stack([pairs.row, pairs.col])[:, pairs.row != pairs.col].astype(np.int64)
    for depth in range(depths):
        ends = ends[:, (depth_of[ends] == depths).all(axis=0) & (part[ends[0]] == part[ends[1]])]
        inside = depth_of == depths
        piece = connected_components(sp.coo_matrix((np.ones(ends.shape[1]), ends), shape=(count, count)))[1]
        distance = _distances(ends, _farthest(ends, piece, inside, count), count)
        # Disconnected pieces are ordered one after another.
        upper, cut = _halves(distance + piece.astype(np.int64) * count, part, inside, ends=ends)
        depth_of[cut] = depth
        part = np.where(inside & ~cut, 2 * part + upper, part)
    key = (depths - depth_of) * (1 << depths) + part
    order = np.argsort(key, kind="stable")
    sizes = [1 << d for d in range(depths, -1, -1)]
    first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    # Node numbers: depth by depth, deepest first; within a depth by part.
    node = first[depths - depth_of] + part
    starts = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=int(first[-1])))]).astype(np.int64)
    above = [first[k + 1] + np.arange(size) // 2 for k, size in enumerate(sizes[:-1])]
    return Dissection(order, starts, np.concatenate([*above, [-1]]).astype(np.int64), first)


def _farthest(ends: np.ndarray, piece: np.ndarray, inside: np.ndarray, count: int) -> np.ndarray:
    """A peripheral vertex of each connected piece: the vertex farthest from an arbitrary start."""
    vertices = np.flatnonzero(inside)
    _, first = np.unique(piece[vertices], return_index=True)
    distance = _distances(ends, vertices[first], count)
    ordered = vertices[np.lexsort((distance[vertices], piece[vertices]))]
    return ordered[np.append(np.flatnonzero(np.diff(piece[ordered])), len(ordered) - 1)]


def _distances(ends: np.ndarray, sources: np.ndarray, count: int) -> np.ndarray:
    """Distance from the nearest source, in edges."""
    graph = sp.csr_matrix((np.ones(ends.shape[1], np.int8), (ends[0], ends[1])), shape=(count, count))
    distance = np.full(count, count)
    distance[sources] = 0
    front, step = sources, 0
    while len(front):
        step += 1
        lengths = graph.indptr[front + 1] - graph.indptr[front]
        offsets = np.repeat(graph.indptr[front] - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
        reached = graph.indices[offsets + np.arange(lengths.sum())]
        front = np.unique(reached[distance[reached] == count])
        distance[front] = step
    return distance


def _halves(
    distance: np.ndarray, part: np.ndarray, inside: np.ndarray, *, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The vertices beyond the median distance of their part, and the separator: their neighbours at the median."""
    vertices = np.flatnonzero(inside)
    ordered = vertices[np.lexsort((distance[vertices], part[vertices]))]
    labels, first, sizes = np.unique(part[ordered], return_index=True, return_counts=True)
    middle = np.zeros(int(part.max()) + 1, np.int64)
    middle[labels] = distance[ordered[first + sizes // 2]]
    upper = inside & (distance > middle[part])
    cut = np.zeros(len(part), bool)
    cut[ends[0][upper[ends[1]] & ~upper[ends[0]]]] = True
    return upper.astype(np.int64), cut
