"""One frame solved again and again: soon, from where the cloth was, or as ``refine`` solves it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

from ..shot.options import RefineOptions
from ..shot.processes import cores
from ..shot.solve import sampled_at
from ..solver.frame.lead_in import cages_walked
from ..solver.frame.refiner import Refiner
from ..solver.frame.settings import SolveSettings
from ..solver.scene import State
from ..usd.read.reader import Shot

BUDGET_MS = 1000.0
"""Milliseconds after which a quick solve begins no step but its first: with contact a large change asks for more."""
FINER = 0.1
"""Tolerance of a quick solve, over a run's: within that, cloth would not answer to a slider that is moved a little."""


class FrameSolver:
    """Solves frames of a shot at fixed levels.

    While values move, the finest level is solved from the cloth's present shape: quick, but the result depends on the
    path there. At rest a frame is solved as ``refine`` does: cold, or from the frame before it where that was.

    Attributes:
        run: Time codes that have been solved in a row as ``refine`` does, up to now; empty after a quick solve.
        refinements: The subdivisions of each garment, coarsest first.
    """

    def __init__(self, shot: Shot, levels: Sequence[int], *, contact: bool, device: str = "cpu") -> None:
        """Subdivide each garment so often; ``contact`` lets cloth feel bodies and cloth.

        Raises:
            GarmentError: A rest shape cannot be solved on.
        """
        self._times = shot.scene.times
        self._settings = _settings(contact=contact)
        self._threads = cores()
        self._exact = Refiner(shot.scene, self._settings, levels=levels, device=device, threads=self._threads)
        self._quick: tuple[Refiner, float | None] | None = None  # And the time code where it is.
        self.refinements = self._exact.refinements
        self.run: tuple[float | None, ...] = ()

    def feel(self, *, contact: bool) -> None:
        """Let cloth feel bodies and cloth, or nothing, from here on; the next frame starts cold."""
        self._settings = _settings(contact=contact)
        self._quick, self.run = None, ()

    def solve_soon(self, shot: Shot, time: float | None) -> State:
        """Solve from where the cloth was, in this frame or the one before; else as `solve_as_refine` does.

        Raises:
            SolveError: A term of the potential is not finite.
            StageError: The frame cannot be read.
        """
        walks = self.run and self._follows(self.run[-1], time)
        if walks or self._quick is None or not (time == self._quick[1] or self._follows(self._quick[1], time)):
            return self.solve_as_refine(shot, time)
        quick, self.run = self._quick[0], ()
        state = quick.solve(shot.frame(time), sampled_at(shot, time))
        self._quick = quick, time
        return state

    def solve_as_refine(
        self, shot: Shot, time: float | None, *, cancelled: Callable[[], bool] = lambda: False
    ) -> State:
        """Solve as a run of ``refine`` does that begins here, or where the run that has come to the frame before began.

        Args:
            shot: The shot, read with the values that are tried, here as in `solve_soon`.
            time: Time code.
            cancelled: Asked before each step: whether nobody waits for the result any more. It is no solution then,
                and the next quick solve starts from where the cloth was before.

        Raises:
            SolveError: A term of the potential is not finite.
            StageError: The frame cannot be read.
        """
        settings = replace(self._settings, cancelled=cancelled)
        walked = self.run if self.run and self._follows(self.run[-1], time) else ()
        self.run = ()
        if walked:
            self._exact = self._exact.fork(settings)
        else:
            self._exact.use(settings)
            self._lead_in(shot, time)
        state = self._exact.solve(shot.frame(time), sampled_at(shot, time))
        if not cancelled():
            finer = FINER * self._settings.tolerance
            soon = replace(self._settings, temporal="warm", budget_ms=BUDGET_MS, tolerance=finer)
            self._quick, self.run = (self._exact.fork(soon), time), (*walked, time)
        return state

    def _lead_in(self, shot: Shot, time: float | None) -> None:
        """Begin in the middle of a shot, where its cage crosses, with the cage walked there, as a run does."""
        earlier = [] if time is None else shot.times_until(time)
        found = cages_walked(shot.scene, self._settings, shot.frame, times=earlier, threads=self._threads)
        if found is not None:
            self._exact.begin_at(found[0], since=found[1])

    def _follows(self, before: float | None, time: float | None) -> bool:
        """Whether a time code is the shot's next after another."""
        return before is not None and time is not None and (before, time) in set(pairwise(self._times))


def _settings(*, contact: bool) -> SolveSettings:
    """How ``refine`` solves by default, or with ``--contact off --self-contact off``."""
    options = RefineOptions() if contact else RefineOptions(contact="off", self_contact="off")
    return options.solve_settings()
