"""Guide: ties the average of the fine cloth around each coarse vertex to the same average of the coarse animation.

    E = 1/2 sum_c k_g A_c s_c |(R x)_c - (R P x_c)_c|^2 + 1/2 sum_v k_g a_v p_v |x_v - (P x_c)_v|^2

| symbol | here | meaning |
|---|---|---|
| k_g | ``stiffness`` | guide stiffness [N/m^3] |
| A_c | coarse vertex area, the sum of its part of fine areas [m^2] |
| R | ``average`` | row-normalised transpose of the prolongation P, weighted by fine area |
| s_c | painted ``guideScale`` |
| p_v | 10 pin / (1 - pin) | soft pins: 0 for pin weight 0, unbounded towards 1 |

The target is the average of the upsampled cage, not the cage vertex itself: at a rim and on a curved cage the average
lies inside the vertex, and cloth at rest would be pushed outwards (by 0.2 fine edges at a rim). Wrinkles with zero mean
over a coarse vertex's neighbourhood cost nothing, so large motion remains under the artist's control.
"""

from __future__ import annotations

import copy

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..level import PIN_MARGIN, Level
from ..mesh.stencil import Stencil, three_columns

SOFT_PIN = 10.0
"""Stiffness of a pin of weight 1/2, in guide stiffnesses."""


class GuideMap:
    """The averaging operator of one level and its transpose; built once per shot."""

    def __init__(self, level: Level) -> None:
        """Build R, its transpose and the areas from the level's prolongation."""
        area = sp.diags(level.vertex_area.double().cpu().numpy())
        fine_areas = sp.csr_matrix(level.from_coarse.T @ area)
        self.coarse_area = np.asarray(fine_areas.sum(axis=1)).ravel()
        rows = sp.diags(1.0 / np.maximum(self.coarse_area, np.finfo(float).tiny))
        matrix = sp.csr_matrix(rows @ fine_areas)
        self.spread_matrix = sp.csr_matrix(matrix.T)
        self.average, self.spread = (
            Stencil(stencil, dtype=level.dtype, device=level.device, threads=level.threads)
            for stencil in (matrix, self.spread_matrix)
        )
        self.squares = sp.csr_matrix(matrix.multiply(matrix).T)
        self.fine_areas = sp.csr_matrix(fine_areas.T)
        # Subdivision keeps every cage vertex, so each row of the transpose has an entry.
        of_coarse = sp.csc_matrix(level.from_coarse)
        self.garment = level.vertex_garment[torch.as_tensor(of_coarse.indices[of_coarse.indptr[:-1]]).long()]


class Guide:
    """The guide of one level: constant weights, a new target in each frame.

    Attributes:
        coarse: The cage targeted at creation [m].
    """

    name = "guide"

    def __init__(
        self,
        level: Level,
        guide_map: GuideMap,
        stiffness: Float[Tensor, " coarse"],
    ) -> None:
        """Weigh the ties of a level; `retarget` sets the coarse positions.

        Args:
            guide_map: Averaging operator of the level.
            stiffness: k_g s_c at each coarse vertex [N/m^3].
        """
        self._map, self._level = guide_map, level
        per_area = stiffness.double().cpu().numpy()
        pin = level.pin.double().cpu().numpy()
        soft = np.where((pin > 0) & (pin < 1.0 - PIN_MARGIN), SOFT_PIN * pin / np.maximum(1.0 - pin, PIN_MARGIN), 0.0)
        self._coarse_weight = per_area * guide_map.coarse_area
        self._pin_weight = soft * np.asarray(guide_map.fine_areas @ per_area).ravel()
        self._weight, self._pin = (
            three_columns(torch.as_tensor(weight, dtype=level.dtype, device=level.device))
            for weight in (self._coarse_weight, self._pin_weight)
        )
        compliance = np.divide(1.0, per_area, out=np.zeros_like(per_area), where=per_area > 0)
        self._compliance = three_columns(torch.as_tensor(compliance, dtype=level.dtype, device=level.device))
        self._has_soft_pins = bool(soft.any())
        self._target = torch.zeros((len(per_area), 3), dtype=level.dtype, device=level.device)
        self._base = torch.zeros_like(level.rest)
        self.coarse = torch.zeros_like(self._target)

    def retarget(self, coarse: Float[Tensor, "coarse 3"], push: Float[Tensor, "coarse 3"] | None = None) -> Guide:
        """The guide of a frame.

        A push on the cage shifts the target by d, so that the guide pulls each fine vertex by the subdivided push times
        the area of the vertex: R^T W = k_g A P, and W d = k_g A_c s_c d.

        Args:
            coarse: The cage's positions [m], shape (C, 3).
            push: Force per area at each vertex of the cage [N/m^2], without effect where the guide is zero; or None.
        """
        base = self._level.base.apply(coarse)
        target = self._map.average.apply(base)
        guide = self.aimed(target if push is None else target + self._compliance * push, base)
        guide.coarse = coarse
        return guide

    @property
    def aims(self) -> tuple[Tensor, ...]:
        """Target averages, shape (C, 3), and the upsampled cage, shape (V, 3) [m]."""
        return self._target, self._base

    def aimed(self, *aims: Tensor) -> Guide:
        """The guide with other `aims` [m]."""
        guide = copy.copy(self)
        guide._target, guide._base = aims
        return guide

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        lag = self._map.average.apply(x) - self._target
        pull = self._weight * lag
        force -= self._map.spread.apply(pull)
        energy = 0.5 * torch.dot(pull.reshape(-1), lag.reshape(-1)).double()
        if self._has_soft_pins:
            stray = x - self._base
            force -= self._pin * stray
            energy = energy + 0.5 * (self._pin * stray * stray).sum(dtype=torch.float64)
        return energy

    def split(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " parts"], Int[Tensor, " parts"]]:
        """Energy of each tie [J] at positions x [m], and the tie's garment."""
        lag = self._map.average.apply(x) - self._target
        energy, owner = 0.5 * (self._weight * lag * lag).sum(dim=1), self._map.garment
        if not self._has_soft_pins:
            return energy, owner
        stray = 0.5 * (self._pin * (x - self._base).square()).sum(dim=1)
        return torch.cat([energy, stray]), torch.cat([owner, self._level.vertex_garment])

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """sum_c k_g A_c R_cv^2, plus the soft pins [N/m]."""
        value = np.asarray(self._map.squares @ self._coarse_weight).ravel() + self._pin_weight
        return torch.as_tensor(value, dtype=x.dtype, device=x.device)

    def hessian(self) -> sp.csr_matrix:
        """The exact scalar Hessian R^T W R + pins [N/m], shape (V, V), for external solvers."""
        spread = self._map.spread_matrix
        return sp.csr_matrix(spread @ sp.diags(self._coarse_weight) @ spread.T + sp.diags(self._pin_weight))

    def rest_springs(self) -> tuple[float, np.ndarray]:
        """The lumped guide [N/m]: the row sums of R^T W R and the pins, shape (V,).

        The exact product couples every pair of fine vertices around a coarse vertex, which would fill the factor.
        Lumping is accurate for long waves; for short waves stretch and bending outweigh the guide.
        """
        return 0.0, self._map.spread_matrix @ self._coarse_weight + self._pin_weight
