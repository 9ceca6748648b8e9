"""Options of `chart_shot`, the two sizes of a chart, and how much of it fits into the time there is."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ...errors import UsageError
from ..methods import METHODS, PAPER

SHORT_MINUTES = 3.5
"""Time that the short form plans with: on a busy machine a plan takes a third longer, and pictures are drawn."""
LONGEST_SHORT = 15.0
"""Minutes up to which a chart has the short form's size."""
CLOCKS = ("wall", "cpu")
SLOW = (PAPER,)
"""Integrators with steps longer on the CPU than a whole frame of the rest: 4 s at 26,000 vertices."""
FOR_REFERENCE, FOR_CURVES = 0.25, 0.5
"""Fractions of the time."""
PARTS = {"reference": (0.0, 0.25), "curves": (0.25, 0.75), "warm": (0.75, 0.85), "terms": (0.85, 1.0)}
"""Parts of a chart in order, each with the fractions of the time at the part's beginning and end."""
LATEST = 1.1
"""Fraction of the time after which nothing more is begun; a rerun goes on."""
LEAST_REACH = 2.5
"""Least `Size.reach` that a plan comes down to."""
REFERENCE_SECONDS = 300.0
"""Time for a frame's Phi* without a limit."""
TERM_SOLVES = 30
"""Solves at refine's default that the terms take, about."""
BUDGETS = 10
"""Approximate number of doubling budgets of a method."""
SPARSE = 4.0
"""Growth of the budgets where even short curves would take too long."""


@dataclass(frozen=True)
class Size:
    """Extent of a chart.

    Attributes:
        minutes: Time to plan with, or None for as long as it takes.
        repeats: Measurements of each time, at least.
        more: Measurements of each time if time is left.
        growth: Ratio of a budget's steps to the previous budget's; 2 or 1.5.
        reach: Longest time measured, in times of refine's default.
        frames: Most frames.
    """

    minutes: float | None
    repeats: int
    more: int
    growth: float
    reach: float
    frames: int


SHORT = Size(SHORT_MINUTES, repeats=3, more=6, growth=2.0, reach=6.25, frames=2)
LONG = Size(None, repeats=5, more=5, growth=1.5, reach=8.0, frames=3)


