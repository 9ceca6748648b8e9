"""Is refine's default on the front of speed against accuracy? Samples and, where they are there, real shots.

    python -m benchmarks.front [--levels 1,2] [--shots flag,swatch] [--device cuda] [--fresh]

One cold frame of each shot at each level, contact included, measured as `physgraph-usd chart --clock cpu` does it:
the processor time of one core, on CUDA the wall's; energies judged in float64. Rivals are quasi-Newton and `physgraph`,
each through the levels and at the finest alone, and L-BFGS there, with growing steps. A ratio is the default's time
over the least of all to the same gap; up to 1.1 counts as level. A time is the least of so many turns, of every method
alike. Phi* is the least that anybody found, the short search of `lab/chart/reference.py` among them; below the
table stand who found it and how far the next best ended above it. What was measured lies in
build/front.DEVICE.CODE.jsonl: a run that was stopped goes on there while the code is the same.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

import physgraph_usd
from benchmarks.rows import code_of, say, table
from benchmarks.shots import opened
from physgraph_usd.lab.chart.problem import COLD, Problem, Solved, plain_detail
from physgraph_usd.lab.chart.reference import Reference, find_reference
from physgraph_usd.lab.chart.table import TOLERANCE, quickest
from physgraph_usd.lab.methods import METHODS
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.scene import Frame
from physgraph_usd.usd.read.reader import Shot, open_shot

JOURNAL = f"front.{{}}.{code_of(Path(physgraph_usd.__file__).parent)}.jsonl"
"""Rows of this code, by device."""
SAMPLES: dict[str, float | None] = {
    "flag": 12.0,
    "swatch": None,
    "sleeve": None,
    "block": 12.0,
    "frozen": None,
    "armpit": 15.0,
    "hood": 12.0,
    "torus": 20.0,
    "skirt": 24.0,
    "tshirt": 36.0,
    "layers": 8.0,
}
"""Samples and time codes; None takes the last."""
REAL: dict[str, tuple[list[str], list[str], float]] = {
    "07_flag_quads_nocollider.usda": (["/shot/flag"], [], 30.0),
    "08_sphere_spin_xformcollider.usdc": (["/shot/set/cloth"], ["/shot/set/rig/sphere"], 36.0),
    "01_newton_shirt_dab_cm.usdc": (["/shot/char/shirt_geo"], ["/shot/char/body_geo"], 1030.0),
    "09_cesiumman_kilt/shot.usda": (["/shot/kilt"], ["/shot/CesiumMan"], 24.0),
    "06_torus_pull.usda": (["/shot/cloth"], ["/shot/torus"], 30.0),
    "02_makehuman_usdskel_dm.usdc": (["/shot/char/top", "/shot/char/shorts"], ["/shot/char/body"], 30.0),
}
"""Real shots: garments, bodies and time code."""
RIVALS = METHODS | {"physgraph-flat": replace(METHODS["physgraph"], nested=False)}
STEPS = {
    "quasi-newton": (2, 4, 8, 16),
    "quasi-newton-flat": (4, 16, 32, 48, 64),
    "lbfgs": (16, 32, 64, 128),
    "physgraph": (2, 8, 16),
    "physgraph-flat": (8, 16, 32, 64, 128, 256),
}
DEFAULT, START, LEAST = "default", "start", "least"
FAR = 2.0
"""A method takes no more steps where it has taken so many times the default's time."""
SECONDS = 120.0
"""Time for the least energy of a frame: where cloth crowds bodies a long run takes minutes."""
TURNS = 3
"""How often a time is taken, of every method alike."""
SLOW_MS = 700.0
"""Time from which a solve is taken once: what else runs on the machine matters less then."""


def main() -> None:
    """Measure what is not known and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levels", default="1,2")
    parser.add_argument("--shots", default=",".join((*SAMPLES, *REAL)), help="names, or their beginnings")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--fresh", action="store_true", help="measure everything anew")
    given = parser.parse_args()
    prepare_device(given.device)
    journal = Path("build") / JOURNAL.format(given.device.partition(":")[0])
    journal.parent.mkdir(parents=True, exist_ok=True)
    if given.fresh or not journal.exists():
        journal.write_text("", encoding="utf-8")
    wanted = tuple(given.shots.split(","))
    names = [name for name in (*SAMPLES, *REAL) if name.startswith(wanted)]
    lines = []
    for level in map(int, given.levels.split(",")):
        for name in names:
            if found := measured(name, level, journal, given.device):
                lines.append(placed(name, level, found))
    head = ("shot", "level", "vertices", "gap", "ms", "fastest to that gap", "ratio")
    say(table(head, [line for line, _, _ in lines]))
    say("\n" + "\n".join(f"- {line[0]}, level {line[1]}: {known}" for line, _, known in lines))
    say(f"\non the front (up to {TOLERANCE:g}): {sum(on for _, on, _ in lines)} of {len(lines)}")


def measured(name: str, level: int, journal: Path, device: str) -> list[dict[str, Any]]:
    """All runs of a shot at a level; nothing where the shot is not there."""
    shot = open_one(name, level)
    if shot is None:
        return []
    known = [row for row in read(journal) if (row["shot"], row["level"]) == (name, level)]
    if not any(row["method"] == LEAST for row in known):
        time = SAMPLES[name] if name in SAMPLES else REAL[name][2]
        frame = plain_detail(shot.frame(time if time is not None else shot.scene.times[-1]))
        bench = Bench(shot, frame, {"shot": name, "level": level}, journal, device)
        known += bench.run({(row["method"], row["steps"]) for row in known})
    return known


def open_one(name: str, level: int) -> Shot | None:
    """A shot at a level, or None."""
    if name in SAMPLES:
        return opened(name, level)
    file = Path(os.environ.get("PHYSGRAPH_DATA", "../shared/data")) / "shots" / name
    garments, colliders, _ = REAL[name]
    return open_shot(str(file), garments=garments, colliders=colliders, level=level) if file.exists() else None


def read(journal: Path) -> Iterator[dict[str, Any]]:
    """The journal's whole lines."""
    for line in journal.read_text(encoding="utf-8").splitlines(keepends=True):
        if line.endswith("\n"):
            yield json.loads(line)


