"""The solve of one level: steps until the remaining move is small or the budget is spent."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from ...errors import SolveError
from ..deadline import is_over
from .base import Carry, Integrator, System, resumed

FAR = 50.0
"""Remaining move, in tolerances, above which a level counts as unsolved: by default a visible tenth of a fine edge."""


@dataclass(frozen=True)
class Budget:
    """Stopping criteria.

    Attributes:
        steps: Most steps at one level.
        tolerance: Stop when the RMS of H0^-1 F is under this many local edge lengths.
        deadline: `time.perf_counter` value after which only the first `least` steps may begin, or None.
        rest: Remaining move, in tolerances, below which no step is made from the start: cloth nearly at rest stays.
        extra: Additional steps while the remaining move is over `FAR` tolerances.
        cancelled: Asked before each step whether the result is no longer needed; or None.
        least: Number of steps exempt from the deadline.
    """

    steps: int
    tolerance: float = 0.0
    deadline: float | None = None
    rest: float = 1.0
    extra: int = 0
    cancelled: Callable[[], bool] | None = None
    least: int = 0

    def is_spent(self, steps: int) -> bool:
        """Whether no further step may begin after ``steps`` steps, whatever the cloth's state."""
        late = self.deadline is not None and steps >= self.least and time.perf_counter() >= self.deadline
        return late or is_over() or (self.cancelled is not None and self.cancelled())

    def is_far(self, remaining_move: float) -> bool:
        """Whether the remaining move justifies extra steps; never for tolerance 0."""
        return self.tolerance > 0 and not remaining_move <= FAR * self.tolerance


@dataclass(eq=False)
class LevelReport:
    """Record of one level's solve.

    Attributes:
        level: Level index.
        vertices: Number of fine vertices.
        steps: Steps made.
        evaluations: Force evaluations.
        metric_solves: Metric solves.
        energy_before: Energy at the start [J].
        energy_after: Energy at the end [J].
        remaining_move: RMS of H0^-1 F at the end, in local edge lengths.
        milliseconds: Wall time of the level.
        stopped: "tolerance", "steps", "budget" or "stalled".
        movers: Number of steps by mover.
        energies: Energy of each term at the end [J], if requested by the solver's caller.
        failed: Evaluations in failed line searches.
    """

    level: int
    vertices: int
    steps: int = 0
    evaluations: int = 0
    metric_solves: int = 0
    energy_before: float = 0.0
    energy_after: float = 0.0
    remaining_move: float = 0.0
    milliseconds: float = 0.0
    stopped: str = "steps"
    movers: dict[str, int] = field(default_factory=dict)
    energies: dict[str, float] = field(default_factory=dict)
    failed: int = 0


def solve_level(
    system: System, integrator: Integrator, x: Float[Tensor, "vertices 3"], *, level: int, budget: Budget
) -> tuple[Float[Tensor, "vertices 3"], LevelReport]:
    """Final positions [m] and report of `descend`."""
    carry, report = descend(system, integrator, x, level=level, budget=budget)
    return carry.x, report


def descend(
    system: System,
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    level: int,
    budget: Budget,
    resume: Carry | None = None,
) -> tuple[Carry, LevelReport]:
    """Step until the remaining move is under the tolerance or the budget is spent.

    Args:
        system: The level in this frame.
        integrator: Any integrator.
        x: Start positions [m].
        level: Index for the report.
        budget: Stopping criteria.
        resume: The last carry of a solve under slightly different forces, to continue from; None starts at x.

    Returns:
        The integrator's last carry, including the final positions, and the report.

    Raises:
        SolveError: The energy at the start or at the end is not finite.
    """
    began, before = time.perf_counter(), system.counted
    report = LevelReport(level, x.shape[0])
    system.expected = budget.steps
    carry = integrator.start(system, x) if resume is None else resumed(integrator, system, resume)
    _require_finite(carry, level)
    report.energy_before = carry.energy
    movers: Counter[str] = Counter()
    while not (stopped := _reason_to_stop(system, carry, report.steps, budget)):
        carry = integrator.step(system, carry)
        movers[carry.mover] += 1
        report.steps += 1
    _require_finite(carry, level)
    report.stopped, report.movers = stopped, dict(movers)
    report.energy_after = carry.energy
    report.remaining_move = _remaining_move(system, carry)
    report.evaluations, report.metric_solves, report.failed = (
        now - then for now, then in zip(system.counted, before, strict=True)
    )
    report.milliseconds = 1e3 * (time.perf_counter() - began)
    return carry, report


def _reason_to_stop(system: System, carry: Carry, steps: int, budget: Budget) -> str:
    if carry.mover == "stayed":
        return "stalled"
    if budget.tolerance > 0 and _remaining_move(system, carry) < budget.tolerance * (1.0 if steps else budget.rest):
        return "tolerance"
    if steps >= budget.steps and (
        steps >= budget.steps + budget.extra or not budget.is_far(_remaining_move(system, carry))
    ):
        return "steps"
    if budget.is_spent(steps):
        return "budget"
    return ""


def _remaining_move(system: System, carry: Carry) -> float:
    if carry.remaining is not None:
        return carry.remaining
    preconditioned = carry.preconditioned
    return system.remaining_move(
        preconditioned if preconditioned is not None else system.apply_metric_inverse(carry.force)
    )


def _require_finite(carry: Carry, level: int) -> None:
    if not bool(carry.x.isfinite().all()) or carry.energy != carry.energy or abs(carry.energy) == float("inf"):
        raise SolveError(f"level {level}: the energy or a position is not finite (energy {carry.energy} J)")
