"""One frame, from a cage to fine cloth.

    problem = begin(group, frames, last)      cage repaired, start chosen, lasting terms
    untangle the cage                         in a cold frame whose cage crosses itself
    for level in problem.levels:              all in a cold frame, else the finest
        x = the coarser result, upsampled     in a warm frame the last frame's detail, moved safely
        until converged or out of steps:      a round
            terms = contact detected at x
            wanted = x after the integrator's steps
            x = as near to wanted as is possible without new crossings
    x = out of bodies, detail scaled, within limits, worse patches on the subdivided cage
    return points, state for the next frame, telemetry

`solve_frame` solves every frame in this way. `solve_soundly` solves a frame once more from the cage if its result is
worse than expected from there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from torch import Tensor

from ...errors import SolveError
from ..contact.cloth import LevelContact
from ..contact.frame import STALLED
from ..contact.metric import HELD_TOLERANCE, HeldMetric
from ..deadline import is_over
from ..forces.base import ForceModule
from ..integrate.base import Carry, Integrator, System, Transporting
from ..integrate.descend import LevelReport, descend, solve_level
from ..integrate.guard import PATIENCE
from ..integrate.saddle import leave_saddle
from ..integrate.stop import UNTANGLINGS, WARM_UNTANGLINGS
from ..level import Placed, unhindered
from ..scene import GIVEN_UP
from .level_forces import blame
from .outcome import limited, measured, next_state, patched, refuse_swallowed, scaled, telemetry_of
from .problem import LevelProblem, Problem, begin
from .state import State

EQUAL_ENERGY = 1e-3
"""Fraction of the energies' size below which two energies count as equal: sums are in single precision."""
MORE = 2
"""Crossings with a body allowed for each one of the cage: cloth pinched by bodies crosses them about as often."""
MOST_WAIT = 64
"""Most frames between two starts from the cage. The wait doubles with each unsuccessful start, so such starts cost
little in a shot with cloth impossible to pull apart."""


class WorseStartError(Exception):
    """A coarse level crosses as often as the result to be replaced: finer levels cross more often still."""


def solve_frame(problem: Problem, *, fewer_than: float = math.inf) -> tuple[State, dict[str, Any]]:
    """Solve one frame.

    Args:
        fewer_than: Crossings of a coarse level from which on the frame is not wanted.

    Returns:
        The cloth after the frame, and telemetry as plain values.

    Raises:
        SolveError: A term of the potential is not finite, or cloth lies wholly in a body.
        WorseStartError: A coarse level has ``fewer_than`` crossings or more.
    """
    refuse_swallowed(problem)
    prepared = time.perf_counter()
    try:
        problem, reports = _with_cage_untangled(problem, start_time=prepared, fewer_than=fewer_than)
        if problem.hopeless:
            x, level_reports, module, memory = problem.subdivided, [], problem.module, None
        else:
            x, level_reports, module, memory = _solve_levels(problem, start_time=prepared, fewer_than=fewer_than)
    except SolveError as error:
        garments, forces = problem.group.garments, problem.forces[-1]
        broken = blame(garments, forces, problem.cage.points, error=error, at=problem.at)
        raise SolveError(broken) from error
    finish, visible = dict[str, object](), x
    if problem.contact is not None:
        visible, finish = problem.contact.finish(x)
        x = visible if problem.contact.is_out(visible) else x  # What is pushed out in vain is not carried on.
    unlimited = scaled(problem, visible)
    solution = limited(problem, unlimited)
    visible, following, figures = patched(problem, solution)
    solved = time.perf_counter()
    telemetry = telemetry_of(problem, solution, module, solved=unlimited, reports=[*reports, *level_reports])
    telemetry |= {"start": GIVEN_UP} if problem.hopeless else {}
    contact, crossing = measured(problem, visible)
    telemetry |= {"contact": contact | finish} if contact else {}
    telemetry |= {"follows_cage": figures} if figures else {}
    marks = (problem.began, prepared, solved, time.perf_counter())
    pairs = zip(("prepare", "solve", "measure"), marks, marks[1:], strict=False)
    telemetry["milliseconds"] = {name: round(1e3 * (end - start), 3) for name, start, end in pairs}
    return next_state(problem, x, visible, memory, following=following, crossing=crossing), telemetry


