"""Edges through faces, counted pair by pair in numpy: independent of the package's own measure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from brute import crossing_points
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from physgraph_usd.usd.write.plain import PlainMesh


def triangles_of(mesh: PlainMesh) -> np.ndarray:
    """Faces as fans."""
    starts = np.cumsum(mesh.counts) - mesh.counts
    fans = []
    for size in np.unique(mesh.counts):
        first = starts[mesh.counts == size]
        fans += [mesh.indices[np.stack([first, first + i, first + i + 1], axis=1)] for i in range(1, size - 1)]
    return np.concatenate(fans)


def place(mesh: PlainMesh, frame: int) -> np.ndarray:
    """Points of a mesh at one of the stage's times, in the stage's frame."""
    points = mesh.points if mesh.samples is None else mesh.samples[frame]
    if mesh.transforms is None:
        return points
    matrix = mesh.transforms[frame]
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def piercings(meshes: Sequence[PlainMesh], frame: int) -> np.ndarray:
    """Edges of any of the meshes through triangles of any of them that share no vertex with the edge.

    Edges are those of the triangles, diagonals included.

    Returns:
        Pairs of mesh numbers, of the edge and of the triangle, shape (N, 2).
    """
    parts = [place(mesh, frame) for mesh in meshes]
    starts = np.cumsum([0, *(len(part) for part in parts)])
    points = np.concatenate(parts)
    faces = np.concatenate([triangles_of(mesh) + start for mesh, start in zip(meshes, starts, strict=False)])
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    edge, face, _ = crossing_points(points, edges, faces)
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return np.stack([owner[edges[edge, 0]], owner[faces[face, 0]]], axis=1)


def depths(points: np.ndarray, body: PlainMesh, frame: int) -> np.ndarray:
    """How deep points are in the deepest of a body's closed parts [stage units], shape (V,); negative outside."""
    places, faces, part = place(body, frame), triangles_of(body), parts(body)
    return -np.min([signed(points, places, faces[part[faces[:, 0]] == i]) for i in range(part.max() + 1)], axis=0)


def parts(body: PlainMesh) -> np.ndarray:
    """Number of the connected part of each vertex, shape (V,)."""
    faces, size = triangles_of(body), len(body.points)
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(size, size))
    return connected_components(links, directed=False)[1]


def signed(points: np.ndarray, places: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distances to a closed surface, negative inside, by another library, shape (V,)."""
    import igl

    return np.asarray(igl.signed_distance(points, places, faces.astype(np.int64))[0])
