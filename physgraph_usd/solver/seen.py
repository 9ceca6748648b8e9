"""Measures of what the eye sees of a shape: directions of the surface, angles between two shapes, amount of folds.

Light falls on normals, so the eye judges folds by them. A frame that is a millimetre from another in distance can look
quite different, and its energy can be 97% of the way down while its folds still turn by twenty degrees. These measures
say how far folds are from where they would end.

The module imports numpy alone: benchmarks load it by its path to measure the results of other versions in the same way.
"""

from __future__ import annotations

import numpy as np


def vertex_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals of the surface at its vertices, weighted by the areas of the triangles around each vertex.

    Args:
        points: Positions [m], shape (V, 3).
        triangles: Vertices of each triangle, shape (T, 3).

    Returns:
        Shape (V, 3); zero at vertices without triangles.
    """
    areas, corners = _area_vectors(points, triangles), triangles.ravel()
    total = np.stack([np.bincount(corners, np.repeat(component, 3), len(points)) for component in areas.T], axis=1)
    return _unit(total)


def normal_angles(a: np.ndarray, b: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Angle between the vertex normals of two shapes of one mesh [degrees], shape (V,).

    Args:
        a: Positions of the one shape [m], shape (V, 3).
        b: Positions of the other shape [m], shape (V, 3).
        triangles: Vertices of each triangle, shape (T, 3).

    Returns:
        0 to 180; 0 at vertices without triangles.
    """
    return np.degrees(_angles(vertex_normals(a, triangles), vertex_normals(b, triangles)))


def folding(points: np.ndarray, triangles: np.ndarray) -> float:
    """Amount of folds: the sum over inner edges of the angle between the edge's two triangles times its length [rad m].

    A flat sheet has none, and a sheet folded once at a right angle has pi / 2 times the length of the fold. Edges of
    three or more triangles count for each pair of triangles that follow one another.

    Args:
        points: Positions [m], shape (V, 3).
        triangles: Vertices of each triangle, shape (T, 3).
    """
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, faces = edges[order], np.tile(np.arange(len(triangles)), 3)[order]
    inner = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
    normals = _unit(_area_vectors(points, triangles))
    angles = _angles(normals[faces[inner]], normals[faces[inner + 1]])
    lengths = np.linalg.norm(points[edges[inner, 0]] - points[edges[inner, 1]], axis=1)
    return float((angles * lengths).sum())


def _area_vectors(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Normal of each triangle times twice its area [m^2], shape (T, 3)."""
    a, b, c = np.asarray(points, np.float64)[triangles].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors divided by their lengths; zero stays zero."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True).clip(np.finfo(float).tiny)


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between corresponding rows of two arrays of vectors [rad], shape (N,); 0 for zero vectors."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
