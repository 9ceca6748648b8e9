"""What each modelling term, the last frame's detail and each level cost and buy: the picture of no more than needed.

A term's price is the time of a frame with it less that without; what it buys is how far the result moves, and what the
other result is worth by the full potential. Solves are refine's default ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ...errors import SolveError
from ...solver.frame.settings import SolveSettings
from ...solver.scene import Frame, GarmentFrame, Scene
from .journal import Journal
from .plan import Clock
from .problem import COLD, Problem, Solved, with_garments
from .reference import rms_mm
from .table import typical

REPEATS = 5
RUN = 8
"""Frames in a row on which what frames owe to one another is measured."""


@dataclass(frozen=True)
class Without:
    """One thing left out of the model.

    Attributes:
        term: Its name.
        scene: Leaves it out of the scene.
        garment: Leaves it out of a garment's values.
        settings: Leaves it out of the solve.
    """

    term: str
    scene: Callable[[Scene], Scene] | None = None
    garment: Callable[[GarmentFrame], GarmentFrame] | None = None
    settings: Callable[[SolveSettings], SolveSettings] | None = None

    @property
    def same_problem(self) -> bool:
        """Whether only the settings differ."""
        return self.scene is None and self.garment is None


TERMS = (
    Without("gravity", scene=lambda scene: replace(scene, gravity=np.zeros(3))),
    Without("bending", garment=lambda each: replace(each, fabric=replace(each.fabric, bend=0.0))),
    Without("membrane", garment=lambda each: replace(each, fabric=replace(each.fabric, shear=None))),
    Without("guide", garment=lambda each: replace(each, guide=0.0)),
    Without("contact", settings=lambda given: replace(given, contact=replace(given.contact, form="off"))),
    Without("self contact", settings=lambda given: replace(given, contact=replace(given.contact, cloth="off"))),
)
"""A new term of the potential is one line here."""


@dataclass(frozen=True, eq=False)
class Bench:
    """What the terms are measured on.

    Attributes:
        timed: The problem in float32.
        judge: The problem in float64.
        scene: The scene.
        levels: Subdivisions of each garment.
        frames: Frames that stand alone.
        run: Frames in a row, oldest first.
        build: Makes a problem in float32 from a scene and levels.
    """

    timed: Problem
    judge: Problem
    scene: Scene
    levels: tuple[int, ...]
    frames: tuple[Frame, ...]
    run: tuple[Frame, ...]
    build: Callable[[Scene, Sequence[int]], Problem]

    @property
    def terms(self) -> tuple[Without, ...]:
        """Those that the scene has."""
        sheared = any(garment.fabric.shear is not None for garment in self.frames[0].garments)
        absent = {"membrane": not sheared, "contact": not self.timed.has_bodies}
        absent["gravity"] = not self.scene.gravity.any()
        return tuple(each for each in TERMS if not absent.get(each.term))


def measure_terms(journal: Journal, bench: Bench, clock: Clock) -> None:
    """Measure every term, the last frame's detail and every level into the journal."""
    tasks: list[tuple[str, str, Callable[[], dict[str, Any]]]] = [
        (each.term, "term", lambda each=each: _one_term(bench, each)) for each in bench.terms
    ]
    tasks += [
        (f"level {level}", "level", lambda level=level: _one_level(bench, level))
        for level in range(max(bench.levels) + 1)
    ]
    if len(bench.run) >= 4:
        tasks += [(name, "time", lambda name=name: _one_run(bench, name)) for name in ("tether", "warm")]
    for name, kind, measured in tasks:
        if clock.over:
            return
        if not journal.one("term", term=name):
            clock.say(f"what {name} costs and buys")
            _record(journal, name, kind, measured)


def _record(journal: Journal, term: str, kind: str, measured: Callable[[], dict[str, Any]]) -> None:
    try:
        journal.add("term", term=term, kind=kind, **measured())
    except SolveError as error:
        journal.add("term", term=term, kind=kind, failed=str(error))


def _one_term(bench: Bench, without: Without) -> dict[str, Any]:
    """Solve with and without a term, turn by turn."""
    scene = without.scene(bench.scene) if without.scene else bench.scene
    other = bench.timed if without.same_problem else bench.build(scene, bench.levels)
    settings = without.settings(COLD) if without.settings else COLD
    frames = [with_garments(f, without.garment) if without.garment else f for f in bench.frames]
    return _compare(
        bench,
        [lambda f=f: bench.timed.solve(f, COLD) for f in bench.frames],
        [lambda f=f: other.solve(f, settings) for f in frames],
        bench.frames,
    )


