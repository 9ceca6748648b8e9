"""Steps through which gradients flow: forces and metric solves as functions that torch can walk back through."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..integrate.base import ForceField, System

NUDGE = 1e-2
"""Displacement of the difference of forces behind a Hessian product, in local edge lengths."""


class _EnergyForce(torch.autograd.Function):
    """Energy and force; the energy's derivative is -F, the force's a difference of forces."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, field: ForceField, spacing: Tensor, through: bool) -> tuple[Tensor, Tensor]:
        energy, force = field.energy_and_force(x)
        ctx.save_for_backward(x, force, spacing)
        ctx.field, ctx.through = field, through
        return energy, force

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        x, force, spacing = ctx.saved_tensors
        by_energy, by_force = gradients
        gradient = -force * by_energy.to(force)
        largest = (by_force.square().sum(dim=1).sqrt() / spacing).max() if ctx.through else torch.tensor(0.0)
        if float(largest) > 0:
            nudge = (NUDGE / largest) * by_force
            there, back = (ctx.field.energy_and_force(x + sign * nudge)[1] for sign in (1.0, -1.0))
            gradient = gradient + (there - back) * (largest / (2.0 * NUDGE))
        return gradient, None, None, None


class _MetricSolve(torch.autograd.Function):
    """H0^-1 F; H0 is symmetric, so it is its own transpose."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, system: UnrolledSystem) -> Tensor:
        ctx.system = system
        return System.apply_metric_inverse(system, force)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None]:  # type: ignore[override]
        return System.apply_metric_inverse(ctx.system, gradients[0].contiguous()), None


class UnrolledSystem(System):
    """A system that torch can differentiate and that keeps every energy it gave.

    Attributes:
        energies: Energies [J] in the order of the evaluations, float64 scalars.
    """

    def __init__(self, system: System, *, through_forces: bool) -> None:
        """Wrap a system.

        Args:
            system: The system.
            through_forces: Let gradients flow through forces into the positions they were evaluated at; else only
                through displacements (A19).
        """
        super().__init__(system.field, system.metric, free=system.free, spacing=system.spacing, level=system.level)
        self._through = through_forces
        self.energies: list[Tensor] = []

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[float, Float[Tensor, "vertices 3"]]:
        """Energy [J] and force [N], with gradients."""
        self.evaluations += 1
        energy, force = _EnergyForce.apply(x, self.field, self.spacing, self._through)  # pyright: ignore
        self.energies.append(energy)
        force = force if self._through else force.detach()
        return float(energy.detach()), force * self.free

    def apply_metric_inverse(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m], with gradients."""
        if not force.requires_grad:
            return super().apply_metric_inverse(force)
        return _MetricSolve.apply(force, self)  # pyright: ignore[reportReturnType]
