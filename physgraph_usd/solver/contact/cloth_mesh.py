"""One level's cloth as a mesh with optional seams: adjacency of vertices, faces and edges, also across seams."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.crossings import Crossings
from ..collide.parts import Parts
from ..colliders.base import Solid
from ..forces.self_contact import PairConstraints
from ..level import Level
from ..mesh.topology import adjacency, joined_by

RINGS = 2
"""Rings of vertices around a crossing or a piece of cloth that count as part of it."""
SIDE_SAMPLES = 8
"""Largest number of vertices of a piece of cloth that are tested; the majority decides the side."""


class ClothPieces:
    """Pieces of cloth, each judged by a few of its vertices.

    Attributes:
        sampled: Up to `SIDE_SAMPLES` vertices of each piece, evenly spaced in their order, shape (S,).
    """

    def __init__(self, piece: Int[np.ndarray, " vertices"], device: torch.device | str) -> None:
        """Choose the vertices.

        Args:
            piece: Piece of each vertex, shape (V,).
        """
        order, size = np.argsort(piece, kind="stable"), np.bincount(piece)
        first, step = np.cumsum(size) - size, np.maximum(size // SIDE_SAMPLES, 1)
        rank = np.arange(len(piece)) - first[piece[order]]
        chosen = order[(rank % step[piece[order]] == 0) & (rank // step[piece[order]] < SIDE_SAMPLES)]
        self._count = len(size)
        self.sampled, self._piece, self._owner = (
            torch.as_tensor(numbers.astype(np.int64)).to(device) for numbers in (chosen, piece, piece[chosen])
        )

    def most(self, chosen: Bool[Tensor, " sampled"]) -> Bool[Tensor, " vertices"]:
        """Mask of the pieces of which most sampled vertices are chosen."""
        votes = torch.zeros(self._count, dtype=torch.int32, device=chosen.device)
        votes.index_add_(0, self._owner, 2 * chosen.int() - 1)
        return (votes > 0)[self._piece]


class ClothMesh:
    """The faces and edges of a level, sewn at pairs of vertices.

    Attributes:
        edges: Ends of the edges of the cloth, then of the bodies, int64.
        parts: Table of vertex, edge and face pairs that may be in contact.
        triangles: Corners of the faces of the cloth, then of the bodies, int64.
        beside: Adjacency of the vertices, also across seams, shape (V, V).
        free: Mask of the vertices that may move, False for the bodies' corners, shape (V + B, 1).
        opposite: Vertices opposite each edge in the edge's first and last face, -1 without a face, shape (E, 2).
    """

    def __init__(
        self, level: Level, meets: np.ndarray, sewn: Int[np.ndarray, "pairs 2"], *, solids: Sequence[Solid] = ()
    ) -> None:
        """Build the adjacency.

        Args:
            meets: True for pairs in contact of garments, then bodies, symmetric, shape (G + B, G + B), bool.
            sewn: Pairs of vertices merged by a seam.
        """
        cloth, count = level.edges.cpu().numpy(), level.vertex_count
        label = joined_by(sewn, count) if len(sewn) else None
        self.level, self._garments = level, len(level.spans)
        self.parts = Parts(level, meets, label, solids=solids)
        edges, triangles, sides = self.parts.surface
        self.beside = _across(adjacency(cloth, count), label)
        self._body_corners = sum(len(solid.points) for solid in solids)
        self.free = self.padded(level.free[:, 0]).unsqueeze(1)
        self.edges, self.triangles, self.opposite = (
            torch.as_tensor(vertices, device=level.device)
            for vertices in (edges, triangles, _opposite(triangles, sides, len(edges)))
        )
        self._first, self._second = (
            torch.as_tensor(vertices.astype(np.int64)).to(level.device) for vertices in self.beside.nonzero()
        )

    @cached_property
    def pieces(self) -> ClothPieces:
        """Connected pieces of the cloth."""
        return ClothPieces(joined_by(self.level.edges.cpu().numpy(), self.level.vertex_count), self.level.device)

    def padded(self, vertices: Bool[Tensor, " vertices"]) -> Bool[Tensor, " all"]:
        """A mask of vertices, with False for the bodies' corners."""
        return torch.nn.functional.pad(vertices, (0, self._body_corners))

    def grown(self, vertices: Bool[Tensor, " some"], rings: int) -> Bool[Tensor, " some"]:
        """A mask of vertices, extended to all vertices of the cloth at most `rings` edges away."""
        for _ in range(rings):
            seeds, vertices = vertices, vertices.clone()
            vertices[self._second[seeds[self._first]]] = True
        return vertices

    def pieces_with(self, members: Bool[Tensor, " all"], *, over: float) -> Bool[Tensor, " vertices"] | None:
        """Mask of the connected pieces, also across seams, with more than a fraction of members; None without any."""
        count = self.level.vertex_count
        piece = torch.as_tensor(joined_by(self.parts.links.cpu().numpy(), count), device=members.device).long()
        share = torch.bincount(piece, members[:count].double()) / torch.bincount(piece).clamp_min(1)
        out = (share > over)[piece]
        return out if bool(out.any()) else None

    def corners_of(self, crossings: Crossings) -> Int[Tensor, "crossings 5"]:
        """Vertices of the edge and of the face of each crossing."""
        return torch.cat([self.edges[crossings.edge], self.triangles[crossings.face]], dim=1)

    def crossed(self, crossings: Crossings) -> Bool[Tensor, " vertices"]:
        """Mask of the vertices of the cloth's crossing edges and faces."""
        out = torch.zeros_like(self.level.free[:, 0])
        if crossings.count:
            corners = self.corners_of(crossings).reshape(-1)
            out[corners[corners < len(out)]] = True
        return out

    def anchored(
        self,
        corners: Int[Tensor, "pairs 4"],
        weight: Float[Tensor, "pairs 4"],
        normal: Float[Tensor, "pairs 3"],
        offset: Float[Tensor, " pairs"],
        stiffness: Float[Tensor, " pairs"],
        x: Float[Tensor, "all 3"],
    ) -> PairConstraints:
        """Constraints with the bodies' corners constant at x [m]; the arguments are as for `PairConstraints`."""
        count = self.level.vertex_count
        if len(x) > count:
            rows = torch.nonzero(corners.amax(dim=1) >= count)[:, 0]
            of_rows, part = corners[rows], weight[rows]
            fixed = of_rows >= count
            still = torch.where(fixed, part, torch.zeros_like(part))
            height = (normal[rows] * (still.unsqueeze(2) * x[of_rows.long()]).sum(dim=1)).sum(dim=1)
            offset, weight = offset.index_copy(0, rows, offset[rows] - height), weight.index_copy(0, rows, part - still)
            corners = corners.index_copy(0, rows, torch.where(fixed, of_rows.amin(dim=1, keepdim=True), of_rows))
        columns = (column.to(self.level.rest).contiguous() for column in (weight, normal, offset, stiffness))
        return PairConstraints(corners.contiguous(), *columns)

    def between(self, crossings: Crossings) -> np.ndarray:
        """Number of crossings between garments, the lower number first, shape (G, G)."""
        table = np.zeros((self._garments, self._garments), np.int64)
        if not crossings.count:
            return table
        ends = self.level.vertex_garment[self.corners_of(crossings)[:, [0, 2]]].cpu().numpy()
        np.add.at(table, (ends.min(axis=1), ends.max(axis=1)), 1)
        return table


def _across(beside: sp.csr_matrix, label: np.ndarray | None) -> sp.csr_matrix:
    """Vertex adjacency with shared neighbours of sewn vertices."""
    if label is None:
        return beside
    count = len(label)
    member = sp.csr_matrix((np.ones(count, np.float32), (np.arange(count), label)))
    same = sp.csr_matrix(member @ member.T)
    out = sp.csr_matrix(same @ beside @ same + same)
    out.setdiag(0.0)
    out.eliminate_zeros()
    out.data[:] = 1.0
    return out


def _opposite(triangles: np.ndarray, sides: np.ndarray, count: int) -> np.ndarray:
    """Vertices opposite each of E edges in its first and last face, shape (E, 2), -1 without; sides in shape (3 T,)."""
    third, out = triangles[:, [2, 0, 1]].reshape(-1), np.full((count, 2), -1)
    out[sides[::-1], 0], out[sides, 1] = third[::-1], third  # What is written last stays.
    out[out[:, 0] == out[:, 1], 1] = -1
    return out
