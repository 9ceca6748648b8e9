"""Connected clusters of a level's vertices, edges and faces, each sharing a single hierarchy query.

A query of a single edge mostly finds the edge's neighbours, and spends most of its time on them.
"""

# Warp's arrays are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..level import Level
from ..mesh.kernels import start_warp


class Clusters:
    """Clusters of a vertex and its neighbours.

    Attributes:
        count: Number of clusters.
        vertices: Warp arrays: first vertex of each cluster, the faces' corners in cluster order.
        edges: Warp arrays: first edge of each cluster, the edges' ends in cluster order, the edges' indices.
        faces: Warp arrays: first face of each cluster, the faces' corners and indices; a face belongs to the cluster of
            its first corner.
        garment: Warp array: the garment of each cluster.
    """

    def __init__(self, level: Level, beside: sp.csr_matrix, sides: np.ndarray) -> None:
        """Gather the clusters.

        Args:
            level: The level.
            beside: Adjacency of the vertices, shape (V, V).
            sides: The edges owned by each face, -1 for edges owned by another face, shape (T, 3).
        """
        start_warp()  # Views of tensors do not start Warp by themselves.
        self._device = level.device
        cluster = _in_space(gathered(beside), level)
        self.count = int(cluster.max(initial=-1)) + 1
        edges, triangles = (each.cpu().numpy() for each in (level.edges, level.triangles))
        owner, of_face = np.zeros(len(edges), np.int64), cluster[triangles[:, 0]]
        owner[sides[sides >= 0]] = np.repeat(of_face, 3)[(sides >= 0).ravel()]
        first, members = _by_owner(of_face, self.count)
        self.faces = (self._array(first), self._array(triangles[members], wp.vec3i), self._array(members))
        first, members = _by_owner(owner, self.count)
        self.edges = (self._array(first), self._array(edges[members], wp.vec2i), self._array(members))
        corners = np.unique(triangles)  # A vertex of no face is no cloth.
        first, members = _by_owner(cluster[corners], self.count)
        self.vertices = self._array(first), self._array(corners[members])
        garment = np.zeros(self.count, np.int32)
        garment[cluster] = level.vertex_garment.cpu().numpy()
        self.garment = self._array(garment)

    def _array(self, values: np.ndarray, dtype: type = wp.int32) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=dtype, device=self._device)


def _in_space(cluster: np.ndarray, level: Level) -> np.ndarray:
    """Clusters renumbered along a space-filling curve at rest (Morton 1966), for memory locality."""
    rest = level.rest.double().cpu().numpy()
    count = int(cluster.max(initial=-1)) + 1
    size = np.maximum(np.bincount(cluster, minlength=count), 1)
    centre = np.stack([np.bincount(cluster, rest[:, axis], minlength=count) / size for axis in range(3)], axis=1)
    low, width = centre.min(axis=0, initial=np.inf), np.ptp(centre, axis=0).max(initial=0.0) if count else 0.0
    place = ((centre - low) / max(width, 1e-30) * 1023).astype(np.int64)
    key = np.zeros(count, np.int64)
    for bit in range(10):
        for axis in range(3):
            key |= ((place[:, axis] >> bit) & 1) << (3 * bit + axis)
    rank = np.empty(count, np.int64)
    rank[np.argsort(key, kind="stable")] = np.arange(count)
    return rank[cluster]


def gathered(beside: sp.csr_matrix) -> np.ndarray:
    """The cluster of each vertex: independent roots with their neighbours (Luby 1986).

    Clusters have the order of their roots.
    """
    count = beside.shape[0]
    rank = np.random.default_rng(0).permutation(count).astype(np.int64) + 1
    left, root = np.ones(count, bool), np.zeros(count, bool)
    while left.any():
        value = np.where(left, rank, 0)
        chosen = left & (value > _greatest_beside(beside, value))
        root |= chosen
        left &= ~chosen & (_greatest_beside(beside, chosen.astype(np.int64)) == 0)
    label = np.cumsum(root) * root
    return np.where(root, label, _greatest_beside(beside, label)) - 1


def _greatest_beside(beside: sp.csr_matrix, values: np.ndarray) -> np.ndarray:
    """Maximum of the values at each vertex's neighbours, 0 without neighbours."""
    out = np.zeros(len(values), values.dtype)
    some = np.flatnonzero(np.diff(beside.indptr))
    if len(some):
        out[some] = np.maximum.reduceat(values[beside.indices], beside.indptr[some])
    return out


def _by_owner(owner: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Start of each owner's items, and the items sorted by owner."""
    first = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=count))])
    return first, np.argsort(owner, kind="stable")
