"""The solve of one level that touches something: rounds of steps, each with the planes and pairs that its start sees.

Within a round the potential is a function of the positions alone. What the integrator learned of the curvature is kept
from round to round: only few planes turn, and a line search guards each step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..forces.self_contact import SelfContact
from ..integrate.base import Carry, Integrator, System
from ..integrate.metric import Metric
from ..integrate.saddle import leave_saddle
from ..integrate.solve import Budget, LevelReport, solve_level
from ..level import Level
from .frame import LevelContact, Touch
from .metric import SMOOTH, HeldMetric

UNTANGLINGS = 25
"""Most rounds that draw out what crosses from cold, at the cage."""
WARM_UNTANGLINGS = 4
"""The same in a frame that starts from the last one's detail, at the finest level."""
STEPS = 4
"""Steps of each of them."""
UNSETTLED = 0.2
"""Remaining move, in edge lengths, above which the cloth away from what touches is solved once more by itself: cloth
pinched between bodies cannot settle and holds up the steps of all the rest."""
STAYING = 100.0
"""Stiffness, over that at rest, of the springs that hold what touches then."""
LAST_UNTANGLINGS, LAST_TRIES = 4, 3
"""Rounds that draw out what still crosses at the end, and how often while they help."""
LONGEST = 16
"""Most steps of a round: in more of them cloth passes through what it had not seen, and taken back it is strained."""
RELAXATIONS, WARM_RELAXATIONS, RELAXING = 8, 4, 8
"""Rounds after the last mending, from cold and in a warm frame, and most steps of each, half of those that there are:
mended cloth is where no force would put it."""
WARM_ROUNDS = 2
"""Rounds of a warm frame that is neither crowded nor held, at most: it starts near where it ends."""
CROWDED, PILED = 2.5e-3, 3.5e-3
"""Part of the vertices that cloth must push for a level to get a budget's steps a round: a few are left to mending. And
the part at its end beyond which it is relaxed all the same."""


def crowded(terms: Sequence[Touch], x: Float[Tensor, "vertices 3"], most: float = CROWDED) -> bool:
    """Whether cloth pushes more than a part of the cloth at x [m], so that it takes steps to settle."""
    pushed = [term.diagonal(x) > 0 for term in terms if isinstance(term, SelfContact)]
    return bool(pushed) and float(torch.stack(pushed).any(dim=0).to(x).mean()) > most


def solve_touching(
    make_system: Callable[[Sequence[Touch], Tensor], System],
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    view: LevelContact,
    level: Level,
    finest: bool,
    outward: Float[Tensor, " garments"],
    smoothing: Float[Tensor, "vertices 3"] | None,
    still: bool = False,
    budget: Budget,
) -> tuple[Float[Tensor, "vertices 3"], list[LevelReport], tuple[Touch, ...]]:
    """Solve one level: mend and draw out what crosses, leave the saddle, then rounds, and what follows them.

    Results are those of `solve_rounds`.

    Args:
        make_system: Makes the level's system with contact terms at positions.
        integrator: Any integrator.
        x: Start positions [m].
        view: The level's view of what it may touch.
        level: The level.
        finest: Whether it is the last.
        outward: As `leave_saddle` takes it.
        smoothing: The move that takes a coarser mesh's facets out [m], itself taken back where it makes cloth cross;
            None in a warm frame.
        still: Whether the pose is held in a warm frame.
        budget: When to stop.
    """
    most = UNTANGLINGS if level.index == 0 else WARM_UNTANGLINGS * (smoothing is None)
    x = view.closed(x)
    if view.cloth is not None and level.index and (smoothing is not None or not view.cloth.before.crossings.count):
        # What a coarser level or the last frame made cross; where a warm frame's input crosses too, it is drawn out.
        x = view.cloth.mend(x).x
    # From cold, where folds form, pairs in them would take more steps than there are.
    view.look_in_folds(finest and smoothing is None)
    x, made, touched = untangle(make_system, integrator, x, view=view, level=level.index, budget=budget, most=most)
    start = x
    if smoothing is not None:
        x = view.uncrossed(view.closed(x + smoothing), x) if level.index else x
        x = view.closed(leave_saddle(make_system(touched, x), level, x, outward=outward))
    # Much cloth on cloth settles slowly, and in a held pose one sees it settle.
    much = finest and crowded(touched, x)
    whole = much or (finest and still and smoothing is None)
    x = view.uncrossed(x, start) if whole else x
    x, more, touched = solve_rounds(
        make_system,
        integrator,
        x,
        terms=touched,
        view=view,
        level=level.index,
        budget=budget,
        rounds=view.rounds if whole or smoothing is not None else min(WARM_ROUNDS, view.rounds),
        whole=whole,
    )
    made = made + more
    if finest:
        # From cold the rounds did not see sharp folds, which the next frame will.
        relaxing = (much or crowded(touched, x, PILED)) and (smoothing is not None or view.mended or view.crosses(x))
        given = {"view": view, "level": level, "last": made[-1], "budget": budget}
        x, more = finish_rounds(make_system, integrator, x, terms=touched, **given)
        made += more
        if relaxing:
            most = RELAXATIONS if smoothing is not None else WARM_RELAXATIONS
            x, more = relax(make_system, integrator, x, view=view, level=level.index, budget=budget, most=most)
            made += more
    return x, made, touched


