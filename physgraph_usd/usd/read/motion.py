"""The acceleration of a garment's cage, from its samples around a time code."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence

import numpy as np

from ...errors import GarmentError
from ...solver.inertia import acceleration_of, felt
from ..times import SAME_TIME

FRAMES = 2
"""Frames from a time code to the samples before and after."""
_KEPT = 2 * FRAMES + 2
"""Number of samples kept: a shot that is read in order reads each sample once."""


class CageMotion:
    """Acceleration of one cage at its time codes.

    It comes from the nearest samples at least two frames before and after, in which what alternates from frame to
    frame cancels out. At the shot's ends it is that of the nearest time code with samples on both sides.
    """

    def __init__(
        self, times: Sequence[float], read: Callable[[float], np.ndarray], *, frame: float, seconds: float
    ) -> None:
        """Take the time codes of the garment's samples, also those that are not solved.

        Args:
            times: Time codes with a shape, in any order.
            read: Gives the cage's positions in world space at a time code [m], shape (V, 3).
            frame: Length of a frame in time codes.
            seconds: Length of a time code [s].
        """
        self._times, self._read = sorted(times), read
        self._least, self._seconds = FRAMES * frame - SAME_TIME, seconds
        self._known: dict[float, np.ndarray] = {}

    def felt(self, time: float | None, points: np.ndarray) -> np.ndarray | None:
        """Acceleration that the cloth feels at a time code [m/s^2], shape (V, 3); None where it feels none.

        Args:
            points: The cage's positions at that time code [m].
        """
        if time is None or not self._times:
            return None
        self._keep(time, points)
        inner = self._times[0] + self._least, self._times[-1] - self._least
        if inner[0] > inner[1]:
            return None
        middle = self._times[bisect_left(self._times, inner[0])] if time < inner[0] else time
        middle = self._times[bisect_right(self._times, inner[1]) - 1] if time > inner[1] else middle
        before = bisect_right(self._times, middle - self._least) - 1
        after = bisect_left(self._times, middle + self._least)
        if before < 0 or after == len(self._times):
            return None
        three = self._times[before], middle, self._times[after]
        try:
            poses = [self._at(each) for each in three]
        except GarmentError:  # A broken sample beside this one has its own error, at its own time code.
            return None
        return felt(acceleration_of(poses, [each * self._seconds for each in three]))

    def _at(self, time: float) -> np.ndarray:
        return self._known[time] if time in self._known else self._keep(time, self._read(time))

    def _keep(self, time: float, points: np.ndarray) -> np.ndarray:
        self._known.pop(time, None)
        self._known[time] = points
        while len(self._known) > _KEPT:
            del self._known[next(iter(self._known))]
        return points
