"""The paper's skinning figure: what of a skinned shirt's faults is left after refinement.

Two samples: `armpit`, a shirt pinched between side and hanging arm, and `tshirt`, by linear-blend skinning with one arm
raised. "Before" is the input, upsampled. A face is turned over where its normal looks away from the mean normal of the
faces around its corners, weighed by area; the elastic energy is that of springs and hinges in the sample's own fabric.
"""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import torch

from benchmarks.rows import Row
from benchmarks.shots import frames_of, opened, problem_of
from physgraph_usd.lab.chart.problem import COLD, Problem
from physgraph_usd.solver.scene import Frame

POSES = {"armpit": 15.0, "tshirt": 36.0}
LEVEL = {True: 2, False: 3}
"""Subdivisions, by whether the form is the short one."""
TITLES = {
    "elastic": "springs and hinges [mJ]",
    "strain": "strain, 99th percentile [%]",
    "turned": "faces turned over",
    "tangles": "crossings of cloth and cloth",
    "crossings": "crossings of cloth and body",
    "inside": "vertices inside the body",
}
MUST = {"turned": 0.0, "tangles": 0.0, "crossings": 0.0, "inside": 0.0}
"""What was to be left."""


def measure(short: bool) -> list[Row]:
    """The rows of both shirts."""
    rows = []
    for name, time in POSES.items():
        shot = opened(name, LEVEL[short])
        single, double = problem_of(shot), problem_of(shot, torch.float64)
        [frame] = frames_of(shot, [time])
        before = faults(double, frame, single.upsampled(frame, smooth=False)[0])
        after = faults(double, frame, single.solve(frame, COLD).points[0])
        for key, title in TITLES.items():
            ours = f"{before[key]:.3g} -> {after[key]:.3g}"
            target, met = "falls", after[key] <= before[key]
            if key in MUST:
                target, met = f"{MUST[key]:g}", after[key] <= MUST[key]
            rows.append(Row(f"{name}: {title}", ours, "artefact removed" if key == "turned" else "-", target, met))
    return rows


def faults(problem: Problem, frame: Frame, points: np.ndarray) -> dict[str, float]:
    """The figures of one result."""
    found = problem.judge(frame, [points])
    energies, level = found.energies, problem.refiner.groups[0].levels[-1]
    return {
        "elastic": 1e3 * (energies.get("stretch", 0.0) + energies["bending"]),
        "strain": 100.0 * found.strain,
        "turned": turned_over(points, level.triangles.cpu().numpy()),
        **{key: float(asdict(found)[key]) for key in ("tangles", "crossings", "inside")},
    }


def turned_over(points: np.ndarray, triangles: np.ndarray) -> int:
    """Faces whose normal looks away from the mean normal around their corners.

    Args:
        points: Positions, shape (V, 3).
        triangles: Corners, shape (T, 3).
    """
    corners = points[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    around = np.zeros_like(points)
    for corner in triangles.T:
        np.add.at(around, corner, normal)
    return int(((around[triangles].sum(axis=1) * normal).sum(axis=1) < 0.0).sum())
