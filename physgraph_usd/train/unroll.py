"""A system of many patches that torch can differentiate: gradients through forces and metric solves.

All patches of a batch are garments of one group, so forces, metric and network each run once for all of them, and each
patch's energy is known.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from ..forces.base import ForceModule
from ..integrate.base import System

NUDGE = 1e-2
"""Displacement of the difference of forces behind a Hessian product, in local edge lengths."""


class JointSystem(System):
    """A system with gradients that knows the energy of each garment.

    Attributes:
        owner: Garment of each vertex, shape (V,).
        garments: Number of garments.
        energies: Energy of each garment [J] at each evaluation, in their order.
    """

    def __init__(self, system: System, *, through_forces: bool) -> None:
        """Take over a system.

        Args:
            system: The system; it has a level.
            through_forces: Let gradients flow through forces into the positions they were evaluated at; else only
                through displacements (A19).
        """
        level = system.level
        assert level is not None
        super().__init__(system.field, system.metric, free=system.free, spacing=system.spacing, level=level)
        self.owner, self.garments = level.vertex_garment.long(), len(level.spans)
        self._through = through_forces
        self.energies: list[Tensor] = []

    def each(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " garments"], Float[Tensor, "vertices 3"]]:
        """Energy of each garment [J] and the force [N]."""
        return cast(ForceModule, self.field).energy_and_force_each(x.contiguous(), self.garments)

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[float, Float[Tensor, "vertices 3"]]:
        """Energy [J] and force [N], with gradients."""
        self.evaluations += 1
        energies, force = cast(tuple[Tensor, Tensor], _EnergyForce.apply(x, self))
        self.energies.append(energies)
        force = force if self._through else force.detach()
        return float(energies.detach().sum()), force * self.free

    def apply_metric_inverse(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m], with gradients."""
        return cast(Tensor, _MetricSolve.apply(force, self))

    @property
    def through(self) -> bool:
        """Whether gradients flow through forces."""
        return self._through


class _EnergyForce(torch.autograd.Function):
    """Energies and force; an energy's derivative is -F, the force's a difference of forces."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, system: JointSystem) -> tuple[Tensor, Tensor]:
        energies, force = system.each(x)
        ctx.save_for_backward(x, force)
        ctx.system = system
        return energies, force

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None]:  # type: ignore[override]
        x, force = ctx.saved_tensors
        by_energy, by_force = gradients
        system: JointSystem = ctx.system
        gradient = -force * by_energy.to(force)[system.owner].unsqueeze(1)
        if not system.through:
            return gradient, None
        size = by_force.square().sum(dim=1).sqrt() / system.spacing
        largest = torch.zeros(system.garments, dtype=size.dtype, device=size.device)
        largest = largest.scatter_reduce(0, system.owner, size, "amax").clamp_min(1e-30)[system.owner].unsqueeze(1)
        nudge = NUDGE / largest * by_force
        there, back = (system.field.energy_and_force((x + sign * nudge).contiguous())[1] for sign in (1.0, -1.0))
        return gradient + (there - back) * (largest / (2.0 * NUDGE)), None


class _MetricSolve(torch.autograd.Function):
    """H0^-1 F; H0 is symmetric, so it is its own transpose."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, system: JointSystem) -> Tensor:
        ctx.system = system
        return System.apply_metric_inverse(system, force)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None]:  # type: ignore[override]
        return System.apply_metric_inverse(ctx.system, gradients[0].contiguous()), None
