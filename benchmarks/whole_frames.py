"""Energy against time of both integrators, cold and warm, shot by shot and level by level.

    python -m benchmarks.whole_frames [FOLDER] [--levels 1,2] [--shots flag,10_style3d] [--device cuda] [--jobs 16]
        [--seconds 300] [--journal FILE]

FOLDER holds the real shots, which we may not ship. Each shot at each level is measured in a process of its own, on one
core, `--jobs` of them side by side. Cold: a few frames, each by itself, by quasi-Newton and by `physgraph`, through the
levels and at the finest alone, with growing steps. Warm: frames in a row with each integrator from its own cold frame
on. Time is of solving (on the CPU one core's processor time, on CUDA the wall's), its median over the frames; energy
is their mean, judged anew at the positions returned, contact included.

A ratio is a method's time over the least time of any method to the same energy; up to 1.1 counts as level. What was
measured lies in the journal, build/whole_frames.DEVICE.jsonl unless it is named: what is there is not measured again,
and `--jobs 0` prints its table.
"""

from __future__ import annotations

import json
import os
import queue
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.contact_shots import jumps
from benchmarks.rows import say, table
from benchmarks.shots import opened
from benchmarks.temporal import detail_of
from physgraph_usd.lab.chart.problem import DEFAULT, judge, plain_detail
from physgraph_usd.lab.methods import METHODS
from physgraph_usd.shot.settled import unsettled
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.scene import Frame
from physgraph_usd.usd.read.reader import Shot, open_shot

SHIRT = (("/shot/shirt",), ("/shot/body",))
SHOTS: dict[str, tuple[Sequence[str], Sequence[str], int, int]] = {
    "sleeve": ((), (), 12, 6),
    "01_newton_shirt_dab_cm.usdc": (("/shot/char/shirt_geo",), ("/shot/char/body_geo",), 30, 6),
    "skirt": ((), (), 20, 6),
    "10_style3d_skirt_twist.usdc": (("/shot/skirt",), ("/shot/avatar",), 0, 10),
    "tshirt": ((), (), 18, 6),
    "09_cesiumman_kilt/shot.usda": (("/shot/kilt",), ("/shot/CesiumMan",), 24, 8),
    "layers": ((), (), 6, 3),
    "02_makehuman_usdskel_dm.usdc": (("/shot/char/top", "/shot/char/shorts"), ("/shot/char/body",), 20, 3),
    "hood": ((), (), 9, 6),
    "04_tiered_dress_kick_zup.usdc": (("/shot/tiered_dress",), ("/shot/mannequin",), 0, 2),
    "torus": ((), (), 16, 6),
    "06_torus_pull.usda": (("/shot/cloth",), ("/shot/torus",), 36, 6),
    "block": ((), (), 8, 6),
    "07_flag_quads_nocollider.usda": (("/shot/flag",), (), 24, 6),
    "crossing": ((), (), 1, 6),
    "08_sphere_spin_xformcollider.usdc": (("/shot/set/cloth",), ("/shot/set/rig/sphere",), 30, 6),
    "armpit": ((), (), 12, 6),
    "12_variants/d_mixed_quads_tris.usdc": (*SHIRT, 2, 6),
    "flag": ((), (), 24, 6),
    "12_variants/e_sparse_samples.usdc": (*SHIRT, 0, 3),
    "swatch": ((), (), 12, 6),
    "12_variants/c_zup_cm.usdc": (*SHIRT, 2, 6),
    "dancer": ((), (), 20, 6),
}
"""Shots: garments, bodies, the number of the first frame and how many follow it."""
COARSE = ("04_tiered_dress_kick_zup.usdc",)
"""Those that take too long at more than one subdivision."""
STEPS = (12, 6, 24, 3)
"""Steps of the finest level; alone it takes `LONGER` times as many."""
LONGER = {"cpu": 4, "cuda": 8}
"""How many times as many steps the finest level takes alone, by device."""
COLD_AFTER = (0, 3)
"""Frames after the first that are solved cold."""
LEVEL_WITH = 1.1
SECONDS = 300.0


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option("--levels", default="1,2", show_default=True)
@click.option("--shots", default="", help="Names, or their beginnings; all where none are given.")
@click.option("--device", default="cpu", show_default=True)
@click.option("--jobs", default=os.cpu_count() or 1, show_default=True, help="Processes side by side, a core each.")
@click.option("--seconds", default=SECONDS, show_default=True, help="Time after which a shot takes no more methods.")
@click.option("--journal", type=click.Path(path_type=Path))
@click.option("--one", default="", hidden=True)
def main(
    folder: Path | None,
    levels: str,
    shots: str,
    device: str,
    jobs: int,
    seconds: float,
    journal: Path | None,
    one: str,
) -> None:
    """Measure what is not known and print the table."""
    if one:
        name, level = one.rsplit(":", 1)
        return measure(name, int(level), folder, device, seconds)
    journal = journal or Path("build") / f"whole_frames.{device.partition(':')[0]}.jsonl"
    journal.parent.mkdir(parents=True, exist_ok=True)
    journal.touch()
    known = {(row["shot"], row["level"]) for row in read(journal)}
    cases = cases_of(levels, shots, folder)
    options = [*([str(folder)] if folder else []), "--device", device, "--seconds", str(seconds)]
    run_all([each for each in cases if each not in known], options, journal, jobs)
    report(list(read(journal)))


