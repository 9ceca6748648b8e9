"""Warm frames: consecutive frames, each started from the previous result, by refine's default and the default's parts.

Each run begins with a cold frame of its own. The last frame is judged, which is one of those whose Phi* is known; the
time is that of the frames after the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from ...errors import SolveError, counted
from ...solver.scene import Frame
from ..methods import METHODS
from .journal import Journal
from .measure import DEFAULT as AUTO
from .options import Clock
from .problem import DEFAULT, Problem
from .table import typical

METHODS_OF_WARM = ("quasi-newton", "physgraph")
"""The methods that refine's default chooses from, frame by frame."""
STEPS = (12, 6, 24, 3, 48)
"""Step limits of a frame, the most informative first."""
ROW = 4
"""Number of consecutive frames, including the cold frame."""
REPEATS = 3


def measure_warm(journal: Journal, problems: tuple[Problem, Problem], row: Sequence[Frame], clock: Clock) -> None:
    """Measure rows missing in the journal, within the time."""
    if len(row) < 2:
        return
    timed, judge = problems
    runs = [(AUTO, 12, DEFAULT)]
    for steps in STEPS:
        runs += [(name, steps, replace(DEFAULT, method=METHODS[name], steps=steps)) for name in METHODS_OF_WARM]
    for repeat in range(REPEATS):
        for number, (name, steps, settings) in enumerate(runs):
            if journal.one("warm", repeat=repeat, method=name, steps=steps, frame=row[-1].time):
                continue
            if clock.late:
                return
            words = f"warm frames, {name}, {counted(steps, 'step')}, turn {repeat + 1} of {REPEATS}"
            clock.say(words, (repeat * len(runs) + number) / (REPEATS * len(runs)))
            timed.refiner.use(settings)
            try:
                solved = [timed.next(frame) for frame in row]
            except SolveError:
                continue
            values: dict[str, Any] = {} if repeat else asdict(judge.judge(row[-1], solved[-1].points))
            values |= {} if name == AUTO else {"integrator": name, "nested": settings.method.nested}
            spent = [frame.milliseconds for frame in solved[1:]]
            journal.add(
                "warm",
                repeat=repeat,
                ms=round(typical(spent), 3),
                method=name,
                steps=steps,
                frame=row[-1].time,
                made=solved[-1].steps,
                tolerance=settings.tolerance,
                **values,
            )
