"""Cost and benefit of each modelling term, of the last frame's detail and of each level.

A term's cost is the time of a frame with it less that without; its benefit is how far the result moves, and the gap of
the other result by the full potential. Solves are refine's default ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial, reduce
from typing import Any

import numpy as np

from ...errors import SolveError
from ...solver.frame.settings import SolveSettings
from ...solver.scene import Frame, GarmentFrame, Scene
from .journal import Journal
from .options import Clock
from .problem import COLD, Problem, over_frames, with_garments
from .reference import rms_mm
from .table import typical

REPEATS = 5
RUN = 8
"""Number of consecutive frames for measuring a frame's effect on the next."""
Points = tuple[np.ndarray, ...]
"""Fine world positions [m] of each garment, shape (V, 3)."""


@dataclass(frozen=True)
class Without:
    """One thing left out of the model: of the scene, of each garment's values or of the solve."""

    term: str
    scene: Callable[[Scene], Scene] | None = None
    garment: Callable[[GarmentFrame], GarmentFrame] | None = None
    settings: Callable[[SolveSettings], SolveSettings] | None = None


TERMS = (
    Without("gravity", scene=lambda scene: replace(scene, gravity=np.zeros(3))),
    Without("bending", garment=lambda garment: replace(garment, fabric=replace(garment.fabric, bend=0.0))),
    Without("membrane", garment=lambda garment: replace(garment, fabric=replace(garment.fabric, shear=None))),
    Without("guide", garment=lambda garment: replace(garment, guide=0.0)),
    Without("contact", settings=lambda solve: replace(solve, contact=replace(solve.contact, form="off"))),
    Without("self contact", settings=lambda solve: replace(solve, contact=replace(solve.contact, cloth="off"))),
)
"""A new term of the potential is one line here."""


@dataclass(frozen=True, eq=False)
class TermBench:
    """Problems, frames and levels that the terms are measured on.

    Attributes:
        timed: The problem in float32.
        judge: The problem in float64.
        frames: Separate frames.
        row: Frames in a row, oldest first.
        build: Makes a problem in float32 from a scene and levels.
    """

    timed: Problem
    judge: Problem
    scene: Scene
    levels: tuple[int, ...]
    frames: tuple[Frame, ...]
    row: tuple[Frame, ...]
    build: Callable[[Scene, Sequence[int]], Problem]

    @property
    def terms(self) -> tuple[Without, ...]:
        """Terms present in the scene."""
        sheared = any(garment.fabric.has_membrane for garment in self.frames[0].garments)
        absent = {"membrane": not sheared, "contact": not any(garment.colliders for garment in self.scene.garments)}
        absent["gravity"] = not self.scene.gravity.any()
        return tuple(term for term in TERMS if not absent.get(term.term))

    def judged(self, points: Sequence[Points], frames: Sequence[Frame]) -> dict[str, Any]:
        """Results of frames judged by the full potential; energies are summed."""
        judged = [self.judge.judge(frame, result) for frame, result in zip(frames, points, strict=True)]
        return {
            "energy": sum(measures.energy for measures in judged),
            **over_frames([asdict(measures) for measures in judged]),
        }

    def compared(
        self, points: dict[str, Sequence[Points]], frames: Sequence[Frame], values: dict[str, dict[str, float]]
    ) -> dict[str, Any]:
        """A row of the results with and without something, each with more values, and how far they are apart [mm]."""
        row = {name: self.judged(positions, frames) | values[name] for name, positions in points.items()}
        return row | {"moved_mm": _moved(points["with"], points["without"])}


def measure_terms(journal: Journal, bench: TermBench, clock: Clock) -> None:
    """Measure every term, the last frame's detail and every level into the journal."""
    tasks: list[tuple[str, str, Callable[[], dict[str, Any]]]] = [
        (term.term, "term", partial(_one_term, bench, term)) for term in bench.terms
    ]
    levels = range(max(bench.levels) + 1)
    tasks += [(f"level {level}", "level", partial(_one_level, bench, level)) for level in levels]
    if len(bench.row) >= 4:
        tasks += [(name, "time", partial(_one_row, bench, name)) for name in ("tether", "warm")]
    clock.enter("terms")
    for number, (name, kind, measured) in enumerate(tasks):
        if clock.over:
            return
        if journal.one("term", term=name):
            continue
        clock.say(f"what {name} costs and buys", number / len(tasks))
        try:
            journal.add("term", term=name, kind=kind, **measured())
        except SolveError as error:
            journal.add("term", term=name, kind=kind, failed=str(error))


