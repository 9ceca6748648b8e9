"""The solve of one level that touches bodies: rounds of steps, each with the planes that its start sees.

Within a round the potential is a function of the positions alone. What the integrator learned of the curvature is kept
from round to round: only few planes turn, and a line search guards each step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from ..forces.contact import Contact
from ..integrate.base import Carry, Integrator, System
from ..integrate.solve import Budget, LevelReport, solve_level
from .bodies import LevelContact


def solve_rounds(
    make_system: Callable[[Contact | None], System],
    integrator: Integrator,
    x: Float[Tensor, "vertices 3"],
    *,
    touched: Contact | None,
    view: LevelContact,
    level: int,
    budget: Budget,
) -> tuple[Float[Tensor, "vertices 3"], list[LevelReport], Contact | None]:
    """Solve one level in rounds; in one where nothing can touch.

    Args:
        make_system: Makes the level's system with a contact term or without.
        integrator: Any integrator.
        x: Start positions [m].
        touched: The contact term that ``view`` gave for x.
        view: The level's view of the bodies.
        level: Index for the reports.
        budget: When to stop; its steps are shared by the rounds.

    Returns:
        Final positions [m], a report a round, and the last round's contact term.

    Raises:
        SolveError: The energy is not finite.
    """
    reports: list[LevelReport] = []
    left, resume = budget.steps, None
    kept: list[Carry] = []
    while True:
        share = left if touched is None else min(left, -(-budget.steps // view.rounds))
        kept.clear()
        x, report = solve_level(
            make_system(touched),
            integrator,
            x,
            level=level,
            budget=replace(budget, steps=share),
            observe=lambda carry: kept.__setitem__(slice(None), [carry]),
            resume=resume,
        )
        resume = kept[-1]
        reports.append(report)
        left -= report.steps
        if left <= 0 or report.steps == 0 or report.stopped == "budget":
            return x, reports, touched
        last, touched = touched, view.term(x)
        if last is None and touched is None:
            return x, reports, None
