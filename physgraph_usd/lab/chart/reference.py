"""Phi*: the least energy known for a frame. One function for all charts and benchmarks.

Cloth buckles in many ways, and a descent ends in the one that its start lies nearest to. So several are begun, in
float64: each integrator of `STARTS` with its steps, then quasi-Newton at the finest level, for as long as that lowers
the energy; last, Newton from each that was among the best two of those tried until then, as a search that ends early
goes on from no other. Where a method that is measured finds less, that is Phi* in the end.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import counted
from ...solver.frame.settings import SolveSettings
from ...solver.frame.state import State
from ...solver.scene import Frame
from ...solver.seen import normal_angles
from ..methods import METHODS
from .problem import COLD, Problem

STARTS = (
    ("quasi-newton", 6),
    ("quasi-newton-flat", 48),
    ("physgraph", 48),
    ("quasi-newton", 24),
    ("lbfgs", 48),
    ("quasi-newton", 3),
    ("quasi-newton", 96),
)
"""Integrators and steps: unlike one another, the most successful first, for a short search ends early."""
SHORT, LEAST = 3, 2
"""Number of integrators in a short search, and after the time limit: a single result has no estimate of its error."""
ON, ROUNDS, MORE = ("quasi-newton-flat", 100), 2, 10
"""Method and steps of continuing a start, most repetitions, and further repetitions for finalists."""
NEWTON, POLISHES = ("newton", 8), 6
FINALISTS = 2
"""How many starts of a search, and of each beginning of it, Newton goes on from."""
SETTLED = 2e-4
"""Fall of the energy, over the whole fall, under which going on is not worth it: gaps are shown to a thousandth."""
SOLUTION = "chart.solution.{}.npz"
DESCENT = 0.6
"""Fraction of the time after which no start is begun."""


@dataclass(frozen=True)
class Reference:
    """The least energy known for a frame.

    Attributes:
        start: Energy of the upsampled cage [J].
        least: The least energy [J].
        energies: The least energy by term [J].
        by: Name of the start or method with the least energy.
        apart: Distance to the second-best start, as a fraction of the whole fall; None with a single start.
        seconds: Time spent [s].
        points: Fine world positions [m] of each garment at the least energy.
    """

    start: float
    least: float
    energies: dict[str, float]
    by: str
    apart: float | None = None
    seconds: float = 0.0
    points: tuple[np.ndarray, ...] = field(repr=False, default=())

    @staticmethod
    def of(plain: dict[str, Any]) -> Reference:
        """The inverse of `plain`."""
        return Reference(**{field_.name: plain[field_.name] for field_ in fields(Reference) if field_.name in plain})

    def plain(self) -> dict[str, Any]:
        """Values for JSON, without the positions."""
        return {name: value for name, value in vars(self).items() if name != "points"}

    def gap(self, energy: float) -> float:
        """(Phi - Phi*) / (Phi0 - Phi*) of an energy [J]."""
        return (energy - self.least) / max(self.start - self.least, 1e-30)

    def lowered(self, energies: dict[str, float], by: str) -> Reference:
        """The reference once a method came to energies by term [J]: itself, unless those are less."""
        energy = sum(energies.values())
        if not energy < self.least:
            return self
        apart = (self.least - energy) / max(self.start - energy, 1e-30)
        return replace(self, least=energy, by=by, apart=apart, energies=energies, points=())

    def __str__(self) -> str:
        """Phi* [mJ], the method that found Phi*, and the gap to the next best method."""
        second = (
            "nobody else looked" if self.apart is None else f"the next best ends {self.apart:.2%} of the fall above"
        )
        return f"Phi* {1e3 * self.least:.5g} mJ by {self.by}; {second}"


class Solutions:
    """The positions of each frame's reference, in files beside the chart's rows: a chart that goes on has them, too."""

    def __init__(self, folder: Path, *, fresh: bool) -> None:
        """Read the positions stored in a folder; ``fresh`` deletes them instead."""
        self._folder = folder
        self._known: dict[float | None, tuple[np.ndarray, ...]] = {}
        for file in folder.glob(SOLUTION.format("*")) if fresh else ():
            file.unlink()

    def keep(self, time: float | None, points: Sequence[np.ndarray]) -> None:
        """Store the fine world positions [m] of a frame, one array a garment."""
        self._known.pop(time, None)
        np.savez(self._file(time), *points)

    def apart_mm(self, frame: Frame, points: Sequence[np.ndarray]) -> float | None:
        """RMS distance of fine positions [m] from the frame's reference [mm]; None where none is stored."""
        known = self.points(frame.time)
        return None if known is None else rms_mm(points, known)

    def degrees(self, frame: Frame, points: Sequence[np.ndarray], triangles: Sequence[np.ndarray]) -> float | None:
        """Median angle between the vertex normals of fine positions [m] and of the frame's reference [degrees].

        Args:
            frame: The frame.
            points: Fine world positions [m], one array a garment.
            triangles: Vertices of each triangle, one array a garment.

        Returns:
            None where no reference is stored.
        """
        points_known = self.points(frame.time)
        if points_known is None:
            return None
        angles = [normal_angles(*arrays) for arrays in zip(points, points_known, triangles, strict=True)]
        return float(np.median(np.concatenate(angles)))

    def points(self, time: float | None) -> tuple[np.ndarray, ...] | None:
        """Fine world positions [m] of the reference of a time code, one array a garment; None where none is stored."""
        file = self._file(time)
        if time not in self._known and file.exists():
            with np.load(file) as data:
                self._known[time] = tuple(data.values())
        return self._known.get(time)

    def _file(self, time: float | None) -> Path:
        return self._folder / SOLUTION.format("still" if time is None else f"{time:g}")


