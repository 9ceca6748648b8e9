"""Stretch: springs along the edges of faces and both diagonals of quads.

    E = 1/2 sum_e k_e (l_e - l0_e)^2,   k_e = 3 Y a_e / l0_e^2

| symbol | here | meaning |
|---|---|---|
| Y | ``youngs`` | 2D Young's modulus [N/m] |
| a_e | ``level.spring_area`` | a third of the adjacent triangles' areas [m^2], weighted to make quads isotropic |
| l0 | ``level.spring_length`` | rest length [m] |

Springs cannot express an independent shear stiffness: an isotropic sheet of springs has nu = 1/3 and G = 0.375 Y.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..level import Level
from ..mesh.formula import SCALAR, element_kernels
from ..mesh.stencil import add_at
from .base import Elements

_KERNELS = element_kernels(
    "stretch",
    """
    Vec span = corner(1) - corner(0);
    Number stiffness = load(parameter0), l0 = load(parameter1);
    Number length = root(dot(span, span)), extension = length - l0;
    // A collapsed spring has no direction: below a millionth of its rest length its pull fades to zero.
    Vec pull = span * (stiffness * extension / larger(length, l0 * 1.0e-6f));
    store(0.5f * stiffness * extension * extension, {pull, -pull});
    """,
    corners=2,
    parameter=SCALAR,
)


class Stretch:
    """Springs of one level.

    Attributes:
        stiffness: Spring constants [N/m], shape (S,).
        elements: The springs.
    """

    name = "stretch"

    def __init__(self, level: Level, youngs: Float[Tensor, " garments"]) -> None:
        """Weigh the springs of a level.

        Args:
            youngs: 2D Young's modulus of each garment [N/m].
        """
        modulus = youngs.to(level.rest)[level.spring_garment.long()] * level.spring_scale
        self.stiffness = 3.0 * modulus * level.spring_area / level.spring_length**2
        self._level = level
        self.elements = (Elements(_KERNELS, level.springs, [self.stiffness, level.spring_length], level=level),)

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        return self.elements[0].evaluate(x, force)

    def split(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " parts"], Int[Tensor, " parts"]]:
        """Energy of each spring [J] at the last evaluated positions, and the spring's garment."""
        return self.elements[0].energy, self._level.spring_garment

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of k (u u^T + max(0, 1 - l0/l) (I - u u^T)), summed at both ends [N/m]."""
        ends = self._level.springs.long()
        length = (x[ends[:, 1]] - x[ends[:, 0]]).norm(dim=1)
        lateral = (1.0 - self._level.spring_length / length.clamp_min(1e-12)).clamp_min(0.0)
        value = self.stiffness * (1.0 + 2.0 * lateral) / 3.0
        return add_at(torch.zeros_like(self._level.spacing), ends.T.reshape(-1), value.repeat(2))

    def rest_springs(self) -> tuple[np.ndarray, float]:
        """The springs [N/m], shape (S,)."""
        return self.stiffness.double().cpu().numpy(), 0.0
