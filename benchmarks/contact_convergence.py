"""Steps to a gap with contact and without it.

    python -m benchmarks.contact_convergence [SAMPLE ...]

Refines frames of samples from cold with ever more steps, with contact and without, and prints the gap
(Phi - Phi*) / (Phi0 - Phi*) of each garment and of all, over the frames together. Phi holds the contact energy of
planes and pairs found anew at the result, what newly crosses mended, nothing pushed out of bodies; that of a pair
counts for the garment of its first corner. Phi* is the least energy known: that of many steps in many rounds in
float64, and of the reference solver, Newton, that goes on from there. A column says how far Newton came below. Where
cloth folds in many ways each run ends at a minimum of its own: the last column is the gap, after twice the steps that
all garments together need without contact, to where that run itself settles.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.sleeve import CORES, say
from physgraph_usd.lab.chart.problem import Problem
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.refine import prepare_device
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.integrate import method_named
from physgraph_usd.solver.scene import Frame
from physgraph_usd.usd.read.reader import Shot, open_shot

SAMPLES = {"block": (12.0,), "armpit": (15.0,), "layers": (5.0, 8.0, 11.0, 14.0, 17.0, 20.0), "sleeve": (24.0,)}
"""Time codes of each: several where what it ends at differs from frame to frame."""
STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 36)
"""Steps at the finest level; four times as many below."""
GAP = 0.03
LEVEL = 1
LONG, SHORT = (600, 30), (100, 10)
"""Steps and rounds of the solve that gives Phi*. Where much cloth touches cloth each round has so many steps, and the
long solve takes hours."""
SETTLED = {"layers": SHORT}
"""Samples with other than the long one."""
NEWTON = (3, 6)
"""Newton steps of each round from there, and rounds."""


def main() -> None:
    """Print a row per sample, garment and kind of contact."""
    prepare_device("cpu")
    say(
        "| garment | contact | " + " | ".join(f"{steps}" for steps in STEPS) + " | steps to 3% | Newton below "
        "| at twice the steps, to its own |"
    )
    say("|---" * (len(STEPS) + 5) + "|")
    with tempfile.TemporaryDirectory() as folder:
        for name, times in SAMPLES.items():
            if sys.argv[1:] and name not in sys.argv[1:]:
                continue
            shot = open_shot(str(write_sample(name, Path(folder))))
            twice = None
            for label, contact in (("off", ContactSettings("off", cloth="off")), ("on", ContactSettings())):
                settled_in = SETTLED.get(name, LONG)
                found = [energies_of(shot, shot.frame(t), contact, settled_in=settled_in, twice=twice) for t in times]
                gaps, below, own = gaps_of(with_all(np.array(found)))
                needed = [next((n for n, gap in zip(STEPS, each, strict=True) if gap <= GAP), None) for each in gaps.T]
                names = [*(Path(garment.path).name for garment in shot.scene.garments), "all"][: len(needed)]
                for garment, each, steps, newton, last in zip(names, gaps.T, needed, below, own, strict=True):
                    cells = " | ".join(f"{gap:.1%}" for gap in each)
                    settled = "-" if twice is None else f"{twice}: {last:.1%}"
                    say(f"| {name}: {garment} | {label} | {cells} | {steps} | {newton:.2%} | {settled} |")
                twice = None if needed[-1] is None else 2 * needed[-1]


def with_all(energies: np.ndarray) -> np.ndarray:
    """Energies with those of all garments together after the others, where there are several."""
    if energies.shape[2] == 1:
        return energies
    return np.concatenate([energies, energies.sum(axis=2, keepdims=True)], axis=2)


def gaps_of(energies: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gaps of each garment, how far Newton came below the long solve, and gaps to a run's own end; all frames together.

    Args:
        energies: As `energies_of` gives them [J], shape (frames, runs, garments).

    Returns:
        Shapes (steps, garments), (garments,) and (garments,).
    """
    start, settled, newton, ended, own, *rough = energies.sum(axis=0)
    least = energies[:, 1:].min(axis=1).sum(axis=0)
    return (
        (np.array(rough) - least) / (start - least),
        (settled - newton) / (start - least),
        (ended - own) / (start - own),
    )


def energies_of(
    shot: Shot, frame: Frame, contact: ContactSettings, *, settled_in: tuple[int, int], twice: int | None
) -> list[np.ndarray]:
    """Energies [J] of the garments in a frame.

    Args:
        shot: The shot.
        frame: The frame.
        contact: How contact is solved.
        settled_in: Steps and rounds of the long solve.
        twice: Steps of the run that goes on to its own end, or None for none.

    Returns:
        Upsampled, after the long solve, after Newton, after so many steps, where these settle (without such a run the
        long solve, twice), and after each number of steps.
    """
    coarse, exact = (problem_of(shot, dtype) for dtype in (torch.float32, torch.float64))
    for problem in (coarse, exact):
        problem.refiner.use(settings_of(contact, 1))
    nothing = [None] * len(coarse.refiner.parts_of(frame))
    steps, rounds = settled_in
    settled, kept = exact.go_on(frame, settings_of(replace(contact, rounds=rounds), steps), nothing)
    steps, rounds = NEWTON
    newton, _ = exact.go_on(frame, settings_of(replace(contact, rounds=rounds), steps, method="newton"), kept)
    ended = own = settled
    if twice is not None:
        ended, kept = coarse.go_on(frame, settings_of(contact, twice), nothing)
        steps, rounds = settled_in
        own, _ = coarse.go_on(frame, settings_of(replace(contact, rounds=rounds), steps), kept)
    rough = [coarse.go_on(frame, settings_of(contact, steps), nothing)[0] for steps in STEPS]
    results = (exact.upsampled(frame, smooth=False), settled, newton, ended, own, *rough)
    return [energies_at(exact, frame, points, contact=contact) for points in results]


def problem_of(shot: Shot, dtype: torch.dtype) -> Problem:
    """A shot's levels in one precision."""
    return Problem(shot.scene, [LEVEL] * len(shot.scene.garments), device="cpu", lanes=CORES, dtype=dtype)


def settings_of(contact: ContactSettings, steps: int, *, method: str = "quasi-newton") -> SolveSettings:
    """A solve of a number of steps, nothing pushed out afterwards."""
    contact = replace(contact, projections=0, lifts=0)
    return SolveSettings(method_named(method), steps=steps, tolerance=0.0, contact=contact)


def energies_at(
    problem: Problem, frame: Frame, points: Sequence[np.ndarray], *, contact: ContactSettings
) -> np.ndarray:
    """Energy of each garment [J] at world positions [m], what touches there found anew, shape (garments,)."""
    problem.refiner.use(settings_of(contact, 1))
    out = np.zeros(len(points))
    for part in problem.refiner.parts_of(frame):
        frames, group = [frame.garments[index] for index in part], problem.refiner.group_of(part)
        module, touching, origin = group.potential(frames, problem.refiner.touching(part, frame))
        level = group.levels[-1]
        x = torch.as_tensor(np.concatenate([points[index] for index in part]) - origin, dtype=level.dtype)
        terms = () if touching is None else touching.at(level).terms(x)
        out[list(part)], _ = ForceModule((*module.forces, *terms)).energy_and_force_each(x, len(part))
    return out


if __name__ == "__main__":
    main()