def _solve_levels(
    problem: Problem, *, start_time: float, fewer_than: float
) -> tuple[Placed, list[LevelReport], ForceModule, Any]:
    """Solve the levels of a frame, coarsest first; arguments as for `_with_cage_untangled`.

    Returns:
        As `solve_one_level`, of the finest level, with the reports of all levels.
    """
    settings, x, reports = problem.group.settings, None, list[LevelReport]()
    module, memory = ForceModule(()), None
    for index in problem.levels:
        level = problem.level(index, start_time=start_time)
        if index == problem.finest and settings.show_round is not None:
            level = replace(level, show=partial(_show, problem, settings.show_round))
        x, level_reports, module, memory = solve_one_level(level, *problem.level_start(index, x))
        if index == problem.finest and settings.ended is not None:
            settings.ended(level, x)
        if index < problem.finest:
            level_reports[-1].energies = module.energies(x)
            if level.view is not None and level.view.look(x).hopeful.count >= fewer_than:
                raise WorseStartError
        reports += level_reports
    assert x is not None
    return x, reports, module, memory


def _show(problem: Problem, show: Callable[[Mapping[str, np.ndarray]], None], x: Placed) -> None:
    """Show positions of the finest level [m], as `SolveSettings.show_round`."""
    paths = [garment.path for garment in problem.group.garments]
    show(dict(zip(paths, problem.group.per_garment(problem.placed(scaled(problem, x))), strict=True)))


def solve_one_level(
    problem: LevelProblem, x: Tensor, smoothing: Tensor | None
) -> tuple[Placed, list[LevelReport], ForceModule, Any]:
    """Solve a level, in rounds if contact is possible.

    Args:
        x: Start positions [m], shape (V, 3).
        smoothing: The move to remove a coarser mesh's facets in a cold start [m]; None in a warm frame.

    Returns:
        Final positions [m], a report per round, the terms at the end, and curvature information for the next frame.
    """
    level, view, budget = problem.level, problem.view, problem.budget
    if view is None:
        return _solve_without_contact(problem, x, smoothing)
    x, reports = _untangle(problem, view, Placed(view.closed(x)), view.moved, most=WARM_UNTANGLINGS)
    if smoothing is not None:
        x = view.moved(x, problem.held(x + smoothing)) if level.index else x
        terms = view.terms(x)
        x = view.moved(x, leave_saddle(problem.system(view, terms, x), level, x, outward=problem.outward))
    carry, last, terms, steps, blocked, touched, integrator = None, None, (), 0, False, False, problem.integrator
    counts = [view.look(x).hopeful.count]
    while True:
        terms = view.terms(x)
        touched = touched or bool(terms)
        system = problem.system(view, terms, x, last=last)
        resume = _resumed(problem, x) if last is None else carry if system.has_same_metric(last) else None
        shrunk = HELD_TOLERANCE if isinstance(system.metric, HeldMetric) else 1.0
        in_bodies = sum(view.look(x).in_bodies)
        round_budget = budget.for_round(
            steps=steps, touching=bool(terms), in_bodies=in_bodies > 0, blocked=blocked, shrunk=shrunk
        )
        carry, report = descend(system, integrator, x, level=level.index, budget=round_budget, resume=resume)
        report.remaining_move = _smooth_move(system, carry, report)
        reports.append(report)
        steps += report.steps
        wanted = problem.held(carry.x)
        previous, x, last = x, view.moved(x, wanted), system
        blocked = x is not wanted
        if problem.show is not None:
            problem.show(x)
        emerging, counts = sum(view.look(x).in_bodies) < in_bodies, [*counts, view.look(x).hopeful.count]
        missing, stuck = _missing(previous, x, wanted) if blocked else 0.0, _is_stuck(counts)
        if budget.ends(report, steps=steps, touched=touched, emerging=emerging, missing=missing, stuck=stuck):
            memory = _curvature(integrator, carry)
            break
        if carry.setbacks >= PATIENCE:
            integrator, carry = problem.untangler, None
        elif x is not carry.x:  # The guard's corrections do not apply to other positions.
            carry = None if carry.setbacks else replace(carry, x=x)
    return x, reports, problem.module.joined_by(terms), memory


def _is_stuck(counts: Sequence[int]) -> bool:
    """Whether crossings are left, and in none of the last `STALLED` rounds fewer than before.

    Args:
        counts: Number of crossings at the start and after each round. With `STALLED` numbers or fewer, any crossings
            count as stuck.
    """
    late = counts[-STALLED:]
    return min(late) > 0 and min(late) >= min(counts[:-STALLED], default=0)


