"""Forecasts the end of a run from the frames done so far."""

from __future__ import annotations

import time as clock
from statistics import mean

TIMED_FRAMES, LONG_RUN = 3, 60.0
"""Frames before the first forecast, and least remaining time of a forecast [s]."""
RECENT = 1 / 3
"""Part of the frames done, the latest, whose mean duration stands for the frames left."""
REVISED = 1.5
"""Factor by which a forecast of the whole run changes before it is given again."""


class Forecast:
    """Forecast of a run's end, revised as frames become slower or faster.

    The first frame starts from the cage and takes longer than the others, so it is left out of the means.
    """

    def __init__(self, count: int, workers: int) -> None:
        """Start at the begin of the frames.

        Args:
            count: Frames of the run.
            workers: Processes sharing the frames; the first frames to arrive are the first process's.
        """
        self._count, self._frames = count, -(-count // workers)
        self._ends = [0.0]
        self._given = 0.0

    def after(self, seconds: float) -> str:
        """The forecast after another frame, as text; "" if soon over, or not much changed since the last one.

        Args:
            seconds: Time since the begin of the frames [s].
        """
        self._ends.append(seconds)
        done = len(self._ends) - 1
        frames_left = self._frames - done
        if done < TIMED_FRAMES or frames_left <= 0:
            return ""
        recent = max(round(RECENT * (done - 1)), TIMED_FRAMES - 1)
        remaining = frames_left * mean(
            b - a for a, b in zip(self._ends[-recent - 1 :], self._ends[-recent:], strict=False)
        )
        total = seconds + remaining
        is_new = not 1 / REVISED < total / max(self._given, 1e-9) < REVISED
        if not is_new or (remaining < LONG_RUN and not self._given):
            return ""
        self._given = total
        at = clock.strftime("%H:%M", clock.localtime(clock.time() + remaining))
        minutes = f"{remaining / 60.0:.0f} min" if remaining < 5400.0 else f"{remaining / 3600.0:.1f} h"
        return f"{done} of {self._count} frames in {seconds:.0f} s: all in about {minutes} more, at {at}"
