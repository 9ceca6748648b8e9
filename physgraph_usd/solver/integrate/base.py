"""Integrators, and their view of the physics: forces and a metric."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..level import Level
from ..mesh.stencil import three_columns

Solver = Callable[[Tensor], Tensor]
"""Maps right-hand sides [N] to solutions [m], shape (V, 3)."""


@runtime_checkable
class ForceField(Protocol):
    """The only part of the physics visible to an integrator."""

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, ""], Float[Tensor, "vertices 3"]]:
        """Energy [J] and force [N] at positions x [m]."""
        ...

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of each vertex's Hessian block [N/m]."""
        ...


@runtime_checkable
class Preconditioner(Protocol):
    """A fixed, symmetric positive definite matrix with a fast solve."""

    @property
    def diagonal(self) -> Float[Tensor, " vertices"]:
        """The diagonal [N/m]."""
        ...

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m]."""
        ...

    def stiffened(self, stiffness: Float[Tensor, " vertices"]) -> Solver:
        """R H0^-1 R, R = min(1, D / K)^1/2, D = diag H0: the solve for cloth of stiffness max(D, K) [N/m]."""
        ...


@runtime_checkable
class Shortened(Preconditioner, Protocol):
    """A preconditioner with an additional shorter answer, for steps without a line search."""

    def short(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """The shorter answer [m]."""
        ...


class System:
    """One level in one frame, as seen by an integrator.

    Attributes:
        free: False at fixed vertices, shape (V, 1).
        spacing: Mean rest edge length at each vertex [m], shape (V,).
        level: The level's mesh, or None.
        metric: H0.
        evaluations: Number of force evaluations so far.
        metric_solves: Number of metric solves so far.
        failed: Number of evaluations in failed line searches.
    """

    def __init__(
        self,
        field: ForceField,
        metric: Preconditioner,
        *,
        free: Bool[Tensor, "vertices 1"],
        spacing: Float[Tensor, " vertices"],
        level: Level | None = None,
    ) -> None:
        """Combine a force field with its metric and mask."""
        self.field, self.metric = field, metric
        self.free, self.spacing, self.level = free, spacing, level
        self._all_free = level.all_free if level is not None and free is level.free else bool(free.all())
        self.evaluations = self.metric_solves = self.failed = 0

    def masked(self, field: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """The field, zero at fixed vertices."""
        return field if self._all_free else field * self._mask

    @cached_property
    def _mask(self) -> Float[Tensor, "vertices 3"]:
        """1 at free vertices, 0 at fixed ones."""
        return three_columns(self.free.squeeze(1).to(self.spacing.dtype))

    @property
    def counted(self) -> tuple[int, int, int]:
        """Evaluations, metric solves and failed evaluations so far."""
        return self.evaluations, self.metric_solves, self.failed

    @counted.setter
    def counted(self, counted: tuple[int, int, int]) -> None:
        """Go back to earlier counts, for discarded steps."""
        self.evaluations, self.metric_solves, self.failed = counted

    def has_same_metric(self, system: System) -> bool:
        """Whether curvature information from another system is valid for this system."""
        return self.metric is system.metric

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[float, Float[Tensor, "vertices 3"]]:
        """Energy [J] and force [N]; the force on fixed vertices is zero."""
        energy, force = self.evaluated(x)
        return float(energy), force

    def evaluated(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, ""], Float[Tensor, "vertices 3"]]:
        """`energy_and_force` without waiting for the energy, a float64 scalar on the device."""
        self.evaluations += 1
        energy, force = self.field.energy_and_force(x)
        return energy, self.masked(force)

    def apply_metric_inverse(
        self, force: Float[Tensor, "vertices 3"], solver: Solver | None = None
    ) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m]: the displacement of a linear cloth of the rest shape under F.

        Args:
            force: F [N].
            solver: A solve provided by the metric to replace H0^-1, or None.
        """
        self.metric_solves += 1
        return self.masked(self.metric.solve(force) if solver is None else solver(force))

    def apply_short_inverse(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m] for a step without a line search: the shorter answer if available."""
        short = self._short
        if short is None:
            return self.apply_metric_inverse(force)
        self.metric_solves += 1
        return self.masked(short(force))

    @cached_property
    def _short(self) -> Callable[[Tensor], Tensor] | None:
        """The shorter answer, if any; cached, because testing for a protocol reads all properties."""
        return self.metric.short if isinstance(self.metric, Shortened) else None

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of each vertex's Hessian block [N/m], positive."""
        return self.field.diagonal(x).clamp_min(torch.finfo(x.dtype).tiny)

    @cached_property
    def rest_diagonal(self) -> Float[Tensor, " vertices"]:
        """Diagonal of H0 [N/m], positive; 1 at fixed vertices."""
        return self.metric.diagonal.to(self.spacing)

    @cached_property
    def rest_diagonal_columns(self) -> Float[Tensor, "vertices 3"]:
        """`rest_diagonal` [N/m], in each of three columns."""
        return three_columns(self.rest_diagonal)

    @cached_property
    def per_edge(self) -> Float[Tensor, "vertices 3"]:
        """Factor from a move to its share of `relative_move` [1/m]."""
        return three_columns(1.0 / (self.spacing * self.free.sum().clamp_min(1).sqrt()))

    @cached_property
    def reach(self) -> Float[Tensor, " vertices"]:
        """The spacing [m], and 0 at fixed vertices."""
        return self.spacing * self._mask[:, 0]

    def remaining_move(self, preconditioned: Float[Tensor, "vertices 3"]) -> float:
        """RMS of H0^-1 F over the free vertices, in local edge lengths."""
        return float(self.relative_move(preconditioned))

    def relative_move(self, preconditioned: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """`remaining_move` as a tensor on the device, float64."""
        moves = (preconditioned * self.per_edge).reshape(-1)
        return torch.dot(moves, moves).double().sqrt()


@dataclass(frozen=True, eq=False)
class Carry:
    """The state passed from step to step by an integrator.

    Attributes:
        x: Positions [m].
        energy: Energy at x [J]; not a number while unread.
        force: Force at x [N].
        preconditioned: H0^-1 F at x [m], if known.
        mover: Maker of the last step: the integrator's name, "truncated", "halved", "quartered", "fallback" or
            "stayed".
        memory: The integrator's own state.
        setbacks: Consecutive corrections by the guard, up to this step.
        remaining: `System.remaining_move` at x, if known.
        unread: Energy and remaining move at x while they are on the device only (`ahead.read`), float64; or None.
    """

    x: Float[Tensor, "vertices 3"]
    energy: float
    force: Float[Tensor, "vertices 3"]
    preconditioned: Float[Tensor, "vertices 3"] | None = None
    mover: str = ""
    memory: Any = None
    setbacks: int = 0
    remaining: float | None = None
    unread: Float[Tensor, " 2"] | None = None

    def moved_by(self, mover: str) -> Carry:
        """This carry with a different mover."""
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
    """An integrator able to continue after a small change of the forces."""

    def resume(self, system: System, carry: Carry) -> Carry:
        """Evaluate the carry's positions under the system's forces, keeping curvature information."""
        ...


def resumed(integrator: Integrator, system: System, carry: Carry) -> Carry:
    """Continue from a carry under a system with slightly changed forces; restart if the integrator cannot continue."""
    if isinstance(integrator, Resumable):
        return integrator.resume(system, carry)
    return integrator.start(system, carry.x)


@runtime_checkable
class Transporting(Protocol):
    """An integrator whose curvature information can be transported to the next frame's cloth."""

    def curvature(self, carry: Carry) -> Any:
        """The curvature information in a carry's memory; None without any."""
        ...

    def transported(self, memory: Any, rotation: Float[Tensor, "vertices 3 3"]) -> Any:
        """The memory with its fields rotated at each vertex: the ``Carry.memory`` of a carry to resume."""
        ...


@runtime_checkable
class Following(Protocol):
    """An integrator able to learn from external steps."""

    def follow(self, system: System, carry: Carry, x: Float[Tensor, "vertices 3"]) -> Carry:
        """Evaluate x [m] and remember the displacement from the carry to x as a step."""
        ...


def followed(integrator: Integrator, system: System, carry: Carry, x: Float[Tensor, "vertices 3"]) -> Carry:
    """Continue from x [m], reached by an external step; restart if the integrator cannot follow."""
    if isinstance(integrator, Following):
        return integrator.follow(system, carry, x)
    return integrator.start(system, x)
