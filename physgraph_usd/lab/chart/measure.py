"""Method x budget: time, energy, and contact of every run, budget by budget, the methods interleaved.

A budget is a number of steps at the finest level, so what a method reaches with it repeats to the bit; only its time
is measured again. All methods take a budget before any takes the next, so that noise hits all alike.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ...errors import SolveError, UsageError, counted
from ...solver.integrate import Method
from ...solver.scene import Frame
from ..methods import METHODS
from .journal import Journal
from .options import Clock, Plan
from .problem import COLD, Problem
from .reference import Solutions

FLAT = 1e-4
"""Fall of the energy over a budget, over the whole fall, under which a method has stopped getting anywhere."""
MOST_BUDGETS = 24
JUDGED, NEARLY, FURTHER = 0.03, 0.1, 3.0
"""Ranking gap; gap that counts as nearly converged; time limit of such methods as a multiple of the plan's."""
DEFAULT = "refine's default"
UPSAMPLED, SMOOTH = "plain upsampling", "Loop subdivision"
"""Curves of a single point each."""


@dataclass(frozen=True)
class Curve:
    """One line of the chart: its name in legends and tables, the name in `METHODS`, and the method."""

    name: str
    integrator: str
    method: Method


def find_curves(names: Sequence[str] = ()) -> tuple[Curve, ...]:
    """Every integrator unchanged and, unless equal to a second integrator, with nesting switched.

    What chooses between others frame by frame is none of them: it is refine's default.

    Args:
        names: Names of `METHODS` to take; all when empty.

    Raises:
        UsageError: A name is no integrator's.
    """
    unknown = [name for name in names if name not in METHODS]
    if unknown:
        raise UsageError(f"unknown integrator '{unknown[0]}'; known integrators: {', '.join(METHODS)}")
    fixed = {name: method for name, method in METHODS.items() if method.nested is not None}
    chosen = {name: method for name, method in fixed.items() if not names or name in names}
    known = {(method.build, method.nested) for method in METHODS.values()}
    curves = [Curve(name, name, method) for name, method in chosen.items()]
    for name, method in chosen.items():
        opposite = replace(method, nested=not method.nested)
        if (opposite.build, opposite.nested) not in known:
            curves.append(Curve(f"{name}, {'nested' if opposite.nested else 'flat'}", name, opposite))
    return tuple(curves)


def budgets_of(growth: float) -> Iterator[int]:
    """Step budgets: powers of two; every second power for a growth of 4 or more, intermediate ones for under 2."""
    for power in range(0, MOST_BUDGETS, 2 if growth >= 4.0 else 1):
        yield 2**power
        if growth < 2.0 and power:
            yield 3 * 2 ** (power - 1)


