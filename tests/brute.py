"""Proximity and crossings of small meshes, pair by pair in numpy: independent of the package's own queries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from physgraph_usd.solver.level import Level


@dataclass(frozen=True, eq=False)
class Soup:
    """A level's elements as arrays of numpy; positions are rounded as the package's hierarchy rounds them."""

    x: np.ndarray
    edges: np.ndarray
    faces: np.ndarray
    garment: np.ndarray

    @staticmethod
    def of(level: Level, x: object) -> Soup:
        rounded = np.asarray(x).astype(np.float32).astype(np.float64)
        arrays = (np.asarray(each).astype(np.int64) for each in (level.edges, level.triangles, level.vertex_garment))
        return Soup(rounded, *arrays)


def crossing_points(x: np.ndarray, edges: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges that pass through faces that share no vertex with them, none in one plane: numbers of both, and where."""
    edge, face = _near(x, edges, faces)
    apart = (edges[edge][:, :, None] != faces[face][:, None, :]).all(axis=(1, 2))
    edge, face = edge[apart], face[apart]
    (a, b), (p, q, r) = x[edges[edge].T], x[faces[face].T]
    matrix = np.stack([q - p, r - p, a - b], axis=2)
    safe = np.abs(np.linalg.det(matrix)) > 1e-12 * np.linalg.norm(matrix, axis=1).prod(axis=1)
    u, v, t = np.full((3, len(edge)), -1.0)
    u[safe], v[safe], t[safe] = np.linalg.solve(matrix[safe], (a - p)[safe, :, None])[:, :, 0].T
    through = (u > 0) & (v > 0) & (u + v < 1) & (t > 0) & (t < 1)
    return edge[through], face[through], (a + t[:, None] * (b - a))[through]


def _near(points: np.ndarray, edges: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges and triangles whose balls meet."""
    middle, centre = points[edges].mean(axis=1), points[faces].mean(axis=1)
    half = 0.5 * np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    round_ = np.linalg.norm(points[faces] - centre[:, None], axis=2).max(axis=1)
    found = cKDTree(middle).sparse_distance_matrix(cKDTree(centre), half.max() + round_.max(), output_type="ndarray")
    kept = found["v"] <= half[found["i"]] + round_[found["j"]]
    return found["i"][kept], found["j"][kept]


def crossings(soup: Soup, meets: np.ndarray | None = None) -> set[tuple[int, int]]:
    """Pairs of an edge and a face that it passes through, of garments that feel one another."""
    edge, face, _ = crossing_points(soup.x, soup.edges, soup.faces)
    if meets is not None:
        felt = meets[soup.garment[soup.edges[edge, 0]], soup.garment[soup.faces[face, 0]]]
        edge, face = edge[felt], face[felt]
    return set(zip(edge.tolist(), face.tolist(), strict=True))


def between(x: Sequence[np.ndarray], faces: Sequence[np.ndarray]) -> int:
    """Number of edges of each garment that pass through faces of any other."""
    total = 0
    for a in range(len(x)):
        edges = np.unique(np.sort(faces[a][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        for b in range(len(x)):
            if a != b:
                both = np.concatenate([x[a], x[b]])
                total += len(crossing_points(both, edges, faces[b] + len(x[a]))[0])
    return total
