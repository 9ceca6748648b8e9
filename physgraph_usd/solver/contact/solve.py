"""The solve of one level that may touch something: detect, step, move safely, detect again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from ..deadline import is_over
from ..integrate.base import Carry, Integrator, System
from ..integrate.saddle import leave_saddle
from ..integrate.solve import Budget, LevelReport, solve_level
from ..level import Level, Placed
from .frame import LevelContact, Touch
from .metric import SMOOTH, HeldMetric

STEPS, LONGEST = 4, 16
"""Steps of a round where something is near, and where nothing is: then pairs are found anew."""
MOST, TOUCHING = 40, 3
"""Steps of a level where something touches: so many times the budget's, but no more than the first, or the budget's."""
NEAR = 10.0
"""Tolerances of remaining move under which a warm frame makes no more steps than its budget has."""
UNTANGLINGS, WARM_UNTANGLINGS = 25, 4
"""Most rounds that draw out what crosses: from cold at the cage, and in a warm frame."""
SHORTER = 4
"""How often a way is halved on which cloth that is held up raises the energy, before all of it stays."""
MakeSystem = Callable[[Sequence[Touch], Tensor, System | None], System]
"""Makes a level's system with contact terms at positions; the last round's tells of its metric, which may serve on."""


def solve_touching(
    make_system: MakeSystem,
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    view: LevelContact,
    level: Level,
    outward: Float[Tensor, " garments"],
    smoothing: Float[Tensor, "vertices 3"] | None,
    budget: Budget,
) -> tuple[Placed, list[LevelReport], tuple[Touch, ...]]:
    """Solve one level from positions in which what is apart is on its side.

    Args:
        make_system: Makes the level's system.
        integrator: Any integrator.
        x: Start positions [m].
        view: The level's view of what it may touch.
        level: The level.
        outward: As `leave_saddle` takes it.
        smoothing: The move that takes a coarser mesh's facets out of a cold start [m]; None in a warm frame.
        budget: When to stop.

    Returns:
        Final positions [m], a report a round, and the last round's contact terms.

    Raises:
        SolveError: The energy is not finite.
    """
    x, reports = _drawn_out(make_system, integrator, view.begun(x), view=view, level=level, budget=budget)
    if smoothing is not None:
        x = view.moved(x, x + smoothing) if level.index else x
        view, terms = view.terms(x)
        x = view.moved(x, leave_saddle(make_system(terms, x, None), level, x, outward=outward))
    carry, last, terms, listed, made, touched = None, None, (), None, 0, False
    while not made or made < _most(budget, reports[-1], touched=touched):
        listed = view.listed(x, listed)
        view, terms = view.terms(x, listed=listed)
        touched |= bool(terms)
        system = make_system(terms, x, last)
        resume = carry if last is not None and system.shares_metric(last) else None
        of_round = _budget_of(budget, system, first=not made, steps=STEPS if terms else LONGEST)
        y, report, ended = _descended(system, integrator, x, level=level.index, budget=of_round, resume=resume)
        reports.append(report)
        made += report.steps
        x, last = _fallen(partial(view.moved, listed=listed), system, x, y), system
        carry = ended if x is y else None if ended.setbacks else replace(ended, x=x)
        if _ends(report, short=x is not y) or (smoothing is None and _serves(report, budget, made)):
            break
    return x, reports, terms


def _most(budget: Budget, report: LevelReport, *, touched: bool) -> int:
    """How many steps a level makes, by its last round's report: more where something touches or it is far from rest."""
    most = budget.steps + budget.extra * budget.is_far(report.remaining_move)
    return max(most, min(MOST, TOUCHING * budget.steps)) if touched else most


def _ends(report: LevelReport, *, short: bool) -> bool:
    """Whether no round follows one of this report; it does where one that settled was cut short."""
    return report.stopped == "budget" or not report.steps or (report.stopped == "tolerance" and not short)


def _serves(report: LevelReport, budget: Budget, made: int) -> bool:
    """Whether a warm frame has made its steps and is near enough to rest."""
    return made >= budget.steps and report.remaining_move < NEAR * budget.tolerance


def _drawn_out(
    make_system: MakeSystem,
    integrator: Integrator,
    x: Placed,
    *,
    view: LevelContact,
    level: Level,
    budget: Budget,
) -> tuple[Placed, list[LevelReport]]:
    """Rounds of few steps in which contours shorten, at the cage and where the last level or frame left any."""
    cold, start = level.index == 0, x
    x = view.laid_back(x) if cold else x
    reports: list[LevelReport] = []
    short = replace(budget, steps=min(STEPS, budget.steps), tolerance=0.0, extra=0)
    while len(reports) < (UNTANGLINGS if cold else WARM_UNTANGLINGS):
        if is_over() or not view.comes_apart(x, order=cold):
            break
        view, terms = view.terms(x, order=cold)
        system = make_system(terms, x, None)
        y, report = solve_level(system, integrator, x, level=level.index, budget=short)
        x = _fallen(view.drawn if cold else view.moved, system, x, y)
        reports.append(report)
    return view.without_hope(x, start) if cold else x, reports


def _fallen(move: Callable[[Placed, Tensor], Placed], system: System, x: Placed, y: Tensor) -> Placed:
    """Where a safe move from x towards y ends, of a shorter way where cloth that is held up raises the energy [m]."""
    moved = move(x, y)
    if moved is y:
        return moved
    energy = system.energy_and_force(x)[0]
    most = energy + torch.finfo(x.dtype).eps * abs(energy)
    for _ in range(SHORTER):
        if system.energy_and_force(moved)[0] <= most:
            return moved
        y = x + 0.5 * (y - x)
        moved = move(x, y)
    return moved if system.energy_and_force(moved)[0] <= most else x


def _budget_of(budget: Budget, system: System, *, first: bool, steps: int) -> Budget:
    """The budget of a round: what a held metric calls a small move is that much smaller."""
    shrunk = SMOOTH if isinstance(system.metric, HeldMetric) else 1.0
    rest = budget.rest if first else 1.0
    return replace(budget, steps=min(steps, budget.steps), extra=0, tolerance=shrunk * budget.tolerance, rest=rest)


def _descended(
    system: System, integrator: Integrator, x: Tensor, *, level: int, budget: Budget, resume: Carry | None
) -> tuple[Tensor, LevelReport, Carry]:
    """One round's steps, its report with the remaining move of the smooth part, and where the integrator ended."""
    kept: list[Carry] = []
    y, report = solve_level(
        system,
        integrator,
        x,
        level=level,
        budget=budget,
        observe=lambda carry: kept.__setitem__(slice(None), [carry]),
        resume=resume,
    )
    held = system.metric.held(kept[-1].force) if isinstance(system.metric, HeldMetric) else None
    report.remaining_move = report.remaining_move if held is None else system.remaining_move(held)
    return y, report, kept[-1]
