"""One frame, from a cage to fine cloth: begin, descend level by level with safe moves, scale the detail, report.

`solve_frame` solves every frame, cold or warm. Each level begins at the coarser level's result, untangles crossings,
and makes rounds: contact is detected, the integrator steps, and cloth moves as far as possible without new crossings.
"""

from __future__ import annotations

import time
from dataclasses import replace

from torch import Tensor

from ...errors import SolveError
from ..contact.frame import LevelContact
from ..contact.metric import SMOOTH, HeldMetric
from ..contact.tangles import ROUNDS
from ..deadline import is_over
from ..forces.base import ForceModule
from ..integrate.base import Carry, System
from ..integrate.guard import PATIENCE
from ..integrate.saddle import leave_saddle
from ..integrate.solve import Budget, LevelReport, descend, solve_level
from ..level import Placed, unhindered
from .group import Group
from .level_forces import blame
from .outcome import measured, refuse_swallowed, scaled, state_left, telemetry_of
from .problem import LevelProblem, begin
from .values import FrameInput, Solved, State

STEPS, LONGEST = 4, 16
"""Steps of a round with contact, and without: pairs are detected again after a round."""
MOST, TOUCHING = 40, 3
"""Most steps of a level with contact: a multiple of the budget's, at most `MOST`, or the budget's if larger."""
FEWER = 1.0 / 3.0
"""Fraction of the steps after which a warm frame in contact may finish, if near rest: one round."""
WARM_ROUNDS = 4
"""Most untangling rounds of a warm frame, or of a level finer than the cage."""


def solve_frame(group: Group, frame: FrameInput, last: State | None) -> Solved:
    """Solve one frame.

    Args:
        group: Garments solved together.
        frame: The frame.
        last: State left by the last frame, or None for a cold start.

    Raises:
        SolveError: A term of the potential is not finite, or cloth lies wholly in a body.
    """
    problem = begin(group, frame, last)
    refuse_swallowed(problem)
    prepared = time.perf_counter()
    try:
        x, reports, module = None, list[LevelReport](), ForceModule(())
        for index in problem.levels:
            level = problem.level(index, since=prepared)
            x, made, module = solve_one_level(level, *problem.begun(index, x))
            if index < problem.finest:
                made[-1].energies = module.energies(x)
            reports += made
    except SolveError as error:
        broken = blame(group.garments, problem.forces[-1], problem.cage.points, error=error, at=frame.at)
        raise SolveError(broken) from error
    assert x is not None
    left = state_left(problem, x)
    shown, finish = scaled(problem, x), dict[str, object]()
    if problem.contact is not None:
        shown, finish = problem.contact.finish(shown)
    solved = time.perf_counter()
    telemetry = telemetry_of(problem, shown, module, reports=reports)
    contact, crossing = measured(problem, shown)
    telemetry |= {"contact": contact | finish} if contact else {}
    marks = (problem.began, prepared, solved, time.perf_counter())
    pairs = zip(("prepare", "solve", "measure"), marks, marks[1:], strict=False)
    telemetry["milliseconds"] = {name: round(1e3 * (end - start), 3) for name, start, end in pairs}
    points, spans = group.followers.placed(shown, problem.cage.origin, problem.cage.world), group.levels[-1].spans
    return Solved([points[span] for span in spans], left, telemetry, [crossing[span] for span in spans])


