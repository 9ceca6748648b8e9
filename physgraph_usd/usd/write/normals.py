"""Smooth vertex normals of a polygon mesh, at a small fraction of a solve's cost."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int
from scipy import sparse

from ...solver.mesh.topology import PolygonMesh

_FALLBACK = np.array([0.0, 1.0, 0.0])


class VertexNormals:
    """Area-weighted vertex normals for one topology.

    The normal of vertex v is the normalised sum of the vector areas of its faces,

        n_v = sum_f a_f / |sum_f a_f|,   a_f = 1/2 sum_i (p_i - p_0) x (p_{i+1} - p_0),

    exact for planar polygons and independent of the triangulation of a non-planar polygon (Newell's normal).
    """

    def __init__(
        self, mesh: PolygonMesh, *, left_handed: bool = False, welded: Int[np.ndarray, " vertices"] | None = None
    ) -> None:
        """Prepare the stencils.

        Args:
            left_handed: Whether faces run clockwise seen from outside.
            welded: A number for each vertex; vertices with equal numbers share a normal. None if no vertices are
                welded.
        """
        self.vertex_count, self._welded = mesh.vertex_count, welded
        counts = np.asarray(mesh.counts, np.int64)
        starts = np.concatenate([[0], np.cumsum(counts)])
        self._diagonals, self._face = _vector_area_corners(counts, starts, np.asarray(mesh.indices))
        corner_face = np.repeat(np.arange(len(counts)), counts)
        owner = np.asarray(mesh.indices) if welded is None else welded[mesh.indices]
        shape = (mesh.vertex_count, len(counts))
        ones = np.ones(len(mesh.indices), np.float32)
        self._faces_of = sparse.csr_matrix((ones, (owner, corner_face)), shape=shape)
        self._sign = np.float32(-1.0 if left_handed else 1.0)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Unit normals at positions, both of shape (V, 3), float32.

        A vertex without area gets its neighbours' normal, or +Y without neighbours.
        """
        a, b, c, d = (np.take(points, corners, axis=0) for corners in self._diagonals)
        areas = _cross(b - a, d - c)
        if self._face is not None:
            areas = self._face @ areas
        normals = self._faces_of @ areas
        normals = normals if self._welded is None else normals[self._welded]
        lengths = np.sqrt(np.einsum("ij,ij->i", normals, normals))
        # Below this a direction is rounding noise.
        tiny = max(1e-12 * float(lengths.max(initial=0.0)), float(np.finfo(np.float32).tiny))
        bad = ~(lengths > tiny)
        if bad.any():
            normals[bad] = self._from_neighbours(normals, lengths, bad)
            lengths = np.where(bad, 1.0, lengths)
        return (normals * (self._sign / lengths)[:, None]).astype(np.float32, copy=False)

    def _from_neighbours(self, normals: np.ndarray, lengths: np.ndarray, bad: np.ndarray) -> np.ndarray:
        """Unit normals for vertices without area, from the good vertices of their faces."""
        unit = np.where(bad[:, None], 0.0, normals / np.where(bad, 1.0, lengths)[:, None])
        owner = np.flatnonzero(bad) if self._welded is None else self._welded[bad]
        spread = self._faces_of[owner] @ (self._faces_of.T @ unit)
        size = np.linalg.norm(spread, axis=1, keepdims=True)
        return np.where(size > 1e-6, spread / np.maximum(size, 1e-30), self._sign * _FALLBACK)


def _vector_area_corners(
    counts: np.ndarray, starts: np.ndarray, indices: np.ndarray
) -> tuple[tuple[np.ndarray, ...], sparse.csr_matrix | None]:
    """Vertices (a, b, c, d) with (b - a) x (d - c) summing to twice each face's vector area, and the sum over faces."""
    if np.all(counts == 3):
        a, b, c = indices.reshape(-1, 3).T
        return (a, b, a, c), None
    if np.all(counts == 4):
        a, b, c, d = indices.reshape(-1, 4).T
        return (a, c, b, d), None
    fan = np.maximum(counts - 2, 0)
    face = np.repeat(np.arange(len(counts)), fan)
    step = np.arange(len(face)) - np.repeat(np.cumsum(fan) - fan, fan)
    first = indices[starts[face]]
    corners = (first, indices[starts[face] + step + 1], first, indices[starts[face] + step + 2])
    ones = np.ones(len(face), np.float32)
    return corners, sparse.csr_matrix((ones, (face, np.arange(len(face)))), shape=(len(counts), len(face)))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Row-wise cross product; several times faster than numpy's."""
    out = np.empty_like(a)
    out[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    out[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    out[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return out
