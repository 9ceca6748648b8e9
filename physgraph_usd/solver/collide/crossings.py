"""All edges that pass through faces."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .parts import Parts
from .search import piercing_edges


@dataclass(frozen=True, eq=False)
class Crossings:
    """Edges that pass through faces.

    Attributes:
        edge: Indices of the edges, shape (N,).
        face: Indices of the faces, shape (N,).
    """

    edge: Int[Tensor, " crossings"]
    face: Int[Tensor, " crossings"]

    @property
    def count(self) -> int:
        """Number of crossings."""
        return len(self.edge)

    def where(self, selected: Bool[Tensor, " crossings"]) -> Crossings:
        """The selected crossings."""
        kept = torch.nonzero(selected).squeeze(1)  # One conversion for both fields.
        return Crossings(self.edge[kept], self.face[kept])

    @staticmethod
    def none(device: torch.device) -> Crossings:
        """No crossings."""
        empty = torch.zeros(0, dtype=torch.int64, device=device)
        return Crossings(empty, empty)


def crossings(
    parts: Parts, x: Float[Tensor, "vertices 3"], queried: Bool[Tensor, " vertices"] | None = None
) -> Crossings:
    """Crossings of cloth with cloth: edges through faces without a common or sewn vertex.

    Args:
        x: Positions of the cloth, or of the cloth and the bodies' corners [m].
        queried: Mask of vertices; each crossing has at least one among its corners. All vertices when None.
    """
    return all_crossings(parts, x, queried)[0]


@dataclass(frozen=True, eq=False)
class Pierced:
    """Crossings of cloth and bodies.

    Attributes:
        crossings: Edges of cloth or bodies and faces of bodies or cloth.
        body: Number of the body of each crossing, shape (N,).
        cloth_edge: True for edges of the cloth, shape (N,).
    """

    crossings: Crossings
    body: Int[Tensor, " crossings"]
    cloth_edge: Bool[Tensor, " crossings"]

    @property
    def count(self) -> int:
        """Number of crossings."""
        return self.crossings.count

    @staticmethod
    def none(device: torch.device) -> Pierced:
        """No crossings."""
        none = Crossings.none(device)
        return Pierced(none, none.edge, none.edge.bool())

    def cut(self, body: int) -> Int[Tensor, " cut"]:
        """Indices of the cloth's edges that pass through a body, once for each face met."""
        return self.crossings.edge[self.cloth_edge & (self.body == body)]


def all_crossings(
    parts: Parts, x: Float[Tensor, "all 3"], queried: Bool[Tensor, " all"] | None = None
) -> tuple[Crossings, Pierced]:
    """As `crossings`, and the crossings of cloth and bodies.

    Args:
        x: Positions of the cloth, and of the bodies' corners if bodies are searched too [m].
        queried: As for `crossings`; crossings with bodies may be missing in clusters without such vertices.
    """
    edge, face = piercing_edges(parts, x, queried).T.contiguous()
    if not len(edge):
        return Crossings(edge, face), Pierced.none(x.device)
    edges, faces = parts.starts
    of_edge, of_face = torch.bucketize(edge, edges, right=True), torch.bucketize(face, faces, right=True)
    with_body = (of_edge > 0) | (of_face > 0)
    in_cloth, rows = Crossings(edge, face).where(~with_body), torch.nonzero(with_body).squeeze(1)
    with_bodies = Crossings(edge[rows], face[rows])
    cloth_edge, body = (of_edge == 0)[rows], torch.maximum(of_edge, of_face)[rows] - 1
    if queried is not None:
        corners = torch.cat([parts.level.edges[in_cloth.edge], parts.level.triangles[in_cloth.face]], dim=1).long()
        in_cloth = in_cloth.where(queried[corners].any(dim=1))
    return in_cloth, Pierced(with_bodies, body, cloth_edge)
