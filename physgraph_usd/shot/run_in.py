"""Solves poses and cages before the first frame of a run, and reports the time spent and left."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from statistics import mean

import numpy as np

from ..errors import NOTICE, SolveError, StageError, counted, named_time
from ..interrupts import leave_if_asked
from ..solver.frame.refiner import Refiner
from ..solver.scene import Frame, Result
from ..usd.read.reader import Shot
from .report import LOG

RUN_IN, POSES = "run_in_ms", "poses"
"""Entries of a frame's telemetry: wall time of the run-in [ms], and number of poses from the bind pose on."""
MOST_POSES = 12
"""Poses from the bind pose to a first frame that crosses itself. A sleeve in two layers, bent by 100 degrees, comes out
clean after 12 and not after 6; three poses of people after 6, 12 and 24."""
EVERY_SECONDS = 10.0
"""Time between two messages of a run-in [s]."""
OF_COLD = 0.4
"""Time of a cage solved from the cage before, relative to one solved without: 0.39 and 0.09 in two shots of people
whose clothes cross themselves from the start. It counts until such a cage is solved."""


class RunIn:
    """Reads the frames of a run-in, and says before it starts and while it lasts how much is left.

    Before a run whose first cage crosses itself, `lead_in` solves cages alone: of the first frame and of frames 1, 2,
    4, 8, ... before it, until one comes clean, and from that one on every cage up to the first frame. Each frame is
    read just before it is solved, and the first frame once more before all others.
    """

    def __init__(self, read: Callable[[float | None], Frame], times: Sequence[float], shot: str) -> None:
        """Start without a frame.

        Args:
            read: Reads the frame at a time code.
            times: The shot's time codes up to the run's first, in order.
            shot: Name of the shot, for messages.
        """
        self._read, self._times, self._shot = read, list(times), shot
        self._cold, self._carried = list[float](), list[float]()  # Durations of solved cages [s].
        self._reads, self._number, self._walks = 0, -1, False
        self._began = self._last = self._messaged = 0.0

    @property
    def seconds(self) -> float:
        """Wall time since the run-in started [s]; 0 without one."""
        return clock.perf_counter() - self._began if self._began else 0.0

    @property
    def most(self) -> tuple[int, int]:
        """Most cages left to be solved: without the cage before, and from the cage before."""
        last = len(self._times) - 1
        if self._walks:
            return 0, last - self._number + 1
        steps, back = 1, 0
        while back < last:
            steps, back = steps + 1, max(2 * back, 1)
        return steps - len(self._cold), last

    @property
    def left(self) -> float:
        """Most time left [s], as estimated from the cages solved so far; infinite before the first."""
        if not self._cold:
            return float("inf")
        cold, carried = self.most
        return cold * mean(self._cold) + carried * (mean(self._carried or [OF_COLD * mean(self._cold)]))

    def __call__(self, time: float | None) -> Frame:
        """Read the frame at a time code; ends the run where a signal asks for it."""
        leave_if_asked()
        now, number = clock.perf_counter(), self._times.index(time) if time in self._times else 0
        if self._reads == 1:
            self._began = self._last = now
        elif self._reads > 1:
            (self._carried if self._walks else self._cold).append(now - self._last)
            self._walks = self._walks or number > self._number
        self._reads, self._number, self._last = self._reads + 1, number, now
        if self._reads > 1:
            self._say(now)
        return self._read(time)

    def _say(self, moment: float) -> None:
        """Say at the start what may come, and every `EVERY_SECONDS` how far the run-in is."""
        solved, most = len(self._cold) + len(self._carried), sum(self.most)
        if not solved:
            text = f"time code {named_time(self._times[-1])} needs a run-in, for its cage crosses itself: "
            text += f"before it the cages alone are solved, at most {most} times"
        elif moment - self._messaged < EVERY_SECONDS:
            return
        else:
            text = f"run-in: {solved} of at most {solved + most} cages solved, at most about {self.left:.0f} s left"
        self._messaged = moment
        LOG.log(NOTICE, "%s", text, extra={"shot": self._shot})


def pose_in(
    shot: Shot, refiner: Refiner, time: float | None, count: int, *, while_clean: bool = False
) -> tuple[float, bool]:
    """Solve poses between the bind pose and a frame of skinned cloth, so that the frame continues from the last pose.

    Poses that fail are left out.

    Args:
        shot: The shot, with skinned cloth or bodies.
        refiner: The refiner that solves the frame next.
        time: Time code of the frame.
        count: Number of poses; the first is the bind pose.
        while_clean: Whether to end at a pose in which cloth crosses cloth.

    Returns:
        Wall time [s], and whether all poses were solved.
    """
    began = clock.perf_counter()
    text = f"before time code {named_time(time)}, {counted(count, 'pose')} from the bind pose on are solved"
    text += ", since its cloth crosses itself" if while_clean else ""
    LOG.log(NOTICE, "%s", text, extra={"shot": shot.path})
    spacing = min(np.diff(shot.every_time), default=1.0)
    for number in range(count):
        leave_if_asked()
        with suppress(SolveError, StageError):
            frame = shot.posed_frame(time, number / count)
            moment = None if time is None else time - (count - number) * spacing
            result = refiner.solve(replace(frame, time=moment))
            if while_clean and crossings_of_cloth(result):
                return clock.perf_counter() - began, False
    return clock.perf_counter() - began, True


def crossings_of_cloth(result: Result) -> int:
    """Edges through faces of cloth in a frame; garments that are solved together each count those of all."""
    contacts = [garment.telemetry.get("contact", {}) for garment in result.garments]
    return sum(contact["cloth"]["after"]["crossings"] for contact in contacts if "cloth" in contact)
