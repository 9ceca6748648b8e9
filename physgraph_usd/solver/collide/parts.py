"""The parts of a level's cloth: pairs that may be in contact, and sewn vertices."""

# Warp's structs are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
from __future__ import annotations

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..level import Level
from ..mesh.topology import adjacency, owned_sides
from .clusters import Clusters
from .patches import MonotonePatches
from .topology import Topology


class Parts:
    """The vertices, edges and faces of a level that can come near one another.

    Attributes:
        level: The level.
        count: Number of clusters.
        topology: Warp struct of the topology.
        patches: Monotone patches of the level.
        links: Connected vertices: edges and sewn pairs, shape (N, 2), int64.
        lengths: Lengths of the links at rest, 0 if sewn [m], shape (N,), float64.
        spacing: Mean length of the edges at rest [m].
        shortest: Shortest edge at each vertex at rest [m], shape (V,), float64.
    """

    def __init__(self, level: Level, meets: np.ndarray, label: Int[np.ndarray, " vertices"] | None = None) -> None:
        """Gather the clusters.

        Args:
            level: The level.
            meets: True for pairs of garments in contact, symmetric, shape (G, G), bool.
            label: Vertices with equal labels are sewn together, or equal; None for no seams, shape (V,).
        """
        self.level = level
        edges, triangles = (each.cpu().numpy() for each in (level.edges, level.triangles))
        clusters = Clusters(level, adjacency(edges, level.vertex_count), owned_sides(edges, triangles))
        self.count = clusters.count
        table = self.topology = Topology()
        table.first_vertex, table.vertices = clusters.vertices
        table.first_edge, table.edges, table.edge_number = clusters.edges
        table.first_face, table.faces, table.face_number = clusters.faces
        table.first_corner, table.corners = (self._array(each) for each in _corners(clusters))
        self._corner = wp.to_torch(table.corners).long()
        counts = wp.to_torch(table.first_corner).diff().long()
        self._cluster = torch.arange(self.count, device=level.device).repeat_interleave(counts)
        table.garment, table.garments = clusters.garment, len(meets)
        table.meets = self._array(np.asarray(meets).ravel())
        sewn = np.zeros((0, 2), np.int64) if label is None else _sewn(label)
        self.links = torch.as_tensor(np.concatenate([edges.astype(np.int64), sewn]), device=level.device)
        shortest = torch.full_like(level.rest[:, 0].double(), torch.inf)
        length = level.rest_length.double().repeat_interleave(2)
        self.shortest = shortest.scatter_reduce(0, level.edges.long().reshape(-1), length, "amin")
        self.lengths = torch.cat([level.rest_length.double(), level.rest.new_zeros(len(sewn)).double()])
        self.spacing = float(level.rest_length.double().mean()) if len(level.rest_length) else 0.0
        table.owner = self._array(level.vertex_garment.cpu().numpy())
        self._rest = level.rest.double().contiguous()
        table.rest = wp.from_torch(self._rest, dtype=wp.vec3d)
        self.patches = MonotonePatches.of(level, table, self.count)
        table.label = self._array(np.arange(level.vertex_count) if label is None else label)

    def least_of(self, values: Float[Tensor, " vertices"]) -> Float[Tensor, " clusters"]:
        """Minimum of the values at the corners of each cluster."""
        out = torch.full((self.count,), torch.inf, dtype=values.dtype, device=values.device)
        return out.scatter_reduce(0, self._cluster, values[self._corner], "amin")

    def with_any(self, vertices: Bool[Tensor, " vertices"]) -> Bool[Tensor, " clusters"]:
        """Mask of the clusters with a given vertex at a corner."""
        out = torch.zeros(self.count, dtype=torch.bool, device=vertices.device)
        out[self._cluster[vertices[self._corner]]] = True
        return out

    def _array(self, values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=wp.int32, device=self.level.device)


def _sewn(label: np.ndarray) -> np.ndarray:
    """Each vertex that is not the first of its label, and the first vertex, shape (N, 2)."""
    first = np.unique(label, return_index=True)[1][np.unique(label, return_inverse=True)[1]]
    later = np.flatnonzero(first != np.arange(len(label)))
    return np.stack([later, first[later]], axis=1)


def _corners(clusters: Clusters) -> tuple[np.ndarray, np.ndarray]:
    """Start of each cluster's corners, and the distinct vertices of its parts."""
    owned = [
        np.stack([np.repeat(np.arange(clusters.count), np.diff(first.numpy())), vertex], axis=1)
        for width, (first, parts) in enumerate((clusters.vertices, clusters.edges[:2], clusters.faces[:2]), start=1)
        for vertex in parts.numpy().reshape(-1, width).T
    ]
    cluster, vertex = np.concatenate(owned).T.astype(np.int64)
    width = int(vertex.max(initial=0)) + 1
    cluster, vertex = np.divmod(np.unique(cluster * width + vertex), width)  # Of rows it takes ten times as long.
    return np.searchsorted(cluster, np.arange(clusters.count + 1)), vertex
