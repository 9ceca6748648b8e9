"""What contact leaves on blocks, tori, cloth and several garments, as rows.

Frames in a row of the samples about contact; the figures are those of `benchmarks.contact_shots`, which has them all.
Shape and energy are of the last of these frames, solved from cold, beside Loop subdivision of the same cage.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch

from benchmarks.contact_shots import SAMPLES, Sums, open_one, run
from benchmarks.rows import Row, under
from benchmarks.shots import frames_of, opened, problem_of
from physgraph_usd.lab.chart.problem import COLD, Problem
from physgraph_usd.solver.scene import Frame

FRAMES = {True: 2, False: 5}
"""Frames in a row, by whether the form is the short one."""
OBJECTS = ("block", "torus")
ITSELF = ("hood", "armpit")
SEVERAL = ("layers", "crossing")


def colliders(short: bool) -> list[Row]:
    """The block and the torus: penetration, Loop's potential, and the shape."""
    rows = []
    for name in OBJECTS:
        ours = run_of(name, short)
        rows += [
            under(f"{name}: deepest vertex", ours.deepest, 0.5, unit=" mm"),
            under(f"{name}: vertices over 0.1 mm inside", ours.percent, 0.0, unit=" %", paper="correct results"),
            fewer(f"{name}: crossings of cloth and body", ours.body, 0),
            *beside_loop(name, short),
        ]
    return rows


def itself(short: bool) -> list[Row]:
    """Cloth that touches itself: no new crossings."""
    return crossings(ITSELF, short)


def several(short: bool) -> list[Row]:
    """Garments that touch one another: no new crossings."""
    return crossings(SEVERAL, short)


def crossings(names: tuple[str, ...], short: bool) -> list[Row]:
    """Crossings of cloth and cloth in some samples."""
    rows = []
    for name in names:
        ours = run_of(name, short)
        rows.append(fewer(f"{name}: crossings of cloth and cloth", ours.cloth, ours.cloth[0]))
        if names is SEVERAL:
            rows.append(fewer(f"{name}: those of different garments", ours.between, ours.between[0]))
        rows.append(
            under(f"{name}: frames with more crossings than the input", ours.worse, 0, paper="no intersections")
        )
    return rows


def run_of(name: str, short: bool) -> Sums:
    """Frames in a row of a sample."""
    with tempfile.TemporaryDirectory() as folder:
        shot, first = open_one(name, Path(folder), None)
        first = min(first, len(shot.scene.times) - FRAMES[short])
        return run(shot, first, FRAMES[short], level=level_of(name, short))


def level_of(name: str, short: bool) -> int:
    """Subdivisions: one where several garments would take long."""
    return 1 if short and name in SEVERAL else 2


def fewer(what: str, pair: tuple[int, int], most: int) -> Row:
    """Crossings before and after that must not be over a number."""
    return Row(what, f"{pair[0]} -> {pair[1]}", "-", f"at most {most}", pair[1] <= most)


def beside_loop(name: str, short: bool) -> list[Row]:
    """Energy and curvature beside Loop subdivision, and how far the shape is from the cage's."""
    shot = opened(name, level_of(name, short))
    single, double = problem_of(shot), problem_of(shot, torch.float64)
    [frame] = frames_of(shot, [shot.scene.times[min(SAMPLES[name] + FRAMES[short], len(shot.scene.times)) - 1]])
    ours = single.solve(frame, COLD).points
    plain, loop = (single.upsampled(frame, smooth=smooth) for smooth in (False, True))
    energy = [double.judge(frame, points).energy for points in (ours, loop)]
    cage = float(single.refiner.groups[0].levels[0].spacing.mean())
    away = float(np.sqrt(np.square(ours[0] - plain[0]).sum(axis=1).mean())) / cage
    bends = [bending(double, frame, points) for points in (ours, loop)]
    return [
        Row(
            f"{name}: potential, Loop's",
            f"{1e3 * energy[0]:.3g} mJ, {1e3 * energy[1]:.3g} mJ",
            "adds detail",
            "less than Loop's",
            energy[0] < energy[1],
        ),
        Row(f"{name}: RMS curvature over Loop's", f"{(bends[0] / bends[1]) ** 0.5:.3g}", "adds detail"),
        under(f"{name}: RMS distance from the cage", away, 0.5, unit=" cage edges", paper="keeps the shape"),
    ]


def bending(problem: Problem, frame: Frame, points: tuple[np.ndarray, ...]) -> float:
    """Bending energy [J], which is the square of curvature."""
    return problem.judge(frame, points).energies["bending"]
