"""Edges through faces, counted pair by pair in numpy: independent of the package's own measure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

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

    Edges are those of the triangles, diagonals included; a pair is looked at when the balls about both meet.

    Returns:
        Pairs of mesh numbers, of the edge and of the triangle, shape (N, 2).
    """
    parts = [place(mesh, frame) for mesh in meshes]
    starts = np.cumsum([0, *(len(part) for part in parts)])
    points = np.concatenate(parts)
    faces = np.concatenate([triangles_of(mesh) + start for mesh, start in zip(meshes, starts, strict=False)])
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    edge, face = _near(points, edges, faces)
    apart = ~(edges[edge][:, :, None] == faces[face][:, None, :]).any(axis=(1, 2))
    edge, face = edge[apart], face[apart]
    hit = _meet(points[edges[edge]], points[faces[face]])
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return np.stack([owner[edges[edge[hit], 0]], owner[faces[face[hit], 0]]], axis=1)


def _near(points: np.ndarray, edges: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges and triangles whose balls meet."""
    middle, centre = points[edges].mean(axis=1), points[faces].mean(axis=1)
    half = 0.5 * np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    round_ = np.linalg.norm(points[faces] - centre[:, None], axis=2).max(axis=1)
    found = cKDTree(middle).sparse_distance_matrix(cKDTree(centre), half.max() + round_.max(), output_type="ndarray")
    kept = found["v"] <= half[found["i"]] + round_[found["j"]]
    return found["i"][kept], found["j"][kept]


def _meet(segments: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Whether each segment, shape (N, 2, 3), passes through its triangle, shape (N, 3, 3)."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(along, two)
    det = np.einsum("ij,ij->i", one, across)
    sizes = np.prod([np.linalg.norm(each, axis=1) for each in (along, one, two)], axis=0)
    flat = np.abs(det) < 1e-9 * sizes  # an edge in the plane of its triangle, as on a table
    safe = np.where(flat, 1.0, det)
    off = start - corners[:, 0]
    u = np.einsum("ij,ij->i", off, across) / safe
    turned = np.cross(off, one)
    v = np.einsum("ij,ij->i", along, turned) / safe
    t = np.einsum("ij,ij->i", two, turned) / safe
    return ~flat & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)


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
