"""A system of many patches that torch can differentiate, and unrolled steps: gradients through forces and solves.

All patches of a batch are garments of one group, so forces, metric and network each run once for all of them, and each
patch's energy is known. A `Twin` unrolls the same steps from a start that differs by noise.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from ...solver.forces.base import ForceModule
from ...solver.integrate.base import Carry, Integrator, Solver, System

NOISE = 1e-3
"""Root mean square of what a twin's start differs by, in local edge lengths: well above float32's rounding."""
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

    def apply_metric_inverse(
        self, force: Float[Tensor, "vertices 3"], solver: Solver | None = None
    ) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m], with gradients; without them where another solver is to be used in place of H0^-1."""
        if solver is not None:
            return super().apply_metric_inverse(force, solver)
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


def unrolled(integrator: Integrator, system: System, carry: Carry, steps: int) -> Carry:
    """The carry after so many steps."""
    for _ in range(steps):
        carry = integrator.step(system, carry)
    return carry


def detached(carry: Any) -> Any:
    """The carry without the graph that led to it."""
    if isinstance(carry, Tensor):
        return carry.detach()
    if isinstance(carry, tuple):
        return tuple(detached(item) for item in carry)
    if is_dataclass(carry) and not isinstance(carry, type):
        return replace(carry, **{f.name: detached(getattr(carry, f.name)) for f in fields(carry)})
    return carry


class Twin:
    """A second descent, whose start differs by noise, beside another."""

    def __init__(self, integrator: Integrator, system: JointSystem, x: Float[Tensor, "vertices 3"]) -> None:
        """Start near x [m]."""
        self._integrator, self._system = integrator, system
        drawn = torch.randn(x.shape, dtype=x.dtype, device=x.device) / 3.0**0.5
        self._carry = integrator.start(system, x + NOISE * system.spacing.unsqueeze(1) * drawn * system.free)
        self._before = torch.ones(system.garments, dtype=x.dtype, device=x.device)

    def unroll(self, steps: int, *, beside: Float[Tensor, "vertices 3"]) -> None:
        """Make so many steps; the other descent is at ``beside`` [m] before it makes as many."""
        self._carry = detached(self._carry)
        self._before = self._apart(beside).detach()
        self._carry = unrolled(self._integrator, self._system, self._carry, steps)

    def growth(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " garments"]:
        """How many times as far as before those steps the two are apart in each garment, the other being at x [m]."""
        return self._apart(x) / self._before

    def _apart(self, x: Tensor) -> Float[Tensor, " garments"]:
        """Root mean square distance to x in each garment, in local edge lengths."""
        system = self._system
        square = (self._carry.x - x).square().sum(dim=1) / system.spacing.square()  # V
        total, count = (
            square.new_zeros(system.garments).index_add_(0, system.owner, values)
            for values in (square, torch.ones_like(square))
        )
        return (total / count + 1e-12).sqrt()
