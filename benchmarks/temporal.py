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
from pathlib import Path

import numpy as np

from benchmarks.sleeve import CORES, say
from physgraph_usd.mesh.subdivide import Refinement
from physgraph_usd.options import RefineOptions
from physgraph_usd.pipeline import Refiner
from physgraph_usd.samples import write_sample
from physgraph_usd.shot import prepare_device
from physgraph_usd.usd.reader import Shot, open_shot

FRAMES = 24
LEVELS = {"layers": 1}
"""Subdivisions of samples that would take long at their own."""
RUNS = (("off", 0.0), ("warm", 0.0), ("tether", 400.0), ("tether", 2000.0), ("tether", 10000.0))


def main() -> None:
    """Print a row per sample and way of using the last frame."""
    prepare_device("cpu")
    say("| sample | temporal | tether [1/s^2] | jerk [edges] | energy [J] |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name in sys.argv[1:] or ("sleeve", "skirt", "flag", "layers"):
            shot = open_shot(write_sample(name, Path(folder)), level=LEVELS.get(name))
            for temporal, stiffness in RUNS:
                jerk, energy = measure(shot, temporal, stiffness)
                say(f"| {name} | {temporal} | {stiffness:g} | {jerk:.3f} | {energy:.5f} |")


def measure(shot: Shot, temporal: str, stiffness: float) -> tuple[float, float]:
    """Jerk of the detail [mean fine edges] and mean energy [J] of a shot's first frames."""
    settings = replace(RefineOptions(temporal=temporal).solve_settings(), tether=stiffness)
    refiner = Refiner(shot.scene, settings, lanes=CORES)
    details, energies = [], []
    for time in shot.scene.times[:FRAMES]:
        frame = shot.frame(time)
        state = refiner.solve(frame)
        smooth = [
            upsampled(chain, each.points) for chain, each in zip(refiner.refinements, frame.garments, strict=True)
        ]
        details.append(np.concatenate([np.asarray(p) for p in state.points]) - np.concatenate(smooth))
        entry = state.telemetry[0]
        if "energy_joules" in entry:
            energies.append(sum(entry["energy_joules"]["output"].values()))  # type: ignore[index]
    jerk: np.ndarray = np.diff(np.asarray(details, dtype=np.float64), 3, axis=0)
    edges = np.mean([mean_fine_edge(refiner, index) for index in range(len(shot.scene.garments))])
    return float(np.sqrt((jerk**2).sum(axis=-1).mean()) / edges), float(np.mean(energies))


def upsampled(chain: Sequence[Refinement], points: np.ndarray) -> np.ndarray:
    """The cage placed linearly at the finest vertices [m]."""
    for refinement in chain:
        points = refinement.linear @ points
    return points


def mean_fine_edge(refiner: Refiner, index: int) -> float:
    """Mean rest length of a garment's finest edges [m]."""
    return float(refiner.groups[index].levels[-1].spacing.mean())


if __name__ == "__main__":
    main()
