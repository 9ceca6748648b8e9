"""Seams: springs that hold together what the input has at one place.

    E = 1/2 k sum_pairs |x_a - x_b|^2

| symbol | here | meaning |
|---|---|---|
| k | ``stiffness`` | [N/m] |
"""

from __future__ import annotations

import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..level import Level


class Seam:
    """Springs of no length."""

    name = "seam"

    def __init__(self, pairs: Int[Tensor, "pairs 2"], stiffness: float) -> None:
        """Take pairs of vertices, each vertex any number of times.

        Args:
            pairs: Vertices.
            stiffness: k [N/m].
        """
        self._ends, self._stiffness = pairs.long(), stiffness

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        a, b = self._ends[:, 0], self._ends[:, 1]
        way = x[b] - x[a]
        pull = self._stiffness * way
        # Not `index_add_`: on CUDA its order, and so its rounding, changes from run to run.
        force.index_put_((a,), pull, accumulate=True).index_put_((b,), -pull, accumulate=True)
        return 0.5 * (pull * way).sum(dtype=torch.float64)

    def near(self, level: Level) -> Bool[Tensor, "vertices 1"]:
        """Which vertices are sewn."""
        seen = torch.zeros_like(level.free)
        seen[self._ends.reshape(-1)] = True
        return seen

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """k at each end [N/m]."""
        ends = self._ends.reshape(-1)
        value = torch.full_like(ends, self._stiffness, dtype=x.dtype)
        return torch.zeros_like(x[:, 0]).index_put_((ends,), value, accumulate=True)

    def rest_matrix(self) -> sp.csr_matrix | None:
        """None: what is sewn is known frame by frame."""
        return None