def _one_level(bench: Bench, level: int) -> dict[str, Any]:
    """Solve no finer than a level, and carry the result to the finest one."""
    levels = [min(level, each) for each in bench.levels]
    other = bench.timed if tuple(levels) == bench.levels else bench.build(bench.scene, levels)
    spent: list[float] = []
    solved: list[Solved] = []
    for _ in range(REPEATS + 1):
        solved = [other.solve(frame, COLD) for frame in bench.frames]
        spent.append(sum(each.milliseconds for each in solved) / len(solved))
    fine = [_carried_up(bench, each.points, levels) for each in solved]
    full = [bench.timed.solve(frame, COLD).points for frame in bench.frames]
    values = _worth(bench, fine, bench.frames) | {"ms": typical(spent[1:]), "vertices": other.vertex_count}
    return {"without": values, "moved_mm": _moved(full, fine)}


def _one_run(bench: Bench, temporal: str) -> dict[str, Any]:
    """Solve frames in a row with what a frame takes over from the last one, and each alone."""
    settings = {"with": replace(COLD, temporal=temporal), "without": COLD}
    found: dict[str, Any] = {}
    points: dict[str, list[tuple[np.ndarray, ...]]] = {}
    for name, each in settings.items():
        bench.timed.refiner.use(each)
        solved = [bench.timed.next(frame) for frame in bench.run]
        points[name] = [one.points for one in solved]
        spent = typical([one.milliseconds for one in solved[1:]])
        found[name] = _worth(bench, points[name], bench.run) | {"ms": spent, "jerk": _jerk(bench, points[name])}
    return found | {"moved_mm": _moved(points["with"], points["without"])}


def _compare(
    bench: Bench, full: Sequence[Callable[[], Any]], other: Sequence[Callable[[], Any]], frames: Sequence[Frame]
) -> dict[str, Any]:
    spent: dict[str, list[float]] = {"with": [], "without": []}
    points: dict[str, list[tuple[np.ndarray, ...]]] = {}
    for _ in range(REPEATS + 1):
        for name, solves in (("with", full), ("without", other)):
            solved = [solve() for solve in solves]
            spent[name].append(sum(each.milliseconds for each in solved) / len(solved))
            points[name] = [each.points for each in solved]
    found = {
        name: _worth(bench, points[name], frames) | {"ms": typical(spent[name][1:])} for name in ("with", "without")
    }
    return found | {"moved_mm": _moved(points["with"], points["without"])}


def _worth(bench: Bench, points: Sequence[tuple[np.ndarray, ...]], frames: Sequence[Frame]) -> dict[str, Any]:
    """Judge results by the full potential; energies are summed over the frames."""
    judged = [bench.judge.judge(frame, each) for frame, each in zip(frames, points, strict=True)]
    values = [asdict(each) for each in judged]
    return {
        "energy": sum(each.energy for each in judged),
        "strain": max(each["strain"] for each in values),
        "inside": sum(each["inside"] for each in values),
        "deepest_mm": max(each["deepest_mm"] for each in values),
        "crossings": sum(each["crossings"] for each in values),
        "tangles": sum(each["tangles"] for each in values),
    }


def _carried_up(bench: Bench, points: Sequence[np.ndarray], levels: Sequence[int]) -> tuple[np.ndarray, ...]:
    fine = []
    for chain, own, level in zip(bench.timed.refiner.refinements, points, levels, strict=True):
        for refinement in chain[level:]:
            own = np.asarray(refinement.linear @ own)  # noqa: PLW2901
        fine.append(own)
    return tuple(fine)


def _moved(a: Sequence[tuple[np.ndarray, ...]], b: Sequence[tuple[np.ndarray, ...]]) -> float:
    """RMS distance between two results [mm]."""
    return rms_mm([points for each in a for points in each], [points for each in b for points in each])


def _jerk(bench: Bench, points: Sequence[tuple[np.ndarray, ...]]) -> float:
    """RMS third difference of the detail over a run, in fine edge lengths (DESIGN 4.5)."""
    detail = [
        np.concatenate([p - q for p, q in zip(each, bench.timed.upsampled(frame, smooth=False), strict=True)])
        for each, frame in zip(points, bench.run, strict=True)
    ]
    spacing = np.concatenate(bench.timed.spacing(bench.run[0]))
    third = np.diff(np.stack(detail), n=3, axis=0) / spacing[:, None]
    return float(np.sqrt(np.square(third).sum(axis=2).mean()))
