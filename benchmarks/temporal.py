"""How still the detail is from frame to frame, and what stillness costs in energy.

    python -m benchmarks.temporal [SAMPLE...]

The detail is the fine cloth minus the upsampled cage; its jerk is the RMS of its third difference over 24 frames, in
mean fine edges. Energies are means over the frames, without the tether's own.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, say, under
from benchmarks.shots import CORES, opened
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.scene import Frame
from physgraph_usd.usd.read.reader import Shot, open_shot

FRAMES = 24
LEVELS = {"layers": 1}
"""Subdivisions of samples that would take long at their own."""
RUNS = (("off", 0.0), ("warm", 0.0), ("tether", 0.7), ("tether", 3.5), ("tether", 17.5))


def main() -> None:
    """Print a row per sample and way of using the last frame."""
    prepare_device("cpu")
    say("| sample | temporal | tether [m/dt^2] | jerk [edges] | energy [J] |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name in sys.argv[1:] or ("sleeve", "skirt", "flag", "layers"):
            shot = open_shot(write_sample(name, Path(folder)), level=LEVELS.get(name))
            for temporal, stiffness in RUNS:
                jerk, energy = measure(shot, temporal, stiffness)
                say(f"| {name} | {temporal} | {stiffness:g} | {jerk:.3f} | {energy:.5f} |")


def rows(short: bool) -> list[Row]:
    """Jerk with what a frame takes over from the last one against each by itself; and equal frames."""
    found = []
    for name, garments, level in (("sleeve", (), 2), ("layers", ("*/Trousers",) if short else (), 1)):
        shot = opened(name, level, garments)
        runs = {each: measure(shot, each, 3.5) for each in ("off", "tether")}
        ratio = runs["tether"][0] / runs["off"][0]
        paper = "mostly coherent"
        found.append(under(f"{name}: jerk of the detail over that of frames by themselves", ratio, 0.5, paper=paper))
    equal, every = frozen()
    what = "frozen: frames equal to the first, to the bit"
    return [*found, Row(what, f"{equal} of {every}", "-", "all", equal == every)]


def frozen() -> tuple[int, int]:
    """Frames of a still shot that are the first one's bytes, and all of its frames."""
    shot = opened("frozen", 1)
    refiner = Refiner(shot.scene, RefineOptions().solve_settings(), threads=CORES)
    states = [np.asarray(refiner.solve(shot.frame(time)).garments[0].points).tobytes() for time in shot.scene.times]
    return sum(state == states[0] for state in states), len(states)


def measure(shot: Shot, temporal: str, stiffness: float) -> tuple[float, float]:
    """Jerk of the detail [mean fine edges] and mean energy [J] of a shot's first frames."""
    settings = replace(RefineOptions(temporal=temporal).solve_settings(), tether=stiffness)
    refiner = Refiner(shot.scene, settings, threads=CORES)
    details, energies = [], []
    for time in shot.scene.times[:FRAMES]:
        frame = shot.frame(time)
        garments = refiner.solve(frame).garments
        details.append(detail_of(refiner, frame, [garment.points for garment in garments]))
        entry = garments[0].telemetry
        if "energy_joules" in entry:
            energies.append(sum(entry["energy_joules"]["output"].values()))
    jerk: np.ndarray = np.diff(np.asarray(details, dtype=np.float64), 3, axis=0)
    edges = np.mean([mean_fine_edge(refiner, index) for index in range(len(shot.scene.garments))])
    return float(np.sqrt((jerk**2).sum(axis=-1).mean()) / edges), float(np.mean(energies))


def detail_of(refiner: Refiner, frame: Frame, points: Sequence[np.ndarray | None]) -> np.ndarray:
    """Fine positions off the upsampled cages [m], shape (vertices, 3); nan for a garment that has none."""
    smooth = [
        reduce(lambda x, step: step.linear @ x, chain, each.points)
        for chain, each in zip(refiner.refinements, frame.garments, strict=True)
    ]
    parts = zip(points, smooth, strict=True)
    return np.concatenate([np.full_like(base, np.nan) if own is None else own - base for own, base in parts])


def mean_fine_edge(refiner: Refiner, index: int) -> float:
    """Mean rest length of a garment's finest edges [m]."""
    return float(refiner.groups[index].levels[-1].spacing.mean())


if __name__ == "__main__":
    main()