def solve_one_level(
    problem: LevelProblem, x: Tensor, smoothing: Tensor | None
) -> tuple[Placed, list[LevelReport], ForceModule]:
    """Solve a level, in rounds if contact is possible.

    Args:
        problem: The level.
        x: Start positions [m], shape (V, 3).
        smoothing: The move to remove a coarser mesh's facets in a cold start [m]; None in a warm frame.

    Returns:
        Final positions [m], a report per round, and the terms at the end.
    """
    level, view, budget = problem.level, problem.view, problem.budget
    if view is None:
        x = x if smoothing is None else leave_saddle(problem.alone, level, x + smoothing, outward=problem.outward)
        x, report = solve_level(problem.alone, problem.integrator, x, level=level.index, budget=budget)
        return unhindered(x), [report], problem.module
    x, reports = _untangle(problem, view, view.begun(x))
    if smoothing is not None:
        x = view.moved(x, x + smoothing) if level.index else x
        view, terms = view.terms(x)
        x = view.moved(x, leave_saddle(problem.system(view, terms, x), level, x, outward=problem.outward))
    carry, last, terms, made, touched, integrator = None, None, (), 0, False, problem.integrator
    while not made or made < _most_steps(problem.budget, reports[-1], touched=touched):
        view, terms = view.terms(x)
        touched = touched or bool(terms)
        system = problem.system(view, terms, x, last=last)
        resume = carry if last is not None and system.has_same_metric(last) else None
        of_round = _round_budget(budget, system, first=not made, steps=STEPS if terms else LONGEST)
        carry, report = descend(system, integrator, x, level=level.index, budget=of_round, resume=resume)
        report.remaining_move = _smooth_move(system, carry, report)
        reports.append(report)
        made += report.steps
        wanted = carry.x
        x, last = view.moved(x, wanted), system
        blocked = x is not wanted
        near = touched and made >= FEWER * budget.steps and report.remaining_move < problem.near * budget.tolerance
        if near or _is_last(report, blocked=blocked):
            break
        replaceable = smoothing is None and integrator.name != problem.untangler.name
        if carry.setbacks >= PATIENCE or (replaceable and _went_up(reports)):
            integrator, carry = problem.untangler, None
        elif blocked:  # The guard's corrections do not apply to the blocked positions.
            carry = None if carry.setbacks else replace(carry, x=x)
    return x, reports, ForceModule((*problem.module.forces, *terms))


def _untangle(problem: LevelProblem, view: LevelContact, x: Placed) -> tuple[Placed, list[LevelReport]]:
    """Rounds of few steps to shorten intersection contours: at the cage, and for crossings left from before."""
    level, budget = problem.level, problem.budget
    cold = level.index == 0
    x = view.laid_back(x) if cold else x
    reports: list[LevelReport] = []
    short = replace(budget, steps=min(STEPS, budget.steps), tolerance=0.0, extra=0, least=0)
    while len(reports) < (ROUNDS if cold else WARM_ROUNDS):
        if is_over() or not view.comes_apart(x):
            break
        view, terms = view.terms(x)
        system = problem.system(view, terms, x)
        wanted, report = solve_level(system, problem.untangler, x, level=level.index, budget=short)
        x = view.drawn(x, wanted) if cold else view.moved(x, wanted)
        reports.append(report)
    return x, reports


def _most_steps(budget: Budget, report: LevelReport, *, touched: bool) -> int:
    """Most steps of a level, given the last round's report: more with contact or far from rest."""
    most = budget.steps + budget.extra * budget.is_far(report.remaining_move)
    return max(most, min(MOST, TOUCHING * budget.steps)) if touched else most


def _went_up(reports: list[LevelReport]) -> bool:
    """Whether the last round began at a higher energy than the round before, whose steps met undetected contact."""
    return len(reports) > 1 and reports[-1].energy_before > reports[-2].energy_before


def _is_last(report: LevelReport, *, blocked: bool) -> bool:
    """Whether the rounds end here: no step was made, the budget is spent, or the cloth settled and was not blocked."""
    return report.stopped == "budget" or not report.steps or (report.stopped == "tolerance" and not blocked)


def _round_budget(budget: Budget, system: System, *, first: bool, steps: int) -> Budget:
    """The budget of a round; with a contact metric the tolerance shrinks, because the metric underestimates moves."""
    shrunk = SMOOTH if isinstance(system.metric, HeldMetric) else 1.0
    rest = budget.rest if first else 1.0
    tolerance, least = shrunk * budget.tolerance, budget.least if first else 0
    return replace(budget, steps=min(steps, budget.steps), extra=0, tolerance=tolerance, rest=rest, least=least)


def _smooth_move(system: System, carry: Carry, report: LevelReport) -> float:
    """The remaining move of the smooth part at the end of a round, in local edge lengths."""
    held = system.metric.held(carry.force) if isinstance(system.metric, HeldMetric) else None
    return report.remaining_move if held is None else system.remaining_move(held)
