"""Tether: temporal coherence, a weak pull towards the last frame's detail.

    E = 1/2 sum_v k_t m_v |x_v - p_v|^2

| symbol | here | meaning |
|---|---|---|
| k_t | ``stiffness`` | [1/s^2] |
| m_v | density a_v [kg] |
| p | ``predicted`` | the last frame's detail, carried in the coarse surface's moving frames [m] |
"""

from __future__ import annotations

import copy

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..level import Level
from ..mesh.stencil import three_columns


class Tether:
    """Springs to predicted positions.

    Attributes:
        stiffness: k_t [1/s^2].
        predicted: p [m].
    """

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
            density: Areal density of each garment [kg/m^2].
            stiffness: k_t [1/s^2].
            predicted: Positions [m].
        """
        self._level = level
        density = density.to(level.rest)[level.vertex_garment.long()] * level.density_scale
        self._weight = stiffness * density * level.vertex_area
        self._pull = three_columns(self._weight)
        self.predicted, self.stiffness = predicted, stiffness

    def towards(self, predicted: Float[Tensor, "vertices 3"]) -> Tether:
        """These springs, to other positions [m]."""
        return self.aimed(self._pull, predicted)

    @property
    def aims(self) -> tuple[Tensor, ...]:
        """The stiffness of each coordinate [N/m], and the positions [m]."""
        return self._pull, self.predicted

    def aimed(self, *aims: Tensor) -> Tether:
        """Springs with other `aims`."""
        tether = copy.copy(self)
        tether._pull, tether.predicted = aims
        return tether

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        stray = x - self.predicted
        pull = self._pull * stray
        force -= pull
        return 0.5 * torch.dot(pull.reshape(-1), stray.reshape(-1)).double()

    def split(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " parts"], Int[Tensor, " parts"]]:
        """Energy of each vertex's spring [J] at positions x [m], and the vertex's garment."""
        return 0.5 * self._weight * (x - self.predicted).square().sum(dim=1), self._level.vertex_garment

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """k_t m_v [N/m]."""
        return self._weight.to(x)

    def rest_springs(self) -> tuple[float, np.ndarray]:
        """k_t m_v to fixed points [N/m], shape (V,)."""
        return 0.0, self._weight.double().cpu().numpy()
