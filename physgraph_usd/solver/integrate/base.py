"""Integrators, and the little of the physics that they see: forces and a metric."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..level import Level

Solver = Callable[[Tensor], Tensor]
"""From right-hand sides [N] to solutions [m], shape (V, 3)."""


@runtime_checkable
class ForceField(Protocol):
    """The only part of the physics that an integrator sees."""

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, ""], Float[Tensor, "vertices 3"]]:
        """Energy [J] and force [N] at positions x [m]."""
        ...

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of each vertex's Hessian block [N/m]."""
        ...


@runtime_checkable
class Preconditioner(Protocol):
    """A fixed, symmetric positive definite matrix that can be solved with."""

    @property
    def diagonal(self) -> Float[Tensor, " vertices"]:
        """Its diagonal [N/m]."""
        ...

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m]."""
        ...

    def stiffened(self, stiffness: Float[Tensor, " vertices"]) -> Solver:
        """R H0^-1 R, R = min(1, D / K)^1/2: the solve for cloth as stiff as K [N/m] where that is more than D, H0's."""
        ...


@runtime_checkable
class Shortened(Preconditioner, Protocol):
    """A preconditioner that has a shorter answer, for steps that are made without a line search."""

    def short(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """The shorter answer [m]."""
        ...


class System:
    """One level in one frame, as an integrator sees it.

    Attributes:
        free: False where a vertex may not move, shape (V, 1).
        spacing: Mean rest edge length at each vertex [m], shape (V,).
        level: The level's mesh; None for a system that has none.
        lasting: Whether it is used again, in the next frame or for another descent.
        expected: Most steps that are to be made; recording pays where they are many or the system is lasting.
        field: The forces.
        metric: H0.
        evaluations: Number of force evaluations so far.
        metric_solves: Number of metric solves so far.
        failed: Number of those evaluations that line searches spent that found no step.
    """

    def __init__(
        self,
        field: ForceField,
        metric: Preconditioner,
        *,
        free: Bool[Tensor, "vertices 1"],
        spacing: Float[Tensor, " vertices"],
        level: Level | None = None,
        lasting: bool = False,
    ) -> None:
        """Join a force field with its metric and its mask."""
        self.lasting, self.expected = lasting, 0
        self.field, self.metric = field, metric
        self.free, self.spacing, self.level = free, spacing, level
        self._all_free = bool(free.all())
        self._mask = free.to(spacing.dtype)  # A factor of the vectors' own type saves a conversion at each product.
        self.evaluations = self.metric_solves = self.failed = 0

    @property
    def counted(self) -> tuple[int, int, int]:
        """Evaluations, metric solves and failed evaluations so far."""
        return self.evaluations, self.metric_solves, self.failed

    def has_same_metric(self, other: System) -> bool:
        """Whether what was learned of the curvature under another system holds under this one."""
        return self.metric is other.metric

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[float, Float[Tensor, "vertices 3"]]:
        """Energy [J] and force [N]; the force on vertices that may not move is zero."""
        self.evaluations += 1
        energy, force = self.field.energy_and_force(x)
        return float(energy), force if self._all_free else force * self._mask

    def apply_metric_inverse(
        self, force: Float[Tensor, "vertices 3"], solver: Solver | None = None
    ) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m]: the displacement that a linear cloth of the rest shape would answer with.

        Args:
            force: F [N].
            solver: What the metric gave to be used in place of H0^-1, or None.
        """
        self.metric_solves += 1
        move = self.metric.solve(force) if solver is None else solver(force)
        return move if self._all_free else move * self._mask

    def apply_short_inverse(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m] for a step without a line search: shorter where the metric has a shorter answer."""
        short = self._short
        if short is None:
            return self.apply_metric_inverse(force)
        self.metric_solves += 1
        move = short(force)
        return move if self._all_free else move * self._mask

    @cached_property
    def _short(self) -> Callable[[Tensor], Tensor] | None:
        """The shorter answer, if any; found once, since testing for a protocol reads all properties."""
        return self.metric.short if isinstance(self.metric, Shortened) else None

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of each vertex's Hessian block [N/m], positive."""
        return self.field.diagonal(x).clamp_min(torch.finfo(x.dtype).tiny)

    @cached_property
    def rest_diagonal(self) -> Float[Tensor, " vertices"]:
        """Diagonal of H0 [N/m], positive; 1 where a vertex may not move."""
        return self.metric.diagonal.to(self.spacing)

    @cached_property
    def reach(self) -> Float[Tensor, " vertices"]:
        """The spacing [m], and 0 where a vertex may not move."""
        return self.spacing * self._mask.squeeze(1)

    def remaining_move(self, preconditioned: Float[Tensor, "vertices 3"]) -> float:
        """RMS of H0^-1 F over the free vertices, in local edge lengths."""
        return float(self.relative_move(preconditioned))

    def relative_move(self, preconditioned: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """`remaining_move` where it was computed, float64."""
        relative = preconditioned.square().sum(dim=1) / self.spacing.square()
        return (relative.sum(dtype=torch.float64) / self.free.sum().clamp_min(1)).sqrt()


@dataclass(frozen=True, eq=False)
class Carry:
    """The state that an integrator hands from one step to the next.

    Attributes:
        x: Positions [m].
        energy: Energy at x [J].
        force: Force at x [N].
        preconditioned: H0^-1 F at x [m] where the integrator knows it.
        mover: Who made the last step: the integrator's name, "truncated", "halved", "quartered", "fallback" or
            "stayed".
        memory: The integrator's own state.
        setbacks: Corrections of the guard in a row, up to this step.
        remaining: `System.remaining_move` at x, where the integrator knows it.
    """

    x: Float[Tensor, "vertices 3"]
    energy: float
    force: Float[Tensor, "vertices 3"]
    preconditioned: Float[Tensor, "vertices 3"] | None = None
    mover: str = ""
    memory: Any = None
    setbacks: int = 0
    remaining: float | None = None

    def moved_by(self, mover: str) -> Carry:
        """This carry under another mover's name."""
        return replace(self, mover=mover)


@runtime_checkable
class Integrator(Protocol):
    """Turns forces into displacements."""

    name: str

    def start(self, system: System, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate the start positions [m] and prepare the memory."""
        ...

    def step(self, system: System, carry: Carry) -> Carry:
        """Make one step."""
        ...


@runtime_checkable
class Resumable(Protocol):
    """An integrator that can continue when the forces change a little."""

    def resume(self, system: System, carry: Carry) -> Carry:
        """Evaluate the carry's positions under the system's forces, keeping what was learned of their curvature."""
        ...


def resumed(integrator: Integrator, system: System, carry: Carry) -> Carry:
    """Go on from a carry under a system whose forces are a little different; start again where that is all one can."""
    if isinstance(integrator, Resumable):
        return integrator.resume(system, carry)
    return integrator.start(system, carry.x)


@runtime_checkable
class Following(Protocol):
    """An integrator that learns from steps that another makes."""

    def follow(self, system: System, carry: Carry, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x [m] and remember the displacement from the carry to there as a step of its own."""
        ...


def followed(integrator: Integrator, system: System, carry: Carry, x: Float[Tensor, "vertices 3"]) -> Carry:
    """Go on from x [m], to which another than the integrator has moved; start again where that is all one can."""
    if isinstance(integrator, Following):
        return integrator.follow(system, carry, x)
    return integrator.start(system, x)
