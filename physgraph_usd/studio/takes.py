"""Solved frames that are kept: to be played, to go on from, and to compare with."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace

from ..solver.scene import Frame, GarmentResult, Result
from ..usd.read.reader import Shot
from .setting import Setting
from .solver import FrameSolver

MOST_BYTES = 1 << 30
"""Memory for the takes of all settings, without their solvers' levels and factors."""
MOST_SETTINGS = 4
"""Most settings with takes: the present one, A and steps of undo; each may have levels and factors of its own."""
KEPT_PER_POINT = 120
"""Bytes of a take per vertex: its position, and the solver's state."""
FRESH, STALE, MISSING = "fresh", "stale", "missing"


@dataclass(frozen=True, eq=False)
class Shown:
    """A solved frame.

    Attributes:
        frame: The input: cages, values and bodies.
        garments: The result of each garment, without points for one without a sample here.
        seconds: Wall time of reading and solving.
        settled: Whether the frame is solved as ``refine`` solves it.
    """

    frame: Frame
    garments: tuple[GarmentResult, ...]
    seconds: float
    settled: bool

    @staticmethod
    def of(frame: Frame, result: Result, *, began: float, settled: bool) -> Shown:
        """A frame and the solver's result; reading ``began`` at that `time.perf_counter` value."""
        return Shown(frame, result.garments, clock.perf_counter() - began, settled)


@dataclass(frozen=True, eq=False)
class Start:
    """The start of a frame's solve.

    Attributes:
        setting: The setting.
        shot: The shot, read with the setting.
        solver: The solver with the start positions; copied for each frame.
    """

    setting: Setting
    shot: Shot
    solver: FrameSolver

    def at(self, time: float | None, cancelled: Callable[[], bool] = lambda: False, *, cold: bool = False) -> Take:
        """A frame with this setting, solved from here, or from its cage.

        Raises:
            SolveError: A term of the potential is not finite.
            StageError: The frame cannot be read.
        """
        solver, began = copy(self.solver), clock.perf_counter()
        if cold:
            solver.feel(contact=self.setting.contact)
        result = solver.solve(self.shot, time, cancelled=cancelled)
        shown = Shown.of(self.shot.frame(time), result, began=began, settled=not cancelled())
        return Take(replace(self, solver=solver), shown)


@dataclass(frozen=True, eq=False)
class Take:
    """A solved frame, and the solver's state after it."""

    start: Start
    shown: Shown

    @property
    def setting(self) -> Setting:
        """The setting that it was solved with."""
        return self.start.setting


class Takes:
    """Takes of a shot, solved in order, of the settings solved last, by setting and time code."""

    def __init__(self) -> None:
        """Hold no take."""
        self._kept: dict[Setting, dict[float | None, Take]] = {}

    def fresh(self, time: float | None, setting: Setting) -> Take | None:
        """The take of a frame with a setting, or None."""
        return self._kept.get(setting, {}).get(time)

    def keep_last(self, take: Take) -> None:
        """Keep a take and drop all others of the same setting."""
        self._kept.pop(take.setting, None)
        self._kept[take.setting] = {take.shown.frame.time: take}
        self._drop_settings()

    def states(self, times: Sequence[float], setting: Setting) -> list[str]:
        """For each frame: `FRESH`, `STALE` (solved with another setting only) or `MISSING`."""
        fresh, solved = self._kept.get(setting, {}), {time for takes in self._kept.values() for time in takes}
        return [FRESH if time in fresh else STALE if time in solved else MISSING for time in times]

    def solve_next(self, times: Sequence[float], start: Start, cancelled: Callable[[], bool]) -> float | None:
        """Solve a range's first missing or stale frame, from the frame before.

        Args:
            times: The range, in order; its first frame is solved as a run's.
            start: The setting, and a solver at its levels.
            cancelled: Asked before each step: whether to stop there; such a frame is not kept.

        Returns:
            The frame's time code, also if cancelled; None without such a frame among those that memory holds.
        """
        setting, room = start.setting, self._room(start.solver)
        lacking = next((k for k in range(min(len(times), room)) if not self.fresh(times[k], setting)), None)
        if lacking is None:
            return None
        time, before = times[lacking], self.fresh(times[lacking - 1], setting) if lacking else None
        take = (start if before is None else before.start).at(time, cancelled, cold=before is None)
        if take.shown.settled:
            takes = self._kept.pop(setting, {})
            self._kept[setting] = takes  # The last of the settings now.
            takes.pop(time, None)
            takes[time] = take
            for old in list(takes)[:-room]:
                del takes[old]
            self._drop_settings()
        return time

    def _drop_settings(self) -> None:
        for other in list(self._kept)[:-MOST_SETTINGS]:
            del self._kept[other]

    @staticmethod
    def _room(solver: FrameSolver) -> int:
        """Most takes of one setting."""
        count = sum(chain[-1].mesh.vertex_count for chain in solver.refinements if chain)
        return max(1, MOST_BYTES // (MOST_SETTINGS * KEPT_PER_POINT * max(count, 1)))
