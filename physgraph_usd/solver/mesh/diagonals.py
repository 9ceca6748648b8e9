"""Which edges of a triangulation are diagonals of quads, and which are their sides."""

from __future__ import annotations

import numpy as np

from .topology import TriangleSplit, find_edges


def quad_edges(split: TriangleSplit, counts: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tell the edges that splitting quads made from those that quads had.

    Args:
        split: The triangulation.
        counts: Vertices of each face that was split, shape (F,).
        edges: Edges of the triangles, lexicographic, shape (E, 2).

    Returns:
        The share of each edge's triangles that come from a quad, shape (E,), float64, and whether the edge is a quad's
        diagonal, shape (E,), bool.
    """
    sides = split.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edge = find_edges(edges, sides)
    face = np.repeat(split.face, 3)[edge >= 0]
    edge = edge[edge >= 0]
    count = np.bincount(edge, minlength=len(edges))
    from_quad = np.bincount(edge, counts[face] == 4, len(edges)) / np.maximum(count, 1)
    first, last = np.full(len(edges), np.iinfo(np.int32).max), np.full(len(edges), -1)
    np.minimum.at(first, edge, face)
    np.maximum.at(last, edge, face)
    return from_quad, (count == 2) & (first == last) & (from_quad == 1.0)
