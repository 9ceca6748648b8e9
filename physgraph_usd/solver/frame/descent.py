"""One frame's problem, and how one level of it is begun and solved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from jaxtyping import Float
from torch import Tensor

from ..contact.frame import FrameContact, LevelContact, Touch
from ..contact.solve import solve_touching
from ..forces.base import ForceModule
from ..forces.seam import SewnForces
from ..integrate.base import Integrator, System
from ..integrate.metric import Metric
from ..integrate.saddle import leave_saddle
from ..integrate.solve import Budget, LevelReport, solve_level
from ..level import Level, Placed, unhindered
from .level_forces import LevelForces
from .start import Start
from .values import Cage


@dataclass(frozen=True, eq=False)
class Problem:
    """One frame, ready to be solved; all positions are about the cages' mean.

    Attributes:
        began: When the frame began [s].
        cage: Where the cages are.
        aim: The cage that the fine cloth follows [m].
        forces: The lasting terms of each level, coarsest first.
        contact: What the cloth may touch, or None.
        start: Where the cloth starts.
        walked: Where the cages walked to from an earlier frame [m], for a cold start; or None.
        before: Where it was [m], float64; None where there is no last frame.
        clean: Whether nothing crossed there.
        tether: How stiffly it is tied to its start [1/s^2]; None where it is not.
        outward: As `leave_saddle` takes it.
        lasting: Whether what was recorded of a level's steps serves in the next frame too.
    """

    began: float
    cage: Cage
    aim: Float[Tensor, "coarse 3"]
    forces: Sequence[LevelForces]
    contact: FrameContact | None
    start: Start
    walked: Float[Tensor, "coarse 3"] | None
    before: Placed | None
    clean: bool
    tether: float | None
    outward: Float[Tensor, " garments"]
    lasting: bool

    @property
    def warm(self) -> bool:
        """Whether the cloth starts with the last frame's detail."""
        return self.start.detailed is not None

    @property
    def crossed(self) -> bool:
        """Whether the cage crosses itself."""
        return self.contact is not None and self.contact.crossed

    def view(self, level: Level) -> LevelContact | None:
        """What a level's cloth may touch."""
        return None if self.contact is None else self.contact.at(level)

    def begun(
        self, index: int, below: Float[Tensor, "below 3"], *, from_cage: bool
    ) -> tuple[Float[Tensor, "vertices 3"], Float[Tensor, "vertices 3"] | None]:
        """Where a level begins [m], and the move that takes a coarser mesh's facets out of it; None in a warm frame.

        Args:
            index: Number of the level.
            below: Positions of what is below it [m].
            from_cage: Whether that is the cage, not the next coarser level.
        """
        level = self.forces[index].level
        view, warm = self.view(level), self.start.detailed
        if warm is not None:
            return warm if view is None or self.before is None else view.moved(self.before, warm), None
        linear, smooth = level.from_below, level.smooth_from_below
        if from_cage or linear is None or smooth is None:
            linear, smooth = level.base, level.smooth_base
        x = linear.apply(below)
        smoothing = self.forces[index].without_facets(x, below, smooth)
        if view is not None and not from_cage and level.flat_from_below is not None and view.crosses(x):
            flat = level.flat_from_below.apply(below)
            x, smoothing = flat, x + smoothing - flat
        return x, smoothing

    def solved(
        self, index: int, x: Tensor, smoothing: Tensor | None, *, integrator: Integrator, budget: Budget
    ) -> tuple[Placed, list[LevelReport], ForceModule]:
        """Solve a level from where it is begun, in rounds where something is near; also gives its terms."""
        lasting, touched = self.forces[index], ()
        level, module = lasting.level, lasting.module(self.aim)
        view = self.view(level)
        tie = None if self.tether is None or self.start.detailed is None else (self.tether, self.start.detailed)
        alone = lasting.lasting_system(self.aim, tie) if self.lasting else lasting.system(module, tie)
        if view is not None:
            own = {"view": view, "level": level, "smoothing": smoothing, "outward": self.outward, "budget": budget}
            placed, reports, touched = solve_touching(partial(_system, lasting, alone, view), integrator, x, **own)
        else:
            x = x if smoothing is None else leave_saddle(alone, level, x + smoothing, outward=self.outward)
            x, report = solve_level(alone, integrator, x, level=index, budget=budget)
            placed, reports = unhindered(x), [report]
        if level is not self.forces[-1].level:
            reports[-1].energies = module.energies(placed)
        return placed, reports, ForceModule((*module.forces, *touched))


def _system(
    lasting: LevelForces, alone: System, view: LevelContact, touched: Sequence[Touch], at: Tensor, known: System | None
) -> System:
    """A level's system with what touches at given positions [m]; a known one tells of a metric that may serve on."""
    if not touched and view.seam is None:
        return alone
    assert isinstance(alone.field, ForceModule)
    assert isinstance(alone.metric, Metric)
    field = alone.field.joined_by(touched)
    field = field if view.seam is None else SewnForces(field, view.seam)
    held = view.metric(alone.metric, touched, at, known=None if known is None else known.metric)
    return lasting.system_in(field, held)
