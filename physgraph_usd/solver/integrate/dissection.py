"""Nested dissection (George 1973): a mesh is cut into halves by a line of vertices, and each half again.

Eliminated leaves first, all parts of one depth are independent of each other, which `multifrontal` makes use of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

LEAF = 96
"""Vertices of a part that is not cut any further: its inverse is dense."""


@dataclass(frozen=True)
class Dissection:
    """The order of elimination of a graph.

    Attributes:
        order: Vertices in the order of their elimination, shape (V,).
        starts: First vertex of each node in that order, and their number, shape (nodes + 1,); leaves first.
        parent: The node that cut the part that a node lies in; -1 at the root, shape (nodes,).
        stages: First node of each depth, deepest first, and the number of nodes.
    """

    order: np.ndarray
    starts: np.ndarray
    parent: np.ndarray
    stages: np.ndarray


def dissect(graph: sp.csr_matrix, *, leaf: int = LEAF) -> Dissection:
    """Cut a graph in halves until its parts are small.

    Args:
        graph: Symmetric pattern, shape (V, V).
        leaf: Vertices of a part that is not cut any further.
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
        # Pieces that do not hang together come one after another.
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
    """A vertex of each connected piece that lies far out: the last that is reached from any other."""
    vertices = np.flatnonzero(inside)
    _, first = np.unique(piece[vertices], return_index=True)
    distance = _distances(ends, vertices[first], count)
    ordered = vertices[np.lexsort((distance[vertices], piece[vertices]))]
    return ordered[np.append(np.flatnonzero(np.diff(piece[ordered])), len(ordered) - 1)]


def _distances(ends: np.ndarray, sources: np.ndarray, count: int) -> np.ndarray:
    """Edges from the nearest source."""
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
    """Which vertices lie beyond the median distance of their part, and which ones on it touch them."""
    vertices = np.flatnonzero(inside)
    ordered = vertices[np.lexsort((distance[vertices], part[vertices]))]
    labels, first, sizes = np.unique(part[ordered], return_index=True, return_counts=True)
    middle = np.zeros(int(part.max()) + 1, np.int64)
    middle[labels] = distance[ordered[first + sizes // 2]]
    upper = inside & (distance > middle[part])
    cut = np.zeros(len(part), bool)
    cut[ends[0][upper[ends[1]] & ~upper[ends[0]]]] = True
    return upper.astype(np.int64), cut
