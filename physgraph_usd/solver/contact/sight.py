"""Contact plane of each vertex on one body: through the closest point, facing the vertex."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..forces.contact import Planes


@dataclass(frozen=True, eq=False)
class Sight:
    """Contact planes on one body, at most one a vertex.

    Attributes:
        at: Position of each vertex when its plane was found [m], shape (V, 3).
        there: True for vertices with a plane, shape (V,).
        normal: Unit normals, shape (V, 3).
        height: n . c [m], shape (V,).
        offset: Distance to keep [m], shape (V,).
    """

    at: Float[Tensor, "vertices 3"]
    there: Bool[Tensor, " vertices"]
    normal: Float[Tensor, "vertices 3"]
    height: Float[Tensor, " vertices"]
    offset: Float[Tensor, " vertices"]

    @staticmethod
    def none(x: Float[Tensor, "vertices 3"]) -> Sight:
        """No planes."""
        zero = torch.zeros_like(x[:, 0])
        return Sight(x, zero > 0, torch.zeros_like(x), zero, zero.clone())

    def planes(self) -> Planes:
        """The planes of vertices with a plane."""
        which = torch.nonzero(self.there).squeeze(1)
        return Planes(which.to(torch.int32), self.normal[which], (self.height + self.offset)[which])

    def renewed(
        self,
        x: Float[Tensor, "vertices 3"],
        still: Bool[Tensor, " vertices"],
        *,
        vertex: Int[Tensor, " near"],
        normal: Float[Tensor, "near 3"],
        signed: Float[Tensor, " near"],
        offset: Float[Tensor, " near"],
    ) -> Sight:
        """Planes updated at x.

        Args:
            x: Positions [m].
            still: Vertices that keep their planes.
            vertex: Vertices near the body, among the rest.
            normal: Unit normals of the new planes.
            signed: Distances to the new planes [m].
            offset: Distances to keep [m].
        """
        found = Sight.none(x)
        found.there[vertex], found.normal[vertex], found.offset[vertex] = True, normal, offset
        found.height[vertex] = (normal * (x[vertex] - normal * signed.unsqueeze(1))).sum(dim=1)
        row = still.unsqueeze(1)
        return Sight(
            torch.where(row, self.at, x),
            torch.where(still, self.there, found.there),
            torch.where(row, self.normal, found.normal),
            torch.where(still, self.height, found.height),
            torch.where(still, self.offset, found.offset),
        )
