"""How many edges pass through faces, counted by means that share nothing with the solver: trees of points and numpy."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

ROUNDING = 2.4e-7
"""Of the largest coordinate: an edge nearer to a face's plane lies in it, but for the rounding of single precision."""
AT_ONCE = 200_000
"""Edges and faces that are tested at once."""


def crossing_count(
    points: np.ndarray, edges: np.ndarray, triangles: np.ndarray, *, same: np.ndarray | None = None
) -> int:
    """Count the pairs of an edge and a face it passes through, without those that share a vertex.

    Args:
        points: Positions, shape (V, 3).
        edges: Shape (E, 2).
        triangles: Shape (T, 3).
        same: A number for each vertex, alike for those that count as one, or None.
    """
    label = np.arange(len(points)) if same is None else np.asarray(same)
    centre = points[triangles].mean(axis=1)
    radius = np.linalg.norm(points[triangles] - centre[:, None], axis=2).max(axis=1)
    middle = points[edges].mean(axis=1)
    half = 0.5 * np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    total = 0
    # Long edges and large faces would find everything: both are asked by size.
    for low, high in _bands(radius):
        faces = np.flatnonzero((radius >= low) & (radius <= high))
        tree = cKDTree(centre[faces])
        for start in range(0, len(edges), 20_000):
            some = np.arange(start, min(start + 20_000, len(edges)))
            found = tree.query_ball_point(middle[some], half[some] + high)
            sizes = np.array([len(each) for each in found])
            if not sizes.sum():
                continue
            pair_edge = np.repeat(some, sizes)
            pair_face = faces[np.concatenate([np.asarray(each, np.int64) for each in found if each])]
            for first in range(0, len(pair_edge), AT_ONCE):
                part = slice(first, first + AT_ONCE)
                total += _through(points, edges[pair_edge[part]], triangles[pair_face[part]], label)
    return total


def _bands(radius: np.ndarray) -> list[tuple[float, float]]:
    """Ranges of sizes, each to twice its least."""
    bands, low = [], float(radius.min()) if len(radius) else 0.0
    while len(radius) and low <= float(radius.max()):
        high = max(2.0 * low, 1e-12)
        bands.append((low, np.nextafter(high, 0.0)))
        low = high
    return bands


def _through(points: np.ndarray, edge: np.ndarray, face: np.ndarray, label: np.ndarray) -> int:
    """How many of some edges pass through the face of the same place."""
    apart = ~(label[edge][:, :, None] == label[face][:, None, :]).any(axis=(1, 2))
    a, b = points[edge[apart, 0]], points[edge[apart, 1]]
    p, q, r = (points[face[apart, i]] for i in range(3))

    def volume(u: np.ndarray, v: np.ndarray, w: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.einsum("ij,ij->i", v - u, np.cross(w - u, z - u))

    first, last = volume(p, q, r, a), volume(p, q, r, b)
    least = ROUNDING * np.abs(points).max(initial=0.0) * np.linalg.norm(np.cross(q - p, r - p), axis=1)
    split = (first * last < 0) & ((np.abs(first) > least) | (np.abs(last) > least))
    turns = np.stack([volume(a, b, p, q), volume(a, b, q, r), volume(a, b, r, p)], axis=1)
    inside = (turns > 0).all(axis=1) | (turns < 0).all(axis=1)
    return int((split & inside).sum())
