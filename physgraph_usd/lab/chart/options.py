"""Everything that `chart_shot` can be told, and the two sizes of a chart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ...errors import UsageError

SHORT_MINUTES = 9.0
"""Time that the short form plans with: on a busy machine a plan takes a third longer."""
LONGEST_SHORT = 15.0
"""Minutes up to which a chart has the short form's size."""


CLOCKS = ("wall", "cpu")


@dataclass(frozen=True)
class Size:
    """How much is measured.

    Attributes:
        minutes: Time to plan with, or None for as long as it takes.
        repeats: Measurements of each time, at least.
        more: Measurements of each time where there is time left.
        growth: Steps of a budget over those of the one before; 2 or 1.5.
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
    """Everything that `chart_shot` can be told.

    Attributes:
        frames: First and last time code that frames are taken from, or None for all of the shot.
        garments: Prim paths, globs or collections; empty finds applied schemas.
        colliders: Prim paths, globs or collections; empty finds applied schemas.
        level: Subdivisions; -1 chooses, None takes the stage's.
        overrides: "</Prim>.attribute=value" or "attribute=value".
        rest_frame: Time code whose points are the rest shape, "auto" for one fitted to the shot, or None.
        device: "cpu" or "cuda".
        clock: "wall", or "cpu" to count one core's own time, which other programs do not change.
        methods: Names of `integrate.METHODS` to measure; empty takes all.
        peers: "NAME=PYTHON" for each solver outside to measure; see `peers.run.PEERS`.
        count: Frames to measure, or None for the size's own number.
        short: Take the short size.
        budget_minutes: Minutes to plan with, or None.
        repeats: Measurements of each time, or None for as many as there is time for.
        overwrite: Begin anew where another chart is.
        progress: Called with (part done, seconds left, what is being measured), or None.
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
        """Refuse what no chart could be made with.

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

    def size(self) -> Size:
        """How much is to be measured."""
        short = self.short or (self.budget_minutes is not None and self.budget_minutes <= LONGEST_SHORT)
        chosen = SHORT if short else LONG
        return replace(
            chosen,
            minutes=self.budget_minutes or chosen.minutes,
            repeats=self.repeats or chosen.repeats,
            more=chosen.more if self.repeats is None else self.repeats,
            frames=self.count or chosen.frames,
        )

    def plain(self) -> dict[str, Any]:
        """What decides the problem that is measured, ready for JSON."""
        names = ("garments", "colliders", "overrides", "level", "rest_frame", "device", "clock")
        return {name: list(v) if isinstance(v := getattr(self, name), list | tuple) else v for name in names}
