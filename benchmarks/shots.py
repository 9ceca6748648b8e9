"""Sample shots opened for a benchmark, and what of contact is measured beside the report's own figures."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from physgraph_usd.lab.chart.problem import Problem, plain_detail
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.solver.scene import Frame
from physgraph_usd.usd.read.reader import Shot, open_shot

CORES = os.cpu_count() or 1
NEAR = 0.02
"""Distance from a body up to which distances are asked for [m]."""


def opened(name: str, level: int | None = None, garments: Sequence[str] = (), *, overrides: Sequence[str] = ()) -> Shot:
    """A sample, opened.

    Args:
        name: One of the samples.
        level: Subdivisions, or None for the sample's own.
        garments: Prim paths to refine, or all.
        overrides: Attributes set for every garment, as `--set` takes them.
    """
    with tempfile.TemporaryDirectory() as folder:
        shot = str(write_sample(name, Path(folder)))
        return open_shot(shot, level=level, garments=garments, overrides=overrides)


def problem_of(shot: Shot, dtype: torch.dtype = torch.float32) -> Problem:
    """The shot's frames, to be solved in any way."""
    levels = [garment.level for garment in shot.scene.garments]
    return Problem(shot.scene, levels, device="cpu", threads=CORES, dtype=dtype)


def frames_of(shot: Shot, times: Sequence[float]) -> list[Frame]:
    """Frames without an artist's gain."""
    return [plain_detail(shot.frame(time)) for time in times]


def distances(problem: Problem, frame: Frame, points: Sequence[np.ndarray]) -> np.ndarray:
    """Distance of each fine vertex from the nearest body [m], negative inside, infinite beyond `NEAR`."""
    refiner, found = problem.refiner, []
    for part in refiner.parts_of(frame):
        world = np.concatenate([points[index] for index in part])
        nearest = np.full(len(world), np.inf)
        for each in refiner.touching(part, frame):
            x = torch.as_tensor(world - each.surface.origin, dtype=torch.float32)
            inside = each.surface.inside(x)
            reach = torch.where(inside, float("inf"), NEAR).to(x)
            own = each.surface.closest(x, reach).distance * torch.where(inside, -1.0, 1.0)
            nearest = np.minimum(nearest, own.double().numpy())
        found.append(nearest)
    return np.concatenate(found)
