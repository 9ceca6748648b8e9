"""Gravity.

    E = - sum_v m_v g . x_v,   m_v = density a_v, times the scale of the faces' fabrics

The solver recentres each frame on the mean of its coarse positions, so the energy is relative to the input's mean
height.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..level import Level
from ..mesh.formula import QUAD, element_kernels
from .base import Elements

_KERNELS = element_kernels(
    "gravity",
    """
    Quad w = load4(parameter0);
    Vec weight = {w[0], w[1], w[2]};
    store(-dot(weight, corner(0)), {weight});
    """,
    corners=1,
    parameter=QUAD,
)


class Gravity:
    """Weight of one level's vertices.

    Attributes:
        weight: Force on each vertex [N], shape (V, 3).
        density: Areal density of each garment [kg/m^2].
        elements: The vertices.
    """

    name = "gravity"

    def __init__(
        self,
        level: Level,
        density: Float[Tensor, " garments"],
        gravity: np.ndarray,
    ) -> None:
        """Weigh the vertices of a level.

        Args:
            density: Areal density of each garment [kg/m^2].
            gravity: Acceleration [m/s^2], shape (3,).
        """
        self._owner = level.vertex_garment
        owner = self._owner.long()
        self.density = density.to(level.rest)
        mass = self.density[owner] * level.density_scale * level.vertex_area
        self.weight = mass.unsqueeze(1) * torch.as_tensor(gravity, dtype=level.dtype, device=level.device)
        vertices = torch.arange(level.vertex_count, dtype=torch.int32, device=level.device).unsqueeze(1)
        weight = torch.nn.functional.pad(self.weight, (0, 1))
        self.elements = (Elements(_KERNELS, vertices, [weight, weight], level=level),)

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the weight [N] in place and return the energy [J]."""
        return self.elements[0].evaluate(x, force)

    def split(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " parts"], Int[Tensor, " parts"]]:
        """Energy of each vertex [J] at positions x [m], and the vertex's garment."""
        return -(self.weight * x).sum(dim=1), self._owner

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """Zero: the energy is linear."""
        return torch.zeros_like(x[:, 0])

    def rest_springs(self) -> tuple[float, float]:
        """None: the energy is linear."""
        return 0.0, 0.0