def _solve_without_contact(
    problem: LevelProblem, x: Tensor, smoothing: Tensor | None
) -> tuple[Placed, list[LevelReport], ForceModule, Any]:
    """Solve a level without contact detection; arguments and results of `solve_one_level`."""
    system, level, resume = problem.without_contact, problem.level, _resumed(problem, x)
    x = x if smoothing is None else leave_saddle(system, level, problem.held(x + smoothing), outward=problem.outward)
    carry, report = descend(system, problem.integrator, x, level=level.index, budget=problem.budget, resume=resume)
    placed = unhindered(problem.held(carry.x))
    if problem.show is not None:
        problem.show(placed)
    return placed, [report], problem.module, _curvature(problem.integrator, carry)


def _missing(start: Tensor, x: Tensor, wanted: Tensor) -> float:
    """Part of the wanted moves that was blocked: the mean distance missing over the mean distance wanted."""
    return float((wanted - x).norm(dim=1).sum() / (wanted - start).norm(dim=1).sum().clamp_min(1e-30))


def _resumed(problem: LevelProblem, x: Tensor) -> Carry | None:
    """A carry at x [m] with the last frame's memory, to resume; None without."""
    if problem.curvature is None or not isinstance(problem.integrator, Transporting):
        return None
    return Carry(x, math.inf, x, memory=problem.curvature)


def _curvature(integrator: Integrator, carry: Carry) -> Any:
    """Curvature information for the next frame, or None."""
    return integrator.curvature(carry) if isinstance(integrator, Transporting) else None


def _with_cage_untangled(
    problem: Problem, *, start_time: float, fewer_than: float
) -> tuple[Problem, list[LevelReport]]:
    """A cold frame that starts at its untangled cage, and a report per round.

    Pieces of cloth that are mostly tangled afterwards are given up.

    Args:
        start_time: Time at which the frame was ready to be solved [s].
        fewer_than: As in `solve_frame`.
    """
    contact = problem.contact
    if contact is None or problem.warm or not contact.crossed:
        return problem, []
    level = problem.level(0, start_time=start_time)
    view, start = level.view, problem.level_start(0, None)[0]
    assert view is not None
    x, reports = _untangle(level, view, Placed(view.closed(start)), view.drawn, most=UNTANGLINGS)
    if view.look(x).hopeful.count >= fewer_than:
        raise WorseStartError
    return replace(problem, contact=contact.after_cage(x), prerolled=x), reports


def _untangle(
    problem: LevelProblem, view: LevelContact, x: Placed, move: Callable[[Placed, Tensor], Placed], *, most: int
) -> tuple[Placed, list[LevelReport]]:
    """Rounds of few steps to shorten intersection contours.

    Rounds end early if whole pieces of cloth are tangled, and would be still at the pace of the last `STALLED` rounds.

    Args:
        x: Positions [m].
        move: Moves the cloth to wanted positions [m] as far as is safe.
        most: Most rounds.
    """
    level, budget = problem.level, problem.budget
    reports: list[LevelReport] = []
    short, counts = budget.for_untangling(), [view.look(x).hopeful.count]
    for rounds_left in reversed(range(most)):
        if is_over() or not counts[-1]:
            break
        terms = view.terms(x)
        system = problem.system(view, terms, x)
        wanted, report = solve_level(system, problem.untangler, x, level=level.index, budget=short)
        x = move(x, wanted)
        reports.append(report)
        counts.append(view.look(x).hopeful.count)
        gone = counts[-1 - STALLED] - counts[-1] if len(counts) > STALLED else math.inf
        if counts[-1] * STALLED > gone * rounds_left and view.tangled_pieces(x) is not None:
            break
    return x, reports


def _smooth_move(system: System, carry: Carry, report: LevelReport) -> float:
    """The remaining move of the smooth part at the end of a round, in local edge lengths."""
    metric = system.metric
    return system.remaining_move(metric.held(carry.force)) if isinstance(metric, HeldMetric) else report.remaining_move


class RunawayError(SolveError):
    """Cloth ending with more energy than its upsampled cage, from any start."""


