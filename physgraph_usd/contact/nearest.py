"""The closest parts above and below each vertex and each edge of a level's cloth, and the pairs that they make."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..level import Level


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of material points that are near one another.

    Attributes:
        corners: Vertices, shape (N, 4), int32: a vertex and a face, or two edges.
        weight: From the second point to the first, shape (N, 4).
        face: Whether the pair is a vertex and a face, shape (N,).
    """

    corners: Int[Tensor, "pairs 4"]
    weight: Float[Tensor, "pairs 4"]
    face: Bool[Tensor, " pairs"]


@dataclass(frozen=True, eq=False)
class Nearest:
    """What is closest to each vertex and to each edge, first above and then below.

    Attributes:
        x: Where each vertex was when it was last looked at [m], shape (V, 3).
        face: Closest face of each vertex, -1 where there is none, shape (V, 2), int32.
        weight: Barycentric coordinates on it, shape (2, V, 3), float32.
        edge: Closest edge of each edge, -1 where there is none, shape (E, 2), int32.
        place: Where along the edge and along that other, shape (2, E, 2), float32.
    """

    x: Float[Tensor, "vertices 3"]
    face: Int[Tensor, "vertices 2"]
    weight: Float[Tensor, "2 vertices 3"]
    edge: Int[Tensor, "edges 2"]
    place: Float[Tensor, "2 edges 2"]

    @staticmethod
    def none(x: Float[Tensor, "vertices 3"], edges: int) -> Nearest:
        """Nothing near anything at x [m]."""
        face, edge = (torch.full((count, 2), -1, dtype=torch.int32, device=x.device) for count in (len(x), edges))
        weight = torch.zeros((2, len(x), 3), dtype=torch.float32, device=x.device)
        place = torch.zeros((2, edges, 2), dtype=torch.float32, device=x.device)
        return Nearest(x, face, weight, edge, place)

    def copy(self) -> Nearest:
        """The same, to be written to."""
        return Nearest(self.x, self.face.clone(), self.weight.clone(), self.edge.clone(), self.place.clone())

    def without(self, where: Bool[Tensor, " vertices"], *, x: Float[Tensor, "vertices 3"]) -> Nearest:
        """The same with nothing near some vertices, which are looked at anew at x [m]."""
        at = torch.where(where.unsqueeze(1), x, self.x)
        return replace(self, x=at, face=torch.where(where.unsqueeze(1), torch.full_like(self.face, -1), self.face))

    def beside_moved(self, level: Level, moved: Bool[Tensor, " vertices"]) -> Bool[Tensor, " vertices"]:
        """Vertices, and ends of edges, whose closest part has a vertex that moved."""
        near = torch.zeros_like(moved)
        vertex, side = torch.nonzero(self.face >= 0, as_tuple=True)
        near[vertex[moved[level.triangles[self.face[vertex, side].long()].long()].any(dim=1)]] = True
        edge, side = torch.nonzero(self.edge >= 0, as_tuple=True)
        beside = edge[moved[level.edges[self.edge[edge, side].long()].long()].any(dim=1)]
        near[level.edges[beside].long().reshape(-1)] = True
        return near

    def close(self, level: Level) -> Bool[Tensor, " vertices"]:
        """Vertices near a face, and the corners of those faces."""
        known = self.face >= 0
        close = known.any(dim=1)
        close[level.triangles[self.face[known].long()].long().reshape(-1)] = True
        return close

    def pairs(self, level: Level) -> Pairs:
        """Vertex-face pairs, then edge-edge pairs; an edge-edge pair occurs once."""
        of_faces, of_edges = self._vertex_face(level), self._edge_edge(level)
        face = torch.zeros(len(of_faces[0]) + len(of_edges[0]), dtype=torch.bool, device=self.face.device)
        face[: len(of_faces[0])] = True
        corners, weight = (torch.cat(both) for both in zip(of_faces, of_edges, strict=True))
        return Pairs(corners.to(torch.int32).contiguous(), weight.to(level.dtype).contiguous(), face)

    def _vertex_face(self, level: Level) -> tuple[Tensor, Tensor]:
        """Corners and weights of the pairs of a vertex and a face."""
        vertex, side = torch.nonzero(self.face >= 0, as_tuple=True)
        three, weight = level.triangles[self.face[vertex, side].long()].long(), self.weight[side, vertex]
        corners = torch.cat([vertex.unsqueeze(1), three], dim=1)
        return corners, torch.cat([torch.ones_like(weight[:, :1]), -weight], dim=1)

    def _edge_edge(self, level: Level) -> tuple[Tensor, Tensor]:
        """Corners and weights of the pairs of two edges."""
        a, side = torch.nonzero(self.edge >= 0, as_tuple=True)
        b, st = self.edge[a, side].long(), self.place[side, a]
        # The pair that either edge found is one pair.
        key = torch.minimum(a, b) * len(level.edges) + torch.maximum(a, b)
        key, order = torch.sort(key, stable=True)
        kept = order[torch.diff(key, prepend=-torch.ones_like(key[:1])) != 0]
        a, b, s, t = a[kept], b[kept], st[kept, 0], st[kept, 1]
        return torch.cat([level.edges[a], level.edges[b]], dim=1).long(), torch.stack([1 - s, s, t - 1, -t], dim=1)
