"""Phi*: the least energy known for a frame (DESIGN 4.5).

Nested quasi-Newton in float64 with twice as many steps each time, then Newton from the best of them, for as long as
that lowers the energy or until the time is spent. Where a method of the chart finds less, that is Phi* in the end.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..detail import Carried
from ..integrate import METHODS
from ..scene import Frame
from .judge import Judgement
from .problem import COLD, Problem

FIRST_STEPS = 24
MOST_STEPS = 800
SETTLED = 1e-3
"""Fall of the energy, over the whole fall, under which a longer run is not worth it."""
POLISH_STEPS = 4
POLISHES = 8
SOLUTION = "chart.solution.{}.npz"
DESCENT = 0.6
"""Part of the time after which the polish begins."""


@dataclass(frozen=True)
class Reference:
    """The least energy known for a frame.

    Attributes:
        start: Energy of the upsampled cage [J].
        least: The least energy [J].
        energies: The same by term [J].
        by: Who found it.
        gained: What the last longer run still gained of the whole fall.
        seconds: Time spent [s].
        points: Fine world positions [m] of each garment that have it.
    """

    start: float
    least: float
    energies: dict[str, float]
    by: str
    gained: float
    seconds: float
    points: tuple[np.ndarray, ...] = field(repr=False)

    def plain(self) -> dict[str, Any]:
        """Ready for JSON, without the positions."""
        return {name: value for name, value in vars(self).items() if name != "points"}


class Solutions:
    """The positions of each frame's reference, in files beside the chart's rows: a chart that goes on has them, too."""

    def __init__(self, folder: Path, *, fresh: bool) -> None:
        """Take those of a folder.

        Args:
            folder: Where they lie.
            fresh: Drop what is there.
        """
        self._folder = folder
        self._known: dict[float | None, tuple[np.ndarray, ...]] = {}
        for file in folder.glob(SOLUTION.format("*")) if fresh else ():
            file.unlink()

    def keep(self, time: float | None, points: Sequence[np.ndarray]) -> None:
        """Keep the fine world positions [m] of a frame, one array a garment."""
        np.savez(self._file(time), *points)

    def apart_mm(self, frame: Frame, points: Sequence[np.ndarray]) -> float | None:
        """RMS distance of fine positions [m] from the frame's reference [mm]; None where none was kept."""
        file = self._file(frame.time)
        if frame.time not in self._known and file.exists():
            with np.load(file) as data:
                self._known[frame.time] = tuple(data.values())
        known = self._known.get(frame.time)
        return None if known is None else rms_mm(points, known)

    def _file(self, time: float | None) -> Path:
        return self._folder / SOLUTION.format("still" if time is None else f"{time:g}")


def rms_mm(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> float:
    """RMS distance between two results, arrays of positions [m], shape (V, 3) each [mm]."""
    apart = np.concatenate([p - q for p, q in zip(a, b, strict=True)])
    return 1e3 * float(np.sqrt(np.square(apart).sum(axis=1).mean()))


class _Search:
    """The best result so far."""

    def __init__(self, problem: Problem, frame: Frame) -> None:
        self.problem, self.frame = problem, frame
        self.start = problem.judge(frame, problem.upsampled(frame, smooth=False)).energy
        self.best: Judgement | None = None
        self.points: tuple[np.ndarray, ...] = ()
        self.kept: Sequence[Carried | None] = [None] * len(problem.refiner.parts_of(frame))
        self.by, self.gained = "", 1.0

    def take(self, name: str, points: Any, kept: list[Carried]) -> None:
        """Judge a run and keep it when it is the best."""
        found = self.problem.judge(self.frame, points)
        known = self.start if self.best is None else self.best.energy
        self.gained = max(known - found.energy, 0.0) / max(self.start - min(known, found.energy), 1e-30)
        if self.best is None or found.energy < self.best.energy:
            self.best, self.by, self.kept, self.points = found, name, kept, points


def find_reference(problem: Problem, frame: Frame, *, seconds: float) -> Reference:
    """Look for the least energy of a frame.

    Args:
        problem: The problem in float64.
        frame: The frame.
        seconds: Time to spend; one run may take longer.
    """
    began = time.perf_counter()
    search = _Search(problem, frame)
    settled = 0
    for steps in _doubling():
        run = time.perf_counter()
        settings = replace(COLD, method=METHODS["quasi-newton"], steps=steps, tolerance=0.0)
        search.take(f"nested quasi-newton, {steps} steps", *problem.go_on(frame, settings, [None] * len(search.kept)))
        settled = settled + 1 if search.gained < SETTLED else 0
        now = time.perf_counter()
        if settled == 2 or now + 2.0 * (now - run) - began > DESCENT * seconds:
            break
    polish = replace(COLD, method=METHODS["newton"], steps=POLISH_STEPS, tolerance=0.0)
    for _ in range(POLISHES):
        if time.perf_counter() - began > seconds:
            break
        search.take(f"{search.by.partition(' +')[0]} + Newton", *problem.go_on(frame, polish, search.kept))
        if search.gained < SETTLED:
            break
    assert search.best is not None
    spent = round(time.perf_counter() - began, 3)
    least = search.best
    return Reference(search.start, least.energy, least.energies, search.by, search.gained, spent, search.points)


def _doubling() -> Iterator[int]:
    steps = FIRST_STEPS
    while steps <= MOST_STEPS:
        yield steps
        steps *= 2
