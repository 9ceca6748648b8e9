"""Tether: temporal coherence, a weak pull towards the last frame's detail.

    E = 1/2 sum_v k_t m_v |x_v - p_v|^2

| symbol | here | meaning |
|---|---|---|
| k_t | ``stiffness`` | [1/s^2] |
| m_v | density a_v [kg] |
| p | ``predicted`` | the last frame's detail, carried in the coarse surface's moving frames [m] |
"""

from __future__ import annotations

import scipy.sparse as sp
import torch
from jaxtyping import Float
from torch import Tensor

from ..level import Level


class Tether:
    """Springs to predicted positions."""

    name = "tether"

    def __init__(
        self,
        level: Level,
        density: Float[Tensor, " garments"],
        stiffness: float,
        predicted: Float[Tensor, "vertices 3"],
    ) -> None:
        """Tie a level to predicted positions.

        Args:
            level: The level.
            density: Areal density of each garment [kg/m^2].
            stiffness: k_t [1/s^2].
            predicted: Positions [m].
        """
        self._density, self._area = density.to(level.rest)[level.vertex_garment.long()], level.vertex_area
        self._weight = stiffness * self._density * self._area
        self._predicted = predicted

    def aim(self, predicted: Float[Tensor, "vertices 3"], stiffness: float) -> None:
        """Tie to other positions [m], with another stiffness [1/s^2], in place."""
        self._predicted.copy_(predicted)
        self._weight.copy_(stiffness * self._density * self._area)

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        stray = x - self._predicted
        pull = self._weight.unsqueeze(1) * stray
        force -= pull
        return 0.5 * (pull * stray).sum(dtype=torch.float64)

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """k_t m_v [N/m]."""
        return self._weight.to(x)

    def rest_matrix(self) -> sp.csr_matrix:
        """k_t m_v on the diagonal [N/m]."""
        return sp.csr_matrix(sp.diags(self._weight.double().cpu().numpy()))
