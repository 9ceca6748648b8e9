"""A level's faces in clusters that hang together, in a hierarchy of the clusters' boxes.

Almost all that a query of a single edge finds are its neighbours, and most of its time goes into finding them. A
cluster asks once for all of its parts, and leaves out near clusters where the cloth does not turn over: a piece whose
normals all lie within a right angle of one direction does not touch itself (Volino and Magnenat-Thalmann 1994).
"""

# Warp's arrays are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from ..mesh.lanes import LEAST_QUERIES, Launch
from .cluster_kernels import any_of_ring, cluster_boxes, edge_boxes, rings_turn

TURNED = math.radians(85.0)
"""Angle from a piece's mean normal beyond which it may touch itself."""

THREADS = 8
"""Threads that share a cluster's edges on CUDA."""


class Clusters:
    """The faces of a level by cluster: each belongs where its first corner does.

    Attributes:
        count: Number of clusters.
        faces: Warp arrays: the first face of each cluster, the faces' corners in the clusters' order, their numbers.
        face_boxes: Warp arrays: least and greatest corners of the faces' boxes, in the clusters' order.
    """

    def __init__(self, level: Level, cluster: np.ndarray, count: int, *, meets: np.ndarray) -> None:
        """Sort the faces and build the hierarchy at rest.

        Args:
            level: The level.
            cluster: The cluster of each vertex, each of one garment and in one piece, shape (V,).
            count: Number of clusters.
            meets: Which garments feel which, symmetric, shape (G, G), bool.
        """
        wp.init()  # Views of tensors do not start Warp by themselves.
        self._level, self.count = level, count
        triangles = level.triangles.cpu().numpy()
        self._owner = cluster[triangles[:, 0]]
        first, members = _by_owner(self._owner, count)
        self.faces = (self._array(first), self._array(triangles[members], wp.vec3i), self._array(members))
        self.face_boxes, self._boxes = self._vectors(len(triangles), 2), self._vectors(count, 2)
        garment = np.zeros(count, np.int32)
        garment[cluster] = level.vertex_garment.cpu().numpy()
        self.garment = self._array(garment)
        rings = _rings(cluster[level.edges.cpu().numpy()], count)
        ring = [self._array(rings.indptr), self._array(rings.indices)]
        normal, total = self._vectors(len(triangles), 1), self._vectors(count, 1)
        turns, around = (wp.zeros(count, dtype=wp.int32, device=level.device) for _ in range(2))
        points = wp.from_torch(level.rest.to(torch.float32).contiguous(), dtype=wp.vec3f)
        boxes = [*self.faces[:2], *self.face_boxes, *normal, *self._boxes, *total]
        self._of_points = [self._launch(cluster_boxes, [points, *boxes])]
        cosine = wp.float32(math.cos(TURNED))
        self._of_normals = (
            self._launch(rings_turn, [*ring, self.faces[0], *normal, *total, cosine, turns]),
            self._launch(any_of_ring, [*ring, turns, around]),
        )
        self._of_points[0]({})
        self._at: tuple[Tensor, int] | None = None
        # Empty clusters would spoil the tree that is usual on CUDA, which sorts boxes by their middles.
        self._tree = wp.Bvh(*self._boxes, constructor="sah")
        table = self._array(np.asarray(meets).ravel())
        self._shared = [
            self._tree.id,
            *self._boxes,
            self.garment,
            *ring,
            turns,
            around,
            table,
            wp.int32(len(meets)),
        ]

    def move(self, x: Float[Tensor, "vertices 3"]) -> None:
        """Take positions [m], float32; nothing is done for the tensor taken last, unless it was written to since."""
        if self._at is not None and self._at[0] is x and self._at[1] == x._version:
            return
        self._at = x, x._version
        points = wp.from_torch(x, dtype=wp.vec3f, requires_grad=False)
        for step in self._of_points:
            step({0: points})
        for step in self._of_normals:
            step({})
        self._tree.refit()

    def run(self, kernel: wp.Kernel, inputs: Sequence[object]) -> None:
        """Launch over the clusters; the kernel is told first what they all share."""
        self._launch(kernel, [*self._shared, *inputs])({})

    def run_shared(self, kernel: wp.Kernel, inputs: Sequence[object]) -> None:
        """The same for kernels of much work in few clusters, which on CUDA several threads share; they are told so."""
        threads = 1 if self._level.device == "cpu" else THREADS
        self._launch(kernel, [*self._shared, wp.int32(threads), *inputs], threads=threads)({})

    def _launch(self, kernel: wp.Kernel, inputs: Sequence[object], *, threads: int = 1) -> Launch:
        given = {"device": self._level.device, "lanes": self._level.lanes, "least": LEAST_QUERIES}
        return Launch(kernel, self.count * threads, inputs, **given)

    def _array(self, values: np.ndarray, dtype: type = wp.int32) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=dtype, device=self._level.device)

    def _vectors(self, count: int, arrays: int) -> list[wp.array]:
        return [wp.zeros(count, dtype=wp.vec3f, device=self._level.device) for _ in range(arrays)]


