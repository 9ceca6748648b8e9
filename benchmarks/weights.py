"""Whole frames by weights of the network: energy, time, jumps and crossings over those of the first file.

    python -m benchmarks.weights FIRST.safetensors OTHER.safetensors... [--folder SHOTS] [--levels 1,2] [--shots ...]
        [--jobs 16] [--journal FILE]

The shots, levels and frames of `benchmarks.whole_frames`, each in a process of its own on one core: a cold frame and
those that follow it, by the default method with the steps it makes by itself, the network's weights from each file in
turn. Prints a row a shot, level and kind of frame, and the geometric means of the ratios; a run is higher or lower by
more than 2%, or level. What was measured lies in the journal, build/weights.jsonl unless it is named.
"""

from __future__ import annotations

import math
import os
import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from benchmarks.rows import say, table
from benchmarks.whole_frames import Bench, cases_of, energy, milliseconds, open_one, read, run_all
from physgraph_usd.lab.chart.problem import DEFAULT, plain_detail
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.integrate import method_named

SAME = 0.02
"""Difference of energies up to which a run is level with the first file's."""


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--folder", type=click.Path(path_type=Path), help="The real shots, which we may not ship.")
@click.option("--levels", default="1,2", show_default=True)
@click.option("--shots", default="", help="Names, or their beginnings; all where none are given.")
@click.option("--jobs", default=os.cpu_count() or 1, show_default=True, help="Processes side by side, a core each.")
@click.option("--journal", type=click.Path(path_type=Path), default=Path("build/weights.jsonl"), show_default=True)
@click.option("--one", default="", hidden=True)
def main(
    files: Sequence[Path], folder: Path | None, levels: str, shots: str, jobs: int, journal: Path, one: str
) -> None:
    """Measure what is not known and print the table."""
    if one:
        name, level = one.rsplit(":", 1)
        return measure(name, int(level), folder, files)
    journal.parent.mkdir(parents=True, exist_ok=True)
    journal.touch()
    known = {(row["shot"], row["level"]) for row in read(journal)}
    cases = [each for each in cases_of(levels, shots, folder) if each not in known]
    options = [*map(str, files), *(["--folder", str(folder)] if folder else [])]
    run_all(cases, options, journal, jobs, program="benchmarks.weights")
    report(list(read(journal)), [str(file) for file in files])


def measure(name: str, level: int, folder: Path | None, files: Sequence[Path]) -> None:
    """Write the rows of one shot at one level to standard output."""
    prepare_device("cpu")
    shot, first, more = open_one(name, level, folder)
    bench = Bench(shot, level, "cpu", {"shot": name, "level": level})
    times = shot.scene.times
    first = min(first, max(len(times) - 1 - more, 0))
    frames = [plain_detail(shot.frame(each)) for each in times[first : first + 1 + more]]
    bench.run("", 0, DEFAULT, frames[:1])  # Loads the kernels and factors the metrics.
    for file in files:
        settings = replace(DEFAULT, method=method_named("physgraph", file))
        bench.run(str(file), DEFAULT.steps, settings, frames)


def report(rows: Sequence[dict[str, Any]], files: Sequence[str]) -> None:
    """Print the table and the means."""
    runs: dict[tuple[str, int, str], dict[str, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        runs[row["shot"], row["level"], "warm" if row["number"] else "cold"][row["method"]].append(row)
    names = [Path(file).stem for file in files]
    lines: list[list[Any]] = []
    for (shot, level, kind), run in sorted(runs.items(), key=lambda each: (each[0][2], each[0][1])):
        stem = Path(shot).parts[0].partition(".")[0] if "." in shot else shot
        lines.append([stem, level, kind, *(cell(run[file]) for file in files)])
    say(table(("shot", "level", "", *names), lines))
    say("\nin brackets: crossings of cloth and cloth, of cloth and bodies, frames unsettled, jumps\n")
    for kind in ("cold", "warm"):
        own = [run for (_, _, each), run in runs.items() if each == kind]
        for file, name in zip(files[1:], names[1:], strict=True):
            say(f"{kind}, {name} over {names[0]}: {compared([(run[files[0]], run[file]) for run in own])}")
    for file, name in zip(files, names, strict=True):
        totals = [sum(row[what] for row in rows if row["method"] == file) for what in ("cloth", "body", "jumps")]
        say(f"{name}: {totals[0]} crossings of cloth and cloth, {totals[1]} of cloth and bodies, {totals[2]} jumps")


def cell(run: Sequence[dict[str, Any]]) -> str:
    """Time, energy and what is left of a run's frames."""
    left = [sum(row[what] for row in run) for what in ("cloth", "body", "unsettled", "jumps")]
    return f"{milliseconds(run):.0f} ms, {energy(run):.4g} J, {left}"


def compared(pairs: Sequence[tuple[Sequence[dict[str, Any]], Sequence[dict[str, Any]]]]) -> str:
    """Geometric means of the ratios of energies and of times, and how many runs are higher and lower."""
    energies = [energy(after) / energy(before) for before, after in pairs if energy(before) > 0.0]
    times = [milliseconds(after) / milliseconds(before) for before, after in pairs]
    higher, lower = sum(each > 1.0 + SAME for each in energies), sum(each < 1.0 - SAME for each in energies)
    means = [math.exp(statistics.fmean(map(math.log, each))) for each in (energies, times)]
    return f"energy {means[0]:.3f}, time {means[1]:.2f}; higher {higher}, lower {lower} of {len(energies)}"


if __name__ == "__main__":
    main()