def rms_mm(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> float:
    """RMS distance between two results, arrays of positions [m], shape (V, 3) each [mm]."""
    apart = np.concatenate([p - q for p, q in zip(a, b, strict=True)])
    return 1e3 * float(np.sqrt(np.square(apart).sum(axis=1).mean()))


class _Descent:
    """Ever longer runs from a start; the best is stored."""

    def __init__(self, problem: Problem, frame: Frame, settings: SolveSettings, *, start: float) -> None:
        self._problem, self._frame, self._settings, self._start = problem, frame, settings, start
        self._states: Sequence[State | None] = [None] * len(problem.refiner.parts_of(frame))
        self.by, self.energy = "", math.inf
        self.energies: dict[str, float] = {}
        self.points: tuple[np.ndarray, ...] = ()

    def go_on(self, name: str, method: tuple[str, int], *, most: int, until: float = math.inf) -> _Descent:
        """Make so many runs at most, while there is time and each lowers the energy by much."""
        for _ in range(most):
            if time.perf_counter() > until:
                break
            settings = replace(self._settings, method=METHODS[method[0]], steps=method[1], tolerance=0.0)
            points, states = self._problem.go_on(self._frame, settings, self._states)
            judged, before = self._problem.judge(self._frame, points, self._settings), self.energy
            if judged.energy < before:
                self.by += name if not self.by.endswith(name) else ""
                self.energy, self.energies, self.points, self._states = judged.energy, judged.energies, points, states
            if not before - judged.energy > SETTLED * (self._start - judged.energy):
                break
        return self


def find_reference(
    problem: Problem, frame: Frame, *, settings: SolveSettings = COLD, seconds: float = math.inf, short: bool = False
) -> Reference:
    """Look for the least energy of a frame.

    Args:
        problem: The problem in float64.
        frame: The frame.
        settings: Potential and contact of the problem.
        seconds: Time to spend; one run may take longer. Without an end the answer depends on no machine's speed.
        short: Whether to try fewer starts.
    """
    began = time.perf_counter()
    start = problem.judge(frame, problem.upsampled(frame, smooth=False), settings).energy
    runs: list[_Descent] = []
    for method in STARTS[: SHORT if short else None]:
        if len(runs) >= LEAST and time.perf_counter() - began > DESCENT * seconds:
            break
        descent = _Descent(problem, frame, settings, start=start)
        descent.go_on(f"{method[0]}, {counted(method[1], 'step')}", method, most=1)
        runs.append(descent.go_on(", and on", ON, most=ROUNDS, until=began + DESCENT * seconds))
    # The best of all and the best of each beginning: what a search that ends earlier goes on from is among them.
    led = (run for k, run in enumerate(runs) if sum(earlier.energy < run.energy for earlier in runs[:k]) < FINALISTS)
    for finalist in sorted(led, key=lambda run: run.energy):
        finalist.go_on(", and on", ON, most=MORE, until=began + seconds)
        finalist.go_on(", and Newton", NEWTON, most=POLISHES, until=began + seconds)
    best, *further = sorted(runs, key=lambda run: run.energy)
    apart = (further[0].energy - best.energy) / max(start - best.energy, 1e-30) if further else None
    spent = round(time.perf_counter() - began, 3)
    return Reference(start, best.energy, best.energies, best.by, apart, spent, best.points)