class Bench:
    """Runs the methods on one frame."""

    def __init__(self, shot: Shot, frame: Frame, about: dict[str, Any], journal: Path, device: str) -> None:
        """Build the problem in both precisions.

        Args:
            shot: The shot.
            frame: The frame.
            about: The shot's name and the level, for the rows.
            journal: Where rows go.
            device: Where to solve.
        """
        levels = [about["level"]] * len(shot.scene.garments)
        self._about, self._frame, self._journal = about, frame, journal
        self._timed = Problem(shot.scene, levels, device=device, threads=1, clock="cpu" if device == "cpu" else "wall")
        self._judge = Problem(shot.scene, levels, device="cpu", threads=1, dtype=torch.float64)
        self._rows: list[dict[str, Any]] = []

    def run(self, known: set[tuple[str, int]]) -> list[dict[str, Any]]:
        """Every method but what is known; Phi* last."""
        self._timed.solve(self._frame, COLD)
        start = self._judge.judge(self._frame, self._timed.upsampled(self._frame, smooth=False)).energy
        self._add(START, 0, ms=0.0, energy=start, vertices=self._timed.vertex_count)
        most = FAR * self._one(DEFAULT, COLD.steps, COLD)
        for method, ladder in STEPS.items():
            for steps in ladder:
                settings = replace(COLD, method=RIVALS[method], steps=steps, tolerance=0.0)
                if (method, steps) not in known and self._one(method, steps, settings) > most:
                    break
        found = find_reference(self._judge, self._frame, seconds=SECONDS, short=True)
        self._add(LEAST, 0, ms=0.0, energy=found.least, by=found.by, apart=found.apart)
        return self._rows

    def _one(self, method: str, steps: int, settings: Any) -> float:
        """Time a method; returns its milliseconds."""
        solved, spent = timed(lambda: self._timed.solve(self._frame, settings))
        energy = self._judge.judge(self._frame, solved.points).energy
        self._add(method, steps, ms=round(spent, 2), energy=energy)
        return spent

    def _add(self, method: str, steps: int, **values: Any) -> None:
        row = self._about | {"method": method, "steps": steps} | values
        with self._journal.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        self._rows.append(row)


def timed(solve: Callable[[], Solved]) -> tuple[Solved, float]:
    """A result and the least of its times [ms], taken as often whoever makes it."""
    solved = solve()
    spent = [solved.milliseconds]
    while len(spent) < TURNS and spent[0] < SLOW_MS:
        spent.append(solve().milliseconds)
    return solved, min(spent)


def placed(name: str, level: int, rows: Sequence[dict[str, Any]]) -> tuple[list[str], bool, Reference]:
    """Where the default stands: a line of the table, whether it is on the front, and what gaps are counted from."""
    start, least = (next(row for row in rows if row["method"] == method) for method in (START, LEAST))
    known = Reference(start["energy"], least["energy"], {}, least["by"], least["apart"])
    runs = [row for row in rows if row["method"] not in (START, LEAST)]
    for row in runs:
        known = known.lowered({"all": row["energy"]}, f"{row['method']}, {row['steps']} steps")
    curves: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for row in runs:
        curves[row["method"]].append((row["ms"], known.gap(row["energy"])))
    ms, gap = curves[DEFAULT][0]
    times = {method: time for method, points in curves.items() if (time := quickest(points, gap)) is not None}
    best = min(times, key=lambda method: times[method])
    ratio = ms / times[best]
    line = [name.partition(".")[0].partition("/")[0], f"{level}", f"{start['vertices']:,}", f"{gap:.2%}", f"{ms:.0f}"]
    return [*line, f"{best}, {times[best]:.0f} ms", f"{ratio:.2f}"], ratio <= TOLERANCE, known


if __name__ == "__main__":
    main()
