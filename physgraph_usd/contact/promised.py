"""The solve of one level by the promise: detect, step, move safely, detect again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from ..integrate.base import Carry, Integrator, System
from ..integrate.saddle import leave_saddle
from ..integrate.solve import Budget, LevelReport, solve_level
from ..level import Level
from .frame import LevelContact, Touch
from .metric import SMOOTH, HeldMetric

ROUNDS, STEPS = 10, 4
"""Most rounds of a level, and steps of each."""
UNTANGLINGS, WARM_UNTANGLINGS = 25, 4
"""Most rounds that draw out what crosses: from cold at the cage, and in a warm frame."""


def solve_promised(
    make_system: Callable[[Sequence[Touch], Tensor], System],
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    view: LevelContact,
    level: Level,
    outward: Float[Tensor, " garments"],
    smoothing: Float[Tensor, "vertices 3"] | None,
    budget: Budget,
) -> tuple[Float[Tensor, "vertices 3"], list[LevelReport], tuple[Touch, ...]]:
    """Solve one level from positions in which what is apart is on its side.

    Args:
        make_system: Makes the level's system with contact terms at positions.
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
    x = view.closed(x)
    most = UNTANGLINGS if level.index == 0 else WARM_UNTANGLINGS * (smoothing is None)
    reports: list[LevelReport] = []
    terms = view.terms(x)
    while view.tangled and len(reports) < most:
        short = replace(budget, steps=STEPS, tolerance=0.0, extra=0)
        y, report = solve_level(make_system(terms, x), integrator, x, level=level.index, budget=short)
        x = view.moved(x, y)
        reports.append(report)
        terms = view.terms(x)
    if smoothing is not None:
        x = view.moved(x, x + smoothing) if level.index else x
        x = view.moved(x, leave_saddle(make_system(terms, x), level, x, outward=outward))
    kept: list[Carry] = []
    going: Carry | None = None
    last: System | None = None
    made = 0
    for _ in range(ROUNDS):
        terms = view.terms(x)
        system = make_system(terms, x)
        shrunk = SMOOTH if isinstance(system.metric, HeldMetric) else 1.0
        y, report = solve_level(
            system,
            integrator,
            x,
            level=level.index,
            budget=replace(
                budget, steps=STEPS, extra=0, tolerance=shrunk * budget.tolerance, rest=budget.rest if not made else 1.0
            ),
            observe=lambda carry: kept.__setitem__(slice(None), [carry]),
            resume=going if last is not None and system.shares_metric(last) else None,
        )
        held = system.metric.held(kept[-1].force) if isinstance(system.metric, HeldMetric) else None
        report.remaining_move = report.remaining_move if held is None else system.remaining_move(held)
        reports.append(report)
        made += 1
        y = view.closed(y)
        x = view.moved(x, y)
        going = kept[-1] if x is y else None if kept[-1].setbacks else replace(kept[-1], x=x)
        last = system
        if report.stopped == "budget" or not report.steps or (report.stopped == "tolerance" and x is y):
            break
    return x, reports, terms