@dataclass(frozen=True)
class ChartOptions:
    """Options of `chart_shot`.

    Attributes:
        frames: First and last time code that frames are taken from, or None for all of the shot.
        garments, colliders: Prim paths, globs or collections; empty finds applied schemas.
        level: Subdivisions; -1 chooses, None takes the stage's.
        overrides: "</Prim>.attribute=value" or "attribute=value".
        rest_frame: Time code whose points are the rest shape, "auto" for one fitted to the shot, or None.
        clock: "wall", or "cpu" for the processor time of a core, independent of other programs.
        methods: Names of `METHODS` to measure; empty takes all, on the CPU's short form but `SLOW`.
        peers: "NAME=PYTHON" for each solver outside to measure; see `peers.run.PEERS`.
        count: Frames to measure, or None for the size's own number.
        short: Whether to take the short size.
        budget_minutes: Minutes to plan with, or None.
        repeats: Measurements of each time, or None for as many as there is time for.
        overwrite: Whether to replace a chart of a different problem.
        progress: Called with (fraction done, seconds left, what is being measured), or None.
    """

    frames: tuple[float, float] | None = None
    garments: Sequence[str] = ()
    colliders: Sequence[str] = ()
    level: int | None = None
    overrides: Sequence[str] = ()
    rest_frame: float | str | None = None
    device: str = "cpu"
    clock: str = "wall"
    methods: Sequence[str] = ()
    peers: Sequence[str] = ()
    count: int | None = None
    short: bool = False
    budget_minutes: float | None = None
    repeats: int | None = None
    overwrite: bool = False
    progress: Callable[[float, float, str], None] | None = field(default=None, compare=False)

    def check(self) -> None:
        """Refuse options that no chart can be made with.

        Raises:
            UsageError: An option is wrong.
        """
        for name in ("count", "repeats", "budget_minutes"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise UsageError(f"{name} of {value:g}: give a number above 0")
        if self.device != "cpu" and not self.device.startswith("cuda"):
            raise UsageError(f"unknown device '{self.device}'; known: cpu, cuda")
        if self.clock not in CLOCKS or (self.clock == "cpu" and self.device != "cpu"):
            raise UsageError(f"clock '{self.clock}' on {self.device}; known: wall, and on the cpu cpu")

    @property
    def is_short(self) -> bool:
        """Whether the chart has the short form's size."""
        return self.short or (self.budget_minutes is not None and self.budget_minutes <= LONGEST_SHORT)

    def size(self) -> Size:
        """Extent of the chart."""
        chosen = SHORT if self.is_short else LONG
        return replace(
            chosen,
            minutes=self.budget_minutes or chosen.minutes,
            repeats=self.repeats or chosen.repeats,
            more=chosen.more if self.repeats is None else self.repeats,
            frames=self.count or chosen.frames,
        )

    def names(self) -> tuple[str, ...]:
        """Integrators to measure; empty for all."""
        if self.methods or self.device != "cpu" or not self.is_short:
            return tuple(self.methods)
        return tuple(name for name, method in METHODS.items() if method.nested is not None and name not in SLOW)

    def plain(self) -> dict[str, Any]:
        """Settings of the problem that is measured, ready for JSON."""
        names = ("garments", "colliders", "overrides", "level", "rest_frame", "device", "clock")
        return {name: list(v) if isinstance(v := getattr(self, name), list | tuple) else v for name in names}


@dataclass(frozen=True)
class Plan:
    """Settings of a measurement, a `Size` fitted into its time.

    Attributes:
        most_ms: Time of a frame beyond which a method takes no larger budget.
        reference_seconds: Time for the least energy of one frame.
        minutes: Approximate time of the whole chart.
    """

    frames: int
    repeats: int
    growth: float
    most_ms: float
    reference_seconds: float
    minutes: float


def make_plan(
    size: Size, *, curves: int, default_ms: float, elapsed_ms: float, judge_ms: float, least_ms: float = 0.0
) -> Plan:
    """Fit a size into its time: fewer frames first, then shorter curves, then fewer budgets.

    Args:
        curves: Number of methods.
        default_ms: Time of a frame by refine's default, as the chart counts it [ms].
        elapsed_ms: Wall time of the frame, including the work around the solve [ms].
        judge_ms: Time of judging a result [ms].
        least_ms: Wall time of a solve of a single step, which fewer steps do not save [ms].
    """
    frames, reach, repeats, growth = size.frames, size.reach, size.repeats, size.growth

    def seconds() -> float:
        """Time of all curves: each is a geometric series that ends at the reach; every result is judged once."""
        budgets = BUDGETS / math.log2(growth)
        series = growth / (growth - 1.0) * max(reach * elapsed_ms - least_ms, 0.0) + budgets * least_ms
        return 1e-3 * frames * curves * (repeats * series + budgets * judge_ms)

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
    """How far a chart is, and when its time is spent.

    A chart is done in the parts of `PARTS`, one after another. Within a part that says how much of it is done the bar
    goes by that, else by the time it should take; a part that takes longer slows the bar down and never stops it.

    Attributes:
        expected: Expected time of the chart [s].
    """

    def __init__(self, minutes: float | None, progress: Callable[[float, float, str], None] | None) -> None:
        """Start the clock with a time limit [min] or None; ``progress`` as in `ChartOptions`."""
        self._began = self._entered = time.perf_counter()
        self._most, self._progress = math.inf if minutes is None else 60.0 * minutes, progress
        self._part, self._done, self._shown = next(iter(PARTS)), 0.0, 0.0
        self.expected = 60.0 * (minutes or 0.0)

    @property
    def spent(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._began

    @property
    def late(self) -> bool:
        """Whether the present part has to end."""
        return self.spent > PARTS[self._part][1] * self._most

    @property
    def over(self) -> bool:
        """Whether no further measurement may begin."""
        return self.spent > LATEST * self._most

    def expect(self, seconds: float) -> None:
        """Set the expected total time [s]."""
        self.expected = min(seconds, self._most)

    def enter(self, part: str) -> None:
        """Begin a part out of `PARTS`."""
        self._part, self._done, self._entered = part, 0.0, time.perf_counter()

    def say(self, what: str, done: float | None = None) -> None:
        """Report the present measurement, and the finished fraction of its part; None for an unknown fraction."""
        self._done = self._done if done is None else done
        if not self._progress:
            return
        low, high = PARTS[self._part]
        planned = max((high - low) * self.expected, 1e-9)
        by_time = 1.0 - math.exp(-(time.perf_counter() - self._entered) / planned)
        self._shown = max(self._shown, low + (high - low) * max(self._done, by_time))
        rest = self.spent * (1.0 - self._shown) / max(self._shown, 1e-9)
        left = max(self.expected - self.spent, 0.0) if self._shown < PARTS["reference"][1] else rest
        self._progress(self._shown, left, what)