class CurveBench:
    """Runs methods by budgets on frames; rows that are in the journal are not measured again."""

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
        """Take the problem in float32, which is timed, and in float64, which judges, and each frame's solution."""
        self.journal, self.frames, self.plan, self.clock = journal, frames, plan, clock
        self._solutions = solutions
        self.timed, self._judge = problems

    def measure(self, curves: Sequence[Curve]) -> None:
        """Measure every curve."""
        plan, clock = self.plan, self.clock
        clock.enter("curves")
        self._without_physics()
        first_above = next(steps for steps in budgets_of(plan.growth) if steps >= COLD.steps)
        for repeat in range(plan.repeats):
            began = clock.spent
            running = {curve.name: curve for curve in curves}
            for number, steps in enumerate(budgets_of(plan.growth)):
                if steps == (first_above if repeat else 1):
                    self._run(DEFAULT, None, COLD.steps, repeat=repeat)
                for name, curve in list(running.items()):
                    if clock.late and (repeat or number):
                        return
                    self._run(name, curve, steps, repeat=repeat)
                    if self._is_done(name, steps):
                        del running[name]
            clock.expect(clock.spent + (plan.repeats - 1 - repeat) * (clock.spent - began))

    def judged(self, frame: Frame, points: Sequence[np.ndarray]) -> dict[str, Any]:
        """Energy, strain, contact, distance and angle from the reference of fine positions [m], ready for a row."""
        degrees = self._solutions.degrees(frame, points, self.timed.triangles)
        apart = {"apart_mm": self._solutions.apart_mm(frame, points), "degrees": degrees}
        return asdict(self._judge.judge(frame, points)) | apart

    def _without_physics(self) -> None:
        """Measure the two curves that no solver makes."""
        for name, smooth in ((UPSAMPLED, False), (SMOOTH, True)):
            for frame in self.frames:
                if self.journal.one("point", method=name, frame=frame.time):
                    continue
                began = time.perf_counter()
                points = self.timed.upsampled(frame, smooth=smooth)
                spent = 1e3 * (time.perf_counter() - began)
                self._add(name, frame, spent, {"steps": 0, "repeat": 0, "made": 0, **self.judged(frame, points)})

    def _run(self, name: str, curve: Curve | None, steps: int, *, repeat: int) -> None:
        """Measure a method at one step budget on all frames; ``curve`` None measures refine's default settings."""
        settings = COLD
        kind: dict[str, Any] = {"tolerance": COLD.tolerance}
        if curve is not None:
            settings = replace(settings, method=curve.method, steps=steps, tolerance=0.0)
            kind = {"integrator": curve.integrator, "nested": curve.method.nested}
        for frame in self.frames:
            if self.journal.one("point", repeat=repeat, method=name, steps=steps, frame=frame.time):
                continue
            if self.journal.one("failed", method=name, steps=steps, frame=frame.time):
                continue
            self.clock.say(f"{name}, {counted(steps, 'step')}, turn {repeat + 1} of {self.plan.repeats}")
            try:
                solved = self.timed.solve(frame, settings)
            except SolveError as error:
                self.journal.add("failed", error=str(error), method=name, steps=steps, frame=frame.time)
                continue
            values = {} if repeat else self.judged(frame, solved.points)
            values |= {"made": solved.steps, "prepared": solved.prepared}
            values |= {"elapsed": solved.elapsed, "waited": solved.waited}
            self._add(name, frame, solved.milliseconds, {"steps": steps, "repeat": repeat, **kind, **values})

    def _is_done(self, name: str, steps: int) -> bool:
        """Whether a method's next budget would take too long, or its last three changed next to nothing.

        Where it is nearly at the gap by which methods are put in order it may take longer: else one run of a chart
        would know its time and the next, a little slower, would not.
        """
        rows = [row for row in self.journal.rows("point", method=name, repeat=0) if row["steps"] <= steps]
        budgets = sorted({row["steps"] for row in rows})[-3:]
        last = [row for row in rows if row["steps"] == steps]
        if len(last) < len(self.frames):
            return True
        start, least = (sum(row[name] for row in self.journal.rows("reference")) for name in ("start", "least"))
        gap = (_energy(last) - least) / max(start - least, 1e-30)
        longest = self.plan.most_ms * (FURTHER if JUDGED < gap < NEARLY else 1.0)
        if _expected_ms(rows, budgets[-2:], self.plan.growth) > longest:
            return True
        totals = [_energy([row for row in rows if row["steps"] == budget]) for budget in budgets]
        fall = max(_energy(self.journal.rows("point", method=UPSAMPLED)) - totals[-1], 1e-30)
        flat = all(math.isfinite(total) and abs(total - totals[-1]) < FLAT * fall for total in totals)
        return len(budgets) == 3 and flat

    def _add(self, name: str, frame: Frame, spent: float, values: Mapping[str, Any]) -> None:
        self.journal.add("point", method=name, frame=frame.time, ms=round(spent, 3), **values)


def _energy(rows: list[dict[str, Any]]) -> float:
    return sum(sum(row["energies"].values()) for row in rows)


def _expected_ms(rows: list[dict[str, Any]], budgets: Sequence[int], growth: float) -> float:
    """Time of the next budget [ms], on the line through the last two: some of a frame's time grows with no steps."""
    means = [statistics.fmean(row["ms"] for row in rows if row["steps"] == budget) for budget in budgets]
    if len(means) < 2:
        return means[-1]
    slope = max(means[1] - means[0], 0.0) / (budgets[1] - budgets[0])
    return means[1] + slope * (growth - 1.0) * budgets[1]