def untangle(
    make_system: Callable[[Sequence[Touch], Tensor], System],
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    view: LevelContact,
    level: int,
    budget: Budget,
    most: int,
) -> tuple[Float[Tensor, "vertices 3"], list[LevelReport], tuple[Touch, ...]]:
    """Draw out what crosses, in at most so many rounds of few steps; nothing where nothing does.

    Arguments and results are those of `solve_rounds`; the last result is the contact terms at the positions returned.
    """
    reports: list[LevelReport] = []
    terms = view.terms(x)
    while view.tangled and len(reports) < most and (not reports or reports[-1].stopped != "budget"):
        short = replace(budget, steps=STEPS, tolerance=0.0)
        x, report = solve_level(make_system(terms, x), integrator, x, level=level, budget=short)
        x = view.closed(x)
        reports.append(report)
        terms = view.terms(x)
    return x, reports, terms


def untangle_last(
    make_system: Callable[[Sequence[Touch], Tensor], System],
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    view: LevelContact,
    level: int,
    budget: Budget,
) -> tuple[Float[Tensor, "vertices 3"], list[LevelReport]]:
    """Mend a level's result and draw out what still crosses, in turn, while fewer do; x itself where nothing crosses.

    Arguments and results are those of `untangle`.
    """
    reports: list[LevelReport] = []
    if view.cloth is None or not view.cloth.look(x).crossings.count:
        return x, reports
    best = view.cloth.mend(x)
    most = view.cloth.most_strain(best.x) if best.crossings.count else 0.0
    for _ in range(LAST_TRIES):
        if not best.crossings.count:
            break
        out, made, _ = untangle(
            make_system, integrator, best.x, view=view, level=level, budget=budget, most=LAST_UNTANGLINGS
        )
        reports += made
        state = view.cloth.mend(out)
        if state.crossings.count >= best.crossings.count or view.cloth.is_taut(state.x, most):
            break
        best = state
    return best.x, reports


