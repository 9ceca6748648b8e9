"""What a vertex sees of the surface around it: its normal, the strain of its edges, its neighbours.

A vector v of a vertex gives others that turn with the cloth as v does, and that a network may combine:

| name | vector | what for |
|---|---|---|
| ``v.normal`` | (v . n) n | cloth is soft across itself and stiff along itself |
| ``v.strain`` | E v, E = mean of e u u^T over the edges, over `STRAIN` | it folds along what is compressed |
| ``v.smooth`` | mean of v over the neighbours | coarse and fine waves want steps of different lengths |
"""

from __future__ import annotations

from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from ..mesh.stencil import add_at
from .base import Surface

PARTS = ("normal", "strain", "smooth")
STRAIN = 0.03
"""Strain that counts as one: cloth that folds is compressed by some per cent."""


class Around:
    """The surroundings of every vertex at positions x; each part is found when it is asked for first."""

    def __init__(self, level: Surface, x: Float[Tensor, "vertices 3"]) -> None:
        """Look from positions x [m]; no gradients flow through what is seen."""
        self._level, self._x = level, x.detach()
        self._ends = level.edges.long()

    def part(self, vector: Float[Tensor, "vertices 3"], name: str) -> Float[Tensor, "vertices 3"]:
        """One of `PARTS` of a vector."""
        if name == "normal":
            return (vector * self.normal).sum(dim=1, keepdim=True) * self.normal
        if name == "strain":
            return (self.strain @ vector.unsqueeze(2)).squeeze(2)
        return self._over_neighbours(vector) / self._degree

    @cached_property
    def normal(self) -> Float[Tensor, "vertices 3"]:
        """Area-weighted unit normals; zero where triangles have no area."""
        corners = self._level.triangles.long()
        corner = self._x[corners]
        area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        total = add_at(torch.zeros_like(self._x), corners.T.reshape(-1), area.repeat(3, 1))
        return torch.nn.functional.normalize(total, dim=1, eps=1e-30)

    @cached_property
    def strain(self) -> Float[Tensor, "vertices 3 3"]:
        """Mean of e u u^T over each vertex's edges, e their strain over `STRAIN` and u their directions."""
        span = self._x[self._ends[:, 1]] - self._x[self._ends[:, 0]]
        length = span.square().sum(dim=1).clamp_min(1e-30).sqrt()
        along = span / length.unsqueeze(1)
        amount = torch.asinh((length / self._level.rest_length - 1.0) / STRAIN)
        tensor = amount.reshape(-1, 1, 1) * along.unsqueeze(2) * along.unsqueeze(1)  # E 3 3
        total = add_at(tensor.new_zeros(len(self._x), 9), self._ends.T.reshape(-1), tensor.reshape(-1, 9).repeat(2, 1))
        return (total / self._degree).reshape(-1, 3, 3)

    @cached_property
    def _degree(self) -> Tensor:
        ones = torch.ones_like(self._level.rest_length)
        return add_at(torch.zeros_like(self._x[:, 0]), self._ends.T.reshape(-1), ones.repeat(2)).clamp_min(1.0)[:, None]

    def _over_neighbours(self, vector: Tensor) -> Tensor:
        """Sum of a vector over the neighbours; gradients flow through the vector."""
        swapped = torch.cat([self._ends[:, 1], self._ends[:, 0]])
        return torch.zeros_like(vector).index_add(0, self._ends.T.reshape(-1), vector[swapped])
