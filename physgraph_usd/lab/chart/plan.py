"""How much of a chart fits into the time there is, and what of it is left."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from .options import Size

FOR_REFERENCE, FOR_CURVES, FOR_TERMS = 0.25, 0.55, 0.15
"""Parts of the time."""
LATEST = 1.1
"""Part of the time after which nothing more is begun; a rerun goes on."""
LEAST_REACH = 2.5
REFERENCE_SECONDS = 300.0
"""Time for a frame's Phi* where there is no limit."""
TERM_SOLVES = 30
"""Solves at refine's default that the terms take, about."""
RUNGS = 10
"""Budgets of a method that double, about."""
SPARSE = 4.0
"""Growth of the budgets where even short curves would take too long."""


@dataclass(frozen=True)
class Plan:
    """What is measured.

    Attributes:
        frames: Number of frames.
        repeats: Measurements of each time.
        growth: Steps of a rung over those of the one before.
        most_ms: Time of a frame beyond which a method takes no further rung.
        reference_seconds: Time for the least energy of one frame.
        minutes: Time that all of it takes, about.
    """

    frames: int
    repeats: int
    growth: float
    most_ms: float
    reference_seconds: float
    minutes: float

    def plain(self) -> dict[str, Any]:
        """Ready for JSON."""
        return asdict(self)


def make_plan(
    size: Size, *, curves: int, default_ms: float, elapsed_ms: float, judge_ms: float, least_ms: float = 0.0
) -> Plan:
    """Fit a size into its time: fewer frames first, then shorter curves, then fewer budgets.

    Args:
        size: What is wanted.
        curves: Number of methods.
        default_ms: Time of a frame by refine's default, as the chart counts it [ms].
        elapsed_ms: Wall time of the same and of what goes with it [ms].
        judge_ms: Time of judging a result [ms].
        least_ms: Wall time of a solve of a single step: what no fewer steps save [ms].
    """
    frames, reach, repeats, growth = size.frames, size.reach, size.repeats, size.growth

    def seconds() -> float:
        """Time of all curves: each is a geometric series that ends at the reach; every result is judged once."""
        rungs = RUNGS / math.log2(growth)
        series = growth / (growth - 1.0) * max(reach * elapsed_ms - least_ms, 0.0) + rungs * least_ms
        return 1e-3 * frames * curves * (repeats * series + rungs * judge_ms)

    if size.minutes is not None:
        room = 60.0 * FOR_CURVES * size.minutes
        while frames > 1 and seconds() > room:
            frames -= 1
        while reach > LEAST_REACH and seconds() > room:
            reach /= 1.25
        growth = SPARSE if seconds() > room else growth
        while repeats < size.more and seconds() < room * repeats / (repeats + 1):
            repeats += 1
    reference = REFERENCE_SECONDS if size.minutes is None else 60.0 * FOR_REFERENCE * size.minutes / frames
    total = seconds() + frames * reference + TERM_SOLVES * 1e-3 * (elapsed_ms + judge_ms)
    return Plan(frames, repeats, growth, reach * default_ms, reference, round(total / 60.0, 1))


class Clock:
    """Tells how far a chart is and when its time is spent."""

    def __init__(self, minutes: float | None, progress: Callable[[float, float, str], None] | None) -> None:
        """Start.

        Args:
            minutes: Time that there is, or None.
            progress: Called with (part done, seconds left, what is being measured), or None.
        """
        self._began = time.perf_counter()
        self._minutes, self._progress = minutes, progress
        self.expected = 60.0 * (minutes or 0.0)

    @property
    def spent(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._began

    @property
    def late(self) -> bool:
        """Whether the curves have to end."""
        return self._minutes is not None and self.spent > 60.0 * (1.0 - FOR_TERMS) * self._minutes

    @property
    def over(self) -> bool:
        """Whether no further measurement may begin."""
        return self._minutes is not None and self.spent > 60.0 * LATEST * self._minutes

    def expect(self, seconds: float) -> None:
        """Correct the time that all of it will take."""
        self.expected = seconds if self._minutes is None else min(seconds, 60.0 * self._minutes)

    def say(self, what: str) -> None:
        """Tell what is being measured."""
        if self._progress:
            left = max(self.expected - self.spent, 0.0)
            self._progress(min(self.spent / max(self.expected, 1e-9), 0.99), left, what)