def cases_of(levels: str, shots: str, folder: Path | None) -> list[tuple[str, int]]:
    """Shots that begin with one of the names and can be opened, each with its levels, the finest first."""
    names = [each for each in SHOTS if each.startswith(tuple(shots.split(","))) and is_there(each, folder)]
    order = sorted(map(int, levels.split(",")), reverse=True)
    return [(each, level) for level in order for each in names if level < 2 or each not in COARSE]


def is_there(name: str, folder: Path | None) -> bool:
    """Whether a shot can be opened."""
    return "." not in name or (folder is not None and (folder / name).exists())


def run_all(
    cases: Sequence[tuple[str, int]],
    options: Sequence[str],
    journal: Path,
    jobs: int,
    *,
    program: str = "benchmarks.whole_frames",
) -> None:
    """Measure cases side by side, each on a core of its own; their rows go to the journal as they come."""
    cores: queue.Queue[int] = queue.Queue()
    for core in sorted(os.sched_getaffinity(0))[:jobs]:
        cores.put(core)

    def run(case: tuple[str, int]) -> None:
        core = cores.get()
        command = ["taskset", "-c", str(core), sys.executable, "-m", program, *options]
        with journal.open("a", encoding="utf-8") as file:
            done = subprocess.run(
                [*command, "--one", f"{case[0]}:{case[1]}"],
                env=os.environ | {"OMP_NUM_THREADS": "1"},
                stdout=file,
                stderr=subprocess.PIPE,
                text=True,
                check=False,
            )
        cores.put(core)
        if done.returncode:
            sys.stderr.write(f"{case[0]}, level {case[1]}: {done.stderr[-800:]}\n")

    if jobs:
        with ThreadPoolExecutor(jobs) as pool:
            list(pool.map(run, cases))


def read(journal: Path) -> Iterator[dict[str, Any]]:
    """The journal's whole lines."""
    for line in journal.read_text(encoding="utf-8").splitlines(keepends=True):
        if line.endswith("\n"):
            yield json.loads(line)


def ways(device: str) -> Iterator[tuple[str, int, SolveSettings]]:
    """Every method by its name with its steps over the finest level's, those that tell most first."""
    more = LONGER[device.partition(":")[0]]
    for steps in STEPS:
        if steps == DEFAULT.steps:
            yield "physgraph", steps, DEFAULT
        for name in ("quasi-newton", "physgraph"):
            method = METHODS[name]
            yield name, steps, replace(DEFAULT, method=method, steps=steps)
            flat = replace(method, nested=False)
            yield f"{name}-flat", steps, replace(DEFAULT, method=flat, steps=more * steps)


def measure(name: str, level: int, folder: Path | None, device: str, seconds: float) -> None:
    """Write the rows of one shot at one level to standard output."""
    prepare_device(device)
    began, (shot, first, more) = time.perf_counter(), open_one(name, level, folder)
    bench = Bench(shot, level, device, {"shot": name, "level": level, "device": device.partition(":")[0]})
    times = shot.scene.times
    first = min(first, max(len(times) - 1 - more, 0))
    in_a_row = [plain_detail(shot.frame(each)) for each in times[first : first + 1 + more]]
    bench.run("", 0, DEFAULT, in_a_row[:1])  # Loads the kernels and factors the metrics.
    for method, steps, settings in ways(device):
        if time.perf_counter() - began > seconds:
            break
        if not method.endswith("-flat"):
            bench.run(method, steps, settings, in_a_row)
        cold = COLD_AFTER[not method.endswith("-flat") :]
        bench.run(method, steps, settings, *([in_a_row[k]] for k in cold if k < len(in_a_row)))


def open_one(name: str, level: int, folder: Path | None) -> tuple[Shot, int, int]:
    """A shot at a level, the number of its first frame and how many follow."""
    garments, colliders, first, more = SHOTS[name]
    if "." not in name:
        return opened(name, level), first, more
    assert folder is not None
    return open_shot(str(folder / name), garments=garments, colliders=colliders, level=level), first, more


