"""The solve of one level that touches something: rounds of steps, each with the planes and pairs that its start sees.

Within a round the potential is a function of the positions alone. What the integrator learned of the curvature is kept
from round to round: only few planes turn, and a line search guards each step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from ..integrate.base import Carry, Integrator, System
from ..integrate.solve import Budget, LevelReport, solve_level
from .frame import LevelContact, Touch
from .metric import HeldMetric

UNTANGLINGS = 25
"""Most rounds that draw out what crosses from cold, at the cage."""
WARM_UNTANGLINGS = 4
"""The same in a frame that starts from the last one's detail, at the finest level."""
STEPS = 4
"""Steps of each of them."""
UNSETTLED = 0.2
"""Remaining move, in edge lengths, above which the cloth away from what touches is solved once more by itself: cloth
pinched between bodies cannot settle and holds up the steps of all the rest."""


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
        reports.append(report)
        terms = view.terms(x)
    return x, reports, terms


def solve_rounds(
    make_system: Callable[[Sequence[Touch], Tensor], System],
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    terms: tuple[Touch, ...],
    view: LevelContact,
    level: int,
    budget: Budget,
    share: int | None = None,
) -> tuple[Float[Tensor, "vertices 3"], list[LevelReport], tuple[Touch, ...]]:
    """Solve one level in rounds; in one where nothing can touch.

    Args:
        make_system: Makes the level's system with contact terms at positions.
        integrator: Any integrator.
        x: Start positions [m].
        terms: The contact terms that ``view`` gave for x.
        view: The level's view of what it may touch.
        level: Index for the reports.
        budget: When to stop; its steps are shared by the rounds. What first touches at the end gets a round's more.
        share: Steps of each round instead of its share.

    Returns:
        Final positions [m], a report a round, and the last round's contact terms.

    Raises:
        SolveError: The energy is not finite.
    """
    reports: list[LevelReport] = []
    share, last = share or -(-budget.steps // view.rounds), None
    left = max(budget.steps, share * view.rounds) if terms else budget.steps
    kept: list[Carry] = []
    while True:
        system = make_system(terms, x)
        x, report = solve_level(
            system,
            integrator,
            x,
            level=level,
            budget=replace(budget, steps=min(left, share) if terms else left),
            observe=lambda carry: kept.__setitem__(slice(None), [carry]),
            resume=kept[-1] if last is not None and system.shares_metric(last) else None,
        )
        if isinstance(system.metric, HeldMetric):
            report.remaining_move = system.remaining_move(system.metric.smooth(kept[-1].force))
        last = system
        reports.append(report)
        left -= report.steps
        if report.stopped == "budget" or (left <= 0 and terms):
            return x, reports, terms
        before, terms = terms, view.terms(x)
        if not before and not terms:
            return x, reports, ()
        if left <= 0:
            left = share
        elif report.steps == 0:
            return x, reports, terms


def solve_apart(
    apart: System, integrator: Integrator, x: Float[Tensor, "vertices 3"], *, level: int, budget: Budget
) -> tuple[Float[Tensor, "vertices 3"], list[LevelReport]]:
    """Solve the cloth away from what touches, where it has not settled; what touches stays.

    Args:
        apart: The level's system without contact, in which what is near something may not move.
        integrator: Any integrator.
        x: Start positions [m].
        level: Index for the report.
        budget: When to stop.

    Returns:
        Final positions [m], x itself where the rest has settled, and the report if there is one.
    """
    force = apart.energy_and_force(x)[1]

    if apart.remaining_move(apart.apply_metric_inverse(force)) <= UNSETTLED:
        return x, []
    x, report = solve_level(apart, integrator, x, level=level, budget=budget)
    return x, [report]
