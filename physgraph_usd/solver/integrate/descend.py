"""The solve of one level: steps until the remaining move is small or the budget is spent."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from ...errors import SolveError
from ..level import Level
from .ahead import Steps
from .base import Carry, Integrator, System, resumed
from .stop import SEEN_PART, SEEN_STEPS, SEEN_TURN, Budget


@dataclass(eq=False)
class LevelReport:
    """Record of one level's solve.

    Attributes:
        vertices: Number of fine vertices.
        energy_before: Energy at the start [J].
        energy_after: Energy at the end [J].
        remaining_move: RMS of H0^-1 F at the end, in local edge lengths.
        milliseconds: Wall time of the level.
        stopped: "tolerance", "seen", "steps", "budget" or "stalled"; "seen" once no visible motion is left.
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
    carry = integrator.start(system, x) if resume is None else resumed(integrator, system, resume)
    _require_finite(carry, level)
    report.energy_before = carry.energy
    movers: Counter[str] = Counter()
    motion = VisibleMotion(system.level, carry.x) if budget.warm and system.level is not None else None
    steps = Steps(system, integrator, budget)
    while not (stopped := _reason_to_stop(system, carry, report.steps, budget, next_is_made=steps.next_is_made)):
        carry = steps.after(carry, report.steps)
        movers[carry.mover] += 1
        report.steps += 1
        if motion is not None and motion.has_ended(carry.x, report.steps) and not carry.setbacks:
            stopped = _reason_to_stop(system, carry, report.steps, budget) or "seen"
            break
    _require_finite(carry, level)
    report.stopped, report.movers = stopped, dict(movers)
    report.energy_after = carry.energy
    report.remaining_move = _remaining_move(system, carry)
    report.evaluations, report.metric_solves, report.failed = (
        end - start for end, start in zip(system.counted, before, strict=True)
    )
    report.milliseconds = 1e3 * (time.perf_counter() - began)
    return carry, report


def _reason_to_stop(system: System, carry: Carry, steps: int, budget: Budget, *, next_is_made: bool = False) -> str:
    if carry.mover == "stayed":
        return "stalled"
    return budget.reason(steps, lambda: _remaining_move(system, carry), next_is_made=next_is_made)


def _remaining_move(system: System, carry: Carry) -> float:
    if carry.remaining is not None:
        return carry.remaining
    preconditioned = carry.preconditioned
    return system.remaining_move(
        preconditioned if preconditioned is not None else system.apply_metric_inverse(carry.force)
    )


class VisibleMotion:
    """Rotation of face normals during a descent, on a sample of the faces."""

    def __init__(self, level: Level, x: Float[Tensor, "vertices 3"]) -> None:
        """Take the start [m]."""
        self._level, self._normals = level, _directions(level, x)

    def has_ended(self, x: Float[Tensor, "vertices 3"], steps: int) -> bool:
        """Whether most normals kept their direction over the last `SEEN_STEPS`; tested when these divide ``steps``."""
        if steps % SEEN_STEPS or not len(self._normals):
            return False
        before, self._normals = self._normals, _directions(self._level, x)
        turned = torch.linalg.vecdot(before, self._normals) < math.cos(math.radians(SEEN_TURN))
        return float(turned.float().mean()) <= SEEN_PART


def _directions(level: Level, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "triangles 3"]:
    """Unit normals of a sample of a level's triangles at x [m]."""
    normals = level.some_normals(x)
    return normals * torch.linalg.vector_norm(normals, dim=1, keepdim=True).clamp_min(1e-30).reciprocal()


def _require_finite(carry: Carry, level: int) -> None:
    if not bool(carry.x.isfinite().all()) or carry.energy != carry.energy or abs(carry.energy) == float("inf"):
        raise SolveError(f"level {level}: the energy or a position is not finite (energy {carry.energy} J)")
