"""Method x budget: time, energy, and contact of every run, rung by rung, the methods interleaved.

A budget is a number of steps at the finest level, so what a method reaches with it repeats to the bit; only its time
is measured again. All methods take a rung before any takes the next, so that noise hits all alike.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ...errors import SolveError
from ...solver.scene import Frame
from .journal import Journal
from .methods import DEFAULT, SMOOTH, UPSAMPLED, Curve
from .plan import Clock, Plan
from .problem import COLD, Problem
from .reference import Solutions
from .table import JUDGED

FLAT = 1e-4
"""Fall of the energy over a rung, over the whole fall, under which a method has stopped getting anywhere."""
MOST_RUNGS = 24
NEARLY, FURTHER = 0.1, 3.0
"""Gap under which a method is nearly at the one it is judged by; how many times the longest time it then may take."""


def measure_curves(
    journal: Journal,
    problems: tuple[Problem, Problem],
    frames: Sequence[Frame],
    *,
    curves: Sequence[Curve],
    plan: Plan,
    clock: Clock,
    solutions: Solutions,
) -> None:
    """Measure every curve into the journal; rows that are there are not measured again.

    Args:
        journal: Where rows go.
        problems: The problem in float32, which is timed, and in float64, which judges.
        frames: The frames.
        curves: The methods.
        plan: Repeats, rungs and the longest time.
        clock: Tells when to stop.
        solutions: What the results are compared to.
    """
    bench = _Bench(journal, problems, frames, plan=plan, clock=clock, solutions=solutions)
    bench.without_physics()
    first_above = next(steps for steps in rungs(plan.growth) if steps >= COLD.steps)
    for repeat in range(plan.repeats):
        began = clock.spent
        alive = {curve.name: curve for curve in curves}
        for done, steps in enumerate(rungs(plan.growth), start=1):
            if steps == (first_above if repeat else 1):
                bench.run(DEFAULT, None, COLD.steps, repeat=repeat)
            for name, curve in list(alive.items()):
                if clock.late and (repeat or done > 1):
                    return
                bench.run(name, curve, steps, repeat=repeat)
                if bench.is_done(name, steps, growth=plan.growth):
                    del alive[name]
        clock.expect(clock.spent + (plan.repeats - 1 - repeat) * (clock.spent - began))


def rungs(growth: float) -> Iterator[int]:
    """Numbers of steps: powers of two, every other where they grow by four; those between where by under two."""
    for power in range(0, MOST_RUNGS, 2 if growth >= 4.0 else 1):
        yield 2**power
        if growth < 2.0 and power:
            yield 3 * 2 ** (power - 1)


class _Bench:
    """Runs one method with one budget on all frames."""

    def __init__(
        self,
        journal: Journal,
        problems: tuple[Problem, Problem],
        frames: Sequence[Frame],
        *,
        plan: Plan,
        clock: Clock,
        solutions: Solutions,
    ) -> None:
        self._journal, self._frames, self._plan, self._clock = journal, frames, plan, clock
        self._solutions = solutions
        self._timed, self._judge = problems

    def without_physics(self) -> None:
        """The two rows that no solver makes."""
        for name, smooth in ((UPSAMPLED, False), (SMOOTH, True)):
            for frame in self._frames:
                if self._journal.one("point", method=name, frame=frame.time):
                    continue
                began = time.perf_counter()
                points = self._timed.upsampled(frame, smooth=smooth)
                spent = 1e3 * (time.perf_counter() - began)
                found = self._judged(frame, points)
                self._add(name, frame, spent, steps=0, repeat=0, made=0, **found)

    def run(self, name: str, curve: Curve | None, steps: int, *, repeat: int) -> None:
        """One method with one budget on all frames; refine's own settings when there is no curve."""
        settings = COLD
        about: dict[str, Any] = {"tolerance": COLD.tolerance}
        if curve is not None:
            settings = replace(settings, method=curve.method, steps=steps, tolerance=0.0)
            about = {"integrator": curve.integrator, "nested": curve.method.nested}
        for frame in self._frames:
            key = {"method": name, "steps": steps, "frame": frame.time}
            if self._journal.one("point", repeat=repeat, **key) or self._journal.one("failed", **key):
                continue
            self._clock.say(f"{name}, {steps} steps, turn {repeat + 1} of {self._plan.repeats}")
            try:
                solved = self._timed.solve(frame, settings)
            except SolveError as error:
                self._journal.add("failed", error=str(error), **key)
                continue
            found = {} if repeat else self._judged(frame, solved.points)
            found |= {"made": solved.steps, "elapsed": solved.elapsed, "waited": solved.waited}
            self._add(name, frame, solved.milliseconds, steps=steps, repeat=repeat, **about, **found)

    def _judged(self, frame: Frame, points: Sequence[np.ndarray]) -> dict[str, Any]:
        return asdict(self._judge.judge(frame, points)) | {"apart_mm": self._solutions.apart_mm(frame, points)}

    def is_done(self, name: str, steps: int, *, growth: float) -> bool:
        """Whether a method's next rung would take too long, or gets nowhere."""
        rows = self._journal.rows("point", method=name, repeat=0)
        last = [row for row in rows if row["steps"] == steps]
        if len(last) < len(self._frames):
            return True
        if expected_ms(rows, steps, growth) > self._plan.most_ms * allowance(self._gap(last)):
            return True
        return self._is_flat(rows, steps)

    def _gap(self, rows: list[dict[str, Any]]) -> float:
        """The gap that a row of each frame leaves over all frames."""
        start, least = (sum(row[name] for row in self._journal.rows("reference")) for name in ("start", "least"))
        return (sum(_energy(row) for row in rows) - least) / max(start - least, 1e-30)

    def _is_flat(self, rows: list[dict[str, Any]], steps: int) -> bool:
        """Whether two rungs in a row changed next to nothing."""
        budgets = sorted({row["steps"] for row in rows if row["steps"] <= steps})[-3:]
        if len(budgets) < 3:
            return False
        totals = [sum(_energy(row) for row in rows if row["steps"] == each) for each in budgets]
        starts = sum(_energy(row) for row in self._journal.rows("point", method=UPSAMPLED))
        fall = max(starts - totals[-1], 1e-30)
        return all(math.isfinite(total) and abs(total - totals[-1]) < FLAT * fall for total in totals)

    def _add(self, name: str, frame: Frame, spent: float, **values: Any) -> None:
        self._journal.add("point", method=name, frame=frame.time, ms=round(spent, 3), **values)


def _energy(row: dict[str, Any]) -> float:
    return sum(row["energies"].values())


def allowance(gap: float) -> float:
    """How many times the longest time a method may take that has come to a gap.

    More where it is nearly there: else one run of a chart would tell its time and the next, a little slower, would not.
    """
    return FURTHER if JUDGED < gap < NEARLY else 1.0


def expected_ms(rows: list[dict[str, Any]], steps: int, growth: float) -> float:
    """Time of the next rung [ms], on the line through the last two: some of a frame's time does not grow with steps."""
    budgets = sorted({row["steps"] for row in rows if row["steps"] <= steps})[-2:]
    spent = [[row["ms"] for row in rows if row["steps"] == each] for each in budgets]
    means = [sum(each) / len(each) for each in spent]
    if len(means) < 2:
        return means[-1]
    slope = max(means[1] - means[0], 0.0) / (budgets[1] - budgets[0])
    return means[1] + slope * (growth - 1.0) * steps
