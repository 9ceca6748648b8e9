"""All edges that pass through faces."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
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

    @staticmethod
    def none(device: torch.device) -> Crossings:
        """No crossings."""
        empty = torch.zeros(0, dtype=torch.int64, device=device)
        return Crossings(empty, empty)


def crossings(parts: Parts, x: Float[Tensor, "vertices 3"]) -> Crossings:
    """All edges that pass through a face to which they are neither connected nor sewn.

    Args:
        parts: The parts.
        x: Positions [m].
    """
    edge, face = piercing_edges(parts, x).T
    return Crossings(edge, face)


@dataclass(frozen=True, eq=False)
class Pierced:
    """Crossings of cloth and bodies.

    Attributes:
        crossings: Edges of cloth or bodies and faces of bodies or cloth.
        edge: Indices of the cloth's edges that pass through bodies, once for each face met, shape (N,).
        body: Number of the body of each, shape (N,).
        counts: Number of crossings with each body, of its own edges through cloth too, shape (B,).
    """

    crossings: Crossings
    edge: Int[Tensor, " cut"]
    body: Int[Tensor, " cut"]
    counts: Int[Tensor, " bodies"]

    @property
    def count(self) -> int:
        """Number of crossings."""
        return int(self.counts.sum())


def all_crossings(parts: Parts, x: Float[Tensor, "all 3"]) -> tuple[Crossings, Pierced]:
    """As `crossings`, and the crossings of cloth and bodies.

    Args:
        parts: The parts.
        x: Positions of the cloth and of the bodies' corners [m].
    """
    edge, face = piercing_edges(parts, x).T.contiguous()
    edges, faces = (torch.tensor(each, device=x.device) for each in parts.starts)
    of_edge, of_face = torch.bucketize(edge, edges, right=True), torch.bucketize(face, faces, right=True)
    own = (of_edge == 0) & (of_face == 0)
    through = (of_edge == 0) & (of_face > 0)
    body = torch.maximum(of_edge, of_face)
    counts = torch.bincount(body, minlength=len(edges) + 1)[1:]
    with_body = Crossings(edge[~own], face[~own])
    return Crossings(edge[own], face[own]), Pierced(with_body, edge[through], of_face[through] - 1, counts)