def solve_soundly(problem: Problem) -> tuple[State, dict[str, Any]]:
    """Solve a frame, and once more from the cage if the result is unsound.

    A result is unsound if patches of it follow the subdivided cage, if cloth crosses cloth, or a body over `MORE` times
    as often as the upsampled cage does, or if its energy is above the upsampled cage's energy without self contact (the
    self contact energy is as large as the cage's own crossings are deep). The second result is used if no patch of it
    follows the subdivided cage, or if it has fewer crossings of cloth with cloth. If it has as many: if the first alone
    crosses bodies too often (a few crossings less are no reason to change the folds); or if neither does, the first
    energy is above the cage's, and the second is lower. The second solve ends at a coarse level with as many crossings
    of cloth as the first result: finer levels have more.

    Returns:
        As `solve_frame`.

    Raises:
        SolveError: As `solve_frame`.
        RunawayError: Both results have more energy than the upsampled cage, self contact included.
    """
    state, telemetry = solve_frame(problem)
    reason, group, last = _unsound(telemetry), problem.group, problem.last
    settings = group.settings
    ended_early = is_over() or settings.budget_ms is not None or settings.steps == 0 or not settings.is_reusable
    if not reason or (last is None and problem.prerolled is None) or ended_early:
        return state, telemetry
    if last is not None and last.wait:
        return replace(state, failures=last.failures, wait=last.wait - 1), telemetry
    given_up = None if last is None else last.given_up
    from_cage = begin(group, problem.frames, at=problem.at, touching=problem.touching, given_up=given_up)
    failures = 1 if last is None else last.failures + 1
    waiting = replace(state, failures=failures, wait=min(2**failures - 1, MOST_WAIT))
    crossings = 0 if "follows_cage" in telemetry else _crossings(telemetry, given_up=True)
    try:
        fresh, other = solve_frame(from_cage, fewer_than=crossings or math.inf)
    except WorseStartError:
        return waiting, telemetry
    if _is_better(other, telemetry):
        return fresh, other | {"start": f"cold: started anew, since {reason}"}
    if all(_excess(result, self_contact=True) > 0.0 for result in (telemetry, other)):
        raise RunawayError(f"{reason}, and a start from the cage ends no better")
    return waiting, telemetry


def _unsound(telemetry: Mapping[str, Any]) -> str:
    """Why a result is unsound; "" if sound, or if nothing was solved."""
    if telemetry["start"] == GIVEN_UP:
        return ""
    if (worse := telemetry.get("follows_cage")) and not _given_up(telemetry):
        return f"it kept {worse['solved']:,} crossings, and the subdivided cage has {worse['subdivided']:,}"
    if crossings := _crossings(telemetry) + _through_bodies(telemetry):
        return f"it kept {crossings:,} crossings"
    excess = _excess(telemetry)
    return f"it ended with {excess:.3g} J more than its upsampled cage has" if excess > 0.0 else ""


def _is_better(fresh: Mapping[str, Any], solved: Mapping[str, Any]) -> bool:
    """Whether a second result replaces an unsound first one."""
    worse = "follows_cage" in fresh, "follows_cage" in solved
    if worse[0] != worse[1]:
        return worse[1]
    crossings = _crossings(fresh, given_up=True), _crossings(solved, given_up=True)
    if crossings[0] != crossings[1]:
        return crossings[0] < crossings[1]
    bodies = _through_bodies(fresh), _through_bodies(solved)
    if any(bodies):
        return not bodies[0]
    return _excess(solved) > 0.0 and _energy(fresh) < _energy(solved)


def _crossings(telemetry: Mapping[str, Any], *, given_up: bool = False) -> int:
    """Crossings of cloth with cloth in a result, with or without those of given-up cloth."""
    after = telemetry.get("contact", {}).get("cloth", {}).get("after", {})
    return int(after.get("crossings", 0) - (0 if given_up else _given_up(telemetry)))


def _given_up(telemetry: Mapping[str, Any]) -> int:
    """Crossings of given-up cloth in a result."""
    return int(telemetry.get("contact", {}).get("cloth", {}).get("after", {}).get("given_up", 0))


def _through_bodies(telemetry: Mapping[str, Any]) -> int:
    """Sum over bodies of the result's crossings beyond `MORE` times those of the upsampled cage."""
    bodies = telemetry.get("contact", {}).get("bodies", {}).values()
    return sum(max(body["after"]["crossings"] - MORE * body["before"]["crossings"], 0) for body in bodies)


def _excess(telemetry: Mapping[str, Any], *, self_contact: bool = False) -> float:
    """Energy of the result above its upsampled cage's, with or without self contact [J]; 0 if below or equal."""
    sides = telemetry["energy_joules"]
    before = {name: value for name, value in sides["input"].items() if self_contact or name != "self_contact"}
    size = sum(abs(value) for value in (*before.values(), *sides["output"].values()))
    return max(_energy(telemetry) - sum(before.values()) - EQUAL_ENERGY * size, 0.0)


def _energy(telemetry: Mapping[str, Any]) -> float:
    """Energy of the result [J]."""
    return sum(telemetry["energy_joules"]["output"].values())