class Bench:
    """Runs methods on frames of one shot."""

    def __init__(self, shot: Shot, level: int, device: str, about: dict[str, Any]) -> None:
        """Build the levels."""
        self._about = about
        self._clock = time.process_time if device == "cpu" else time.perf_counter
        levels = [level] * len(shot.scene.garments)
        self._refiner = Refiner(shot.scene, DEFAULT, levels=levels, device=device, threads=1)

    def run(self, method: str, steps: int, settings: SolveSettings, *rows: Sequence[Frame]) -> None:
        """Solve frames in a row, each row from a cold start, and write a row for each frame; none without a method."""
        for frames in rows:
            self._refiner.use(settings)
            solved, details = [self._solved(frame) for frame in frames], list[np.ndarray]()
            for number, (frame, (state, spent)) in enumerate(zip(frames, solved, strict=True)):
                points = [each for each in state.points if each is not None]
                found = judge(self._refiner, frame, points)
                details.append(detail_of(self._refiner, frame, state.points))
                row = self._about | {"method": method, "steps": steps, "time": frame.time, "number": number}
                row |= {"ms": round(spent, 3), "energy": found.energy, "body": found.crossings, "cloth": found.tangles}
                row |= {"inside": found.inside, "jumps": jumps(np.array(details[-3:]))}
                row["unsettled"] = sum(unsettled(each, DEFAULT.tolerance) is not None for each in state.telemetry)
                row["vertices"] = sum(map(len, points))
                row["made"] = made(state.telemetry)
                if method:
                    say(json.dumps(row))

    def _solved(self, frame: Frame) -> tuple[Any, float]:
        """A frame's state and its time of solving [ms]."""
        wall, began = time.perf_counter(), self._clock()
        state = self._refiner.solve(frame)
        busy = (self._clock() - began) / (time.perf_counter() - wall)
        entries: list[Any] = list({id(each["levels"]): each for each in state.telemetry if "levels" in each}.values())
        spent = sum(each["milliseconds"]["solve"] for each in entries)
        return state, busy * spent


def made(telemetry: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """How many steps each mover made."""
    movers: dict[str, int] = defaultdict(int)
    for entry in {id(each["levels"]): each for each in telemetry if "levels" in each}.values():
        for report in entry["levels"]:
            for mover, count in report["movers"].items():
                movers[mover] += count
    return dict(movers)


def report(rows: Sequence[dict[str, Any]]) -> None:
    """Print a table of ratios, time and energy at the default's steps, and how many of them count as level."""
    found: dict[tuple[str, int, str], dict[tuple[str, int], list[dict[str, Any]]]] = {}
    for row in rows:
        case = found.setdefault((row["shot"], row["level"], "warm" if row["number"] else "cold"), {})
        case.setdefault((row["method"], row["steps"]), []).append(row)
    names = ("physgraph", *dict.fromkeys(row["method"] for row in rows if row["method"] != "physgraph"))
    lines, ratios = [], defaultdict(list)
    for (shot, level, kind), runs in sorted(found.items(), key=lambda each: (each[0][2], each[0][1])):
        whole = {key: run for key, run in runs.items() if len(run) == max(map(len, runs.values()))}
        cells = []
        for name in names:
            if run := whole.get((name, DEFAULT.steps)):
                ratio = ratio_of(run, whole)
                ratios[kind, name].append(ratio)
                left = [sum(row[what] for row in run) for what in ("cloth", "body", "unsettled", "jumps")]
                cells.append(f"{ratio:.2f}: {milliseconds(run):.0f} ms, {energy(run):.4g} J, {left}")
            else:
                cells.append("-")
        lines.append([Path(shot).parts[0].partition(".")[0] if "." in shot else shot, level, kind, *cells])
    say(table(("shot", "level", "", *names), lines))
    say("\nin brackets: crossings of cloth and cloth, of cloth and bodies, frames unsettled, jumps\n")
    level_with = {key: f"{sum(each <= LEVEL_WITH for each in own)} of {len(own)}" for key, own in ratios.items()}
    say(table(("", *names), [[k, *(level_with.get((k, name), "-") for name in names)] for k in ("cold", "warm")]))


def ratio_of(run: Sequence[dict[str, Any]], runs: Mapping[tuple[str, int], Sequence[dict[str, Any]]]) -> float:
    """A run's time over the least of any named method to its energy; 1 where none gets there."""
    times = [milliseconds(run)]
    for name in {method for method, _ in runs} - {"physgraph"}:
        points = [(milliseconds(own), energy(own)) for (method, _), own in runs.items() if method == name]
        times += [time] if (time := time_to(points, energy(run))) is not None else []
    return milliseconds(run) / min(times) if min(times) > 0.0 else 1.0


def time_to(points: Sequence[tuple[float, float]], wanted: float) -> float | None:
    """Time in which a method's runs, of which these are times and energies, come to an energy; None if never.

    Between two runs its logarithm is linear in the energy.
    """
    best: list[tuple[float, float]] = []
    for point in sorted(points):
        if not best or point[1] < best[-1][1]:
            best.append(point)
    if best and best[0][1] <= wanted:
        return best[0][0]
    for (less, above), (more, below) in pairwise(best):
        if below <= wanted:
            return less * (more / less) ** ((above - wanted) / (above - below))
    return None


def milliseconds(run: Sequence[dict[str, Any]]) -> float:
    """Median time of a run's frames."""
    return statistics.median(row["ms"] for row in run)


def energy(run: Sequence[dict[str, Any]]) -> float:
    """Mean energy of a run's frames [J]."""
    return statistics.fmean(row["energy"] for row in run)


if __name__ == "__main__":
    main()