def solve_rounds(
    make_system: Callable[[Sequence[Touch], Tensor], System],
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    terms: tuple[Touch, ...],
    view: LevelContact,
    level: int,
    budget: Budget,
    rounds: int,
    whole: bool = False,
) -> tuple[Float[Tensor, "vertices 3"], list[LevelReport], tuple[Touch, ...]]:
    """Solve one level in rounds; in one where nothing can touch.

    Args:
        make_system: Makes the level's system with contact terms at positions.
        integrator: Any integrator.
        x: Start positions [m].
        terms: The contact terms that ``view`` gave for x.
        view: The level's view of what it may touch.
        level: Index for the reports.
        budget: When to stop; its steps are shared by the rounds. What first touches at the end gets a round's more,
            and what is far from rest then as many rounds as its extra steps make.
        rounds: How many there are; of fewer than the view's all but the first keep its pairs.
        whole: Whether each round gets all of the steps instead. In so many cloth gets far: what then crosses is taken
            back towards the round's start, so that the next one finds everything on its side.

    Returns:
        Final positions [m], a report a round, and the last round's contact terms.

    Raises:
        SolveError: The energy is not finite.
    """
    reports: list[LevelReport] = []
    share, last = budget.steps if whole else -(-budget.steps // rounds), None
    left = max(budget.steps, share * rounds) if terms else budget.steps
    share = min(share, LONGEST)
    extra = budget.extra if terms else 0
    kept: list[Carry] = []
    going: Carry | None = None
    while True:
        system, start, steps = make_system(terms, x), x, min(left, share) if terms else left
        x, report = solve_level(
            system,
            integrator,
            start,
            level=level,
            budget=_round_of(budget, system, steps, first=not reports, touches=bool(terms)),
            observe=lambda carry: kept.__setitem__(slice(None), [carry]),
            resume=going if last is not None and system.shares_metric(last) else None,
        )
        held = system.metric.held(kept[-1].force) if isinstance(system.metric, HeldMetric) else None
        report.remaining_move = report.remaining_move if held is None else system.remaining_move(held)
        last, x, going = system, view.closed(x), kept[-1]
        if whole:
            x, going = _uncrossed(view, x, start=start, carry=going)
        reports.append(report)
        left -= report.steps
        if left <= 0 < extra and report.steps and budget.is_far(report.remaining_move):
            left, extra = share, extra - share
        if report.stopped == "budget" or (left <= 0 and terms):
            return x, reports, terms
        before, terms = terms, view.terms(x, keep_pairs=rounds < view.rounds)
        if not before and not terms:
            return x, reports, ()
        if left <= 0:
            left = share
        elif report.steps == 0:
            return x, reports, terms


def _uncrossed(view: LevelContact, x: Tensor, *, start: Tensor, carry: Carry) -> tuple[Tensor, Carry | None]:
    """Cloth that a round made cross taken back [m], and what its integrator goes on from.

    From there one that had to be corrected starts anew (None); others keep what they learned.
    """
    out = view.uncrossed(x, start)
    if out is x:
        return x, carry
    return out, None if carry.setbacks else replace(carry, x=out)


def _round_of(budget: Budget, system: System, steps: int, *, first: bool, touches: bool) -> Budget:
    """The budget of a round: what a held metric calls a small move is that much smaller; extra steps are rounds."""
    shrunk = SMOOTH if isinstance(system.metric, HeldMetric) else 1.0
    rest, extra = budget.rest if first else 1.0, 0 if touches else budget.extra
    return replace(budget, steps=steps, tolerance=shrunk * budget.tolerance, rest=rest, extra=extra)


def finish_rounds(
    make_system: Callable[[Sequence[Touch], Tensor], System],
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    terms: tuple[Touch, ...],
    view: LevelContact,
    level: Level,
    last: LevelReport,
    budget: Budget,
) -> tuple[Float[Tensor, "vertices 3"], list[LevelReport]]:
    """What follows a finest level's rounds: the cloth away from what touches settles, and what crosses is drawn out.

    Arguments and results are those of `solve_rounds`, but for the level itself; ``last`` is its last report.
    """
    made: list[LevelReport] = []
    if terms and last.remaining_move > UNSETTLED:
        x, made = _solve_apart(make_system((), x), integrator, x, terms=terms, level=level, budget=budget)
        x = view.closed(x)
    x, more = untangle_last(make_system, integrator, x, view=view, level=level.index, budget=budget)
    return x, made + more


def relax(
    make_system: Callable[[Sequence[Touch], Tensor], System],
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    view: LevelContact,
    level: int,
    budget: Budget,
    most: int,
) -> tuple[Float[Tensor, "vertices 3"], list[LevelReport]]:
    """Rounds of fewer steps after mending, after none of which anything crosses; none where the input or x does.

    Arguments and results are those of `untangle`; it makes ``most`` rounds, unless time is out.
    """
    reports: list[LevelReport] = []
    if view.cloth is None or view.cloth.before.crossings.count or view.crosses(x):
        return x, reports
    view.look_in_folds(True)
    short = replace(budget, steps=min(-(-budget.steps // 2), RELAXING), tolerance=0.0)
    while len(reports) < most and (not reports or reports[-1].stopped != "budget"):
        out, report = solve_level(make_system(view.terms(x), x), integrator, x, level=level, budget=short)
        x = view.uncrossed(view.closed(out), x)
        reports.append(report)
    return x, reports


def _solve_apart(
    plain: System, integrator: Integrator, x: Tensor, *, terms: tuple[Touch, ...], level: Level, budget: Budget
) -> tuple[Tensor, list[LevelReport]]:
    """Solve the cloth away from what touches, without it, where it has not settled; what touches stays."""
    held = torch.stack([term.near(level) for term in terms]).any(dim=0)
    metric = plain.metric
    if isinstance(metric, Metric):  # Else a piece would be moved as if nothing held it at its rim, and all steps fail.
        metric = metric.plus(STAYING * metric.diagonal * held.squeeze(1))
    apart = System(plain.field, metric, free=plain.free & ~held, spacing=plain.spacing, level=level)
    force = apart.energy_and_force(x)[1]
    if apart.remaining_move(apart.apply_metric_inverse(force)) <= UNSETTLED:
        return x, []
    x, report = solve_level(apart, integrator, x, level=level.index, budget=budget)
    return x, [report]