def _one_term(bench: TermBench, without: Without) -> dict[str, Any]:
    """Solve with and without a term, turn by turn."""
    changed, frames, settings = bench.timed, bench.frames, COLD
    if without.settings:
        settings = without.settings(COLD)
    else:
        changed = bench.build(without.scene(bench.scene) if without.scene else bench.scene, bench.levels)
    if without.garment:
        frames = [with_garments(frame, without.garment) for frame in frames]
    sides = {"with": (bench.timed, bench.frames, COLD), "without": (changed, frames, settings)}
    spent: dict[str, list[float]] = {name: [] for name in sides}
    points: dict[str, Sequence[Points]] = {}
    for _ in range(REPEATS + 1):
        for name, side in sides.items():
            ms, points[name] = _solved(*side)
            spent[name].append(ms)
    return bench.compared(
        points, bench.frames, {name: {"ms": typical(milliseconds[1:])} for name, milliseconds in spent.items()}
    )


def _one_level(bench: TermBench, level: int) -> dict[str, Any]:
    """Solve no finer than a level, and carry the result to the finest one by the linear map."""
    levels = [min(level, finest) for finest in bench.levels]
    coarser = bench.timed if tuple(levels) == bench.levels else bench.build(bench.scene, levels)
    turns = [_solved(coarser, bench.frames, COLD) for _ in range(REPEATS + 1)]
    above = [chain[count:] for chain, count in zip(bench.timed.refiner.refinements, levels, strict=True)]
    fine = [
        tuple(reduce(lambda x, step: np.asarray(step.linear @ x), chain, x) for chain, x in zip(above, p, strict=True))
        for p in turns[-1][1]
    ]
    full = _solved(bench.timed, bench.frames, COLD)[1]
    values = {"ms": typical([ms for ms, _ in turns[1:]]), "vertices": coarser.vertex_count}
    return {"without": bench.judged(fine, bench.frames) | values, "moved_mm": _moved(full, fine)}


def _one_row(bench: TermBench, temporal: str) -> dict[str, Any]:
    """Solve frames in a row with what a frame takes over from the last one, and each alone.

    A row's jerk is the RMS third difference of its detail, in fine edge lengths.
    """
    points: dict[str, Sequence[Points]] = {}
    values: dict[str, dict[str, float]] = {}
    flat = np.stack([np.concatenate(bench.timed.upsampled(frame, smooth=False)) for frame in bench.row])
    spacing = np.concatenate(bench.timed.spacing(bench.row[0]))[:, None]
    for name, settings in (("with", replace(COLD, temporal=temporal)), ("without", COLD)):
        bench.timed.refiner.use(settings)
        solved = [bench.timed.next(frame) for frame in bench.row]
        points[name] = [result.points for result in solved]
        third = np.diff(np.stack([np.concatenate(frame) for frame in points[name]]) - flat, n=3, axis=0) / spacing
        jerk = float(np.sqrt(np.square(third).sum(axis=2).mean()))
        values[name] = {"ms": typical([result.milliseconds for result in solved[1:]]), "jerk": jerk}
    return bench.compared(points, bench.row, values)


def _solved(problem: Problem, frames: Sequence[Frame], settings: SolveSettings) -> tuple[float, list[Points]]:
    """Mean time of frames solved cold [ms], and their positions [m]."""
    solved = [problem.solve(frame, settings) for frame in frames]
    return sum(result.milliseconds for result in solved) / len(solved), [result.points for result in solved]


def _moved(a: Sequence[Points], b: Sequence[Points]) -> float:
    """RMS distance between two results [mm]."""
    return rms_mm([points for frame in a for points in frame], [points for frame in b for points in frame])
