"""One frame solved again and again, from where the cloth was: roughly while values move, then as ``refine`` solves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..shot.options import RefineOptions
from ..shot.solve import sampled_at
from ..shot.workers import cores
from ..solver.frame.lead_in import prerolled_cages
from ..solver.frame.refiner import Refiner
from ..solver.frame.settings import SolveSettings
from ..solver.scene import Frame, Result
from ..usd.read.reader import Shot

Seen = Callable[[Mapping[str, np.ndarray]], None]
"""Called with positions of some garments before they are settled [m], world space, by path."""


class FrameSolver:
    """Solves frames of a shot at fixed levels, each from where the cloth was last.

    Attributes:
        refiner: What solves; forked for each frame.
        refinements: The subdivisions of each garment, coarsest first.
    """

    def __init__(self, shot: Shot, levels: Sequence[int], *, contact: bool, device: str = "cpu") -> None:
        """Subdivide each garment so often; ``contact`` lets cloth feel bodies and cloth.

        Raises:
            GarmentError: A rest shape cannot be solved on.
        """
        self._times, self._settings = shot.scene.times, _settings(contact=contact)
        self.refiner = Refiner(shot.scene, self._settings, levels=levels, device=device, threads=cores())
        self._at: tuple[float | None, ...] = ()  # The time code solved last; none before the first.
        self.refinements = self.refiner.refinements

    @property
    def begun(self) -> bool:
        """Whether a frame was solved since the solver was made, or last told whether cloth feels contact."""
        return bool(self._at)

    def continue_from(self, other: FrameSolver) -> None:
        """Start the next frame from another solver's last result, if at equal levels."""
        counts = [[len(chain) for chain in each.refinements] for each in (self, other)]
        if other.begun and counts[0] == counts[1]:
            self.refiner.continue_from(other.refiner)
            self._at = other._at

    def feel(self, *, contact: bool) -> None:
        """Let cloth feel bodies and cloth, or nothing, from here on; the next frame starts cold."""
        self._settings, self._at = _settings(contact=contact), ()

    def solve(
        self,
        shot: Shot,
        time: float | None,
        *,
        rough: bool = False,
        seen: Seen = lambda _: None,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> Result:
        """Solve a frame from the last result, which may be rough or cancelled.

        Args:
            shot: The shot, read with the values that are tried.
            time: Time code.
            rough: As in `SolveSettings`.
            seen: Called after each round, and with the cages' smooth surface before a cold frame.
            cancelled: Asked before each step: whether to stop there.

        Raises:
            SolveError: A term of the potential is not finite.
            StageError: The frame cannot be read.
        """
        frame = shot.frame(time)
        follows = bool(self._at) and (self._at[0], time) in set(pairwise(self._times))
        temporal = self._settings.temporal if follows else "warm"  # No time passes for the tether to slow cloth down.
        settings = replace(self._settings, rough=rough, show_round=seen, cancelled=cancelled, temporal=temporal)
        if self._at:
            self.refiner = self.refiner.fork(settings)
        else:
            self.refiner.use(settings)
            self._lead_in(shot, time)
            seen(self.smooth(frame))
        result = self.refiner.solve(frame, sampled_at(shot, time))
        self._at = (time,)
        return result

    def smooth(self, frame: Frame) -> dict[str, np.ndarray]:
        """The smooth surface of each cage [m], by path."""
        found = dict[str, np.ndarray]()
        for part in self.refiner.parts_of(frame):
            group = self.refiner.group_of(part)
            points = group.upsampled([frame.garments[index] for index in part])
            found |= zip((garment.path for garment in group.garments), points, strict=True)
        return found

    def _lead_in(self, shot: Shot, time: float | None) -> None:
        """Begin in the middle of a shot with the cage advanced from an earlier frame, if the cage crosses."""
        earlier = [] if time is None else shot.times_until(time)
        found = prerolled_cages(shot.scene, self._settings, shot.frame, times=earlier, threads=cores())
        if found is not None:
            self.refiner.start_from_cages(found[0], time_code=found[1])


def _settings(*, contact: bool) -> SolveSettings:
    """How ``refine`` solves by default, or with ``--contact off --self-contact off``."""
    options = RefineOptions() if contact else RefineOptions(contact="off", self_contact="off")
    return options.solve_settings()
