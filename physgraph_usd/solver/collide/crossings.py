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

    @staticmethod
    def none(device: torch.device) -> Crossings:
        """No crossings."""
        empty = torch.zeros(0, dtype=torch.int64, device=device)
        return Crossings(empty, empty)


def crossings(
    parts: Parts, x: Float[Tensor, "vertices 3"], asked: Bool[Tensor, " vertices"] | None = None
) -> Crossings:
    """All edges that pass through a face to which they are neither connected nor sewn.

    Args:
        parts: The parts.
        x: Positions [m].
        asked: Mask of vertices; each crossing has one of these among its corners. All vertices when None.
    """
    edge, face = piercing_edges(parts, x, asked).T
    return Crossings(edge, face)