class ClusteredParts(Clusters):
    """Clusters of a vertex and its neighbours, with the vertices and the edges of each.

    Attributes:
        edges: Warp arrays: the first edge of each cluster, the edges' ends in the clusters' order, their numbers.
        edge_boxes: Warp arrays: least and greatest corners of the edges' boxes, in the clusters' order.
        vertices: Warp arrays: the first vertex of each cluster, the vertices in the clusters' order.
    """

    def __init__(self, level: Level, beside: sp.csr_matrix, sides: np.ndarray, *, meets: np.ndarray) -> None:
        """Gather the clusters.

        Args:
            level: The level.
            beside: Adjacency of its vertices, shape (V, V).
            sides: The edges that each face owns, -1 for those that another face owns, shape (T, 3).
            meets: Which garments feel which, symmetric, shape (G, G), bool.
        """
        cluster = _in_space(_gathered(beside), level)
        super().__init__(level, cluster, int(cluster.max(initial=-1)) + 1, meets=meets)
        edges = level.edges.cpu().numpy()
        owner = np.zeros(len(edges), np.int64)
        owner[sides[sides >= 0]] = np.repeat(self._owner, 3)[(sides >= 0).ravel()]
        first, members = _by_owner(owner, self.count)
        self.edges = (self._array(first), self._array(edges[members], wp.vec2i), self._array(members))
        self.edge_boxes = self._vectors(len(edges), 2)
        points = wp.from_torch(level.rest.to(torch.float32).contiguous(), dtype=wp.vec3f)
        self._of_points.append(self._launch(edge_boxes, [points, *self.edges[:2], *self.edge_boxes]))
        self.vertices = tuple(self._array(each) for each in _by_owner(cluster, self.count))


def _in_space(cluster: np.ndarray, level: Level) -> np.ndarray:
    """The same clusters in the order of a curve through them at rest (Morton 1966): near ones lie near in memory."""
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


def _rings(edges: np.ndarray, count: int) -> sp.csr_matrix:
    """Which clusters are the same or joined by an edge, those of each sorted."""
    both = np.concatenate([edges, edges[:, ::-1], np.repeat(np.arange(count), 2).reshape(-1, 2)])
    rings = sp.csr_matrix((np.ones(len(both), np.int32), (both[:, 0], both[:, 1])), shape=(count, count))
    rings.sort_indices()
    return rings


def _gathered(beside: sp.csr_matrix) -> np.ndarray:
    """The cluster of each vertex: roots no two of which are neighbours, and their neighbours (Luby 1986).

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
    """The greatest of the values at each vertex's neighbours, 0 without any."""
    out = np.zeros(len(values), values.dtype)
    some = np.flatnonzero(np.diff(beside.indptr))
    if len(some):
        out[some] = np.maximum.reduceat(values[beside.indices], beside.indptr[some])
    return out


def _by_owner(owner: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The first place of each owner's items, and the items in the owners' order."""
    first = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=count))])
    return first, np.argsort(owner, kind="stable")
