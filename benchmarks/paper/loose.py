"""The paper's loose garment against a converged solve: the flared skirt on turning hips.

Both are refined from one coarse frame by one potential; the paper compares with a simulation of other materials.
Detail is what a result adds to the smoothly upsampled cage; its energy in a band of wavelengths is the area-weighted
square of what two low-pass filters 1 / (1 + (k / k_c)^2) on the cloth leave between them. Cloth on cloth is left out:
the sample's coarse skirt crosses itself, and with it longer solves end in other folds, some of them worse.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from benchmarks.rows import Row, under
from benchmarks.shots import frames_of, opened, problem_of
from benchmarks.waves import lowpass, vertex_area
from physgraph_usd.lab.chart.problem import COLD
from physgraph_usd.lab.chart.reference import find_reference
from physgraph_usd.solver.level import Level

TIME = 24.0
BAND = (4.0, 10.0)
"""Wavelengths of the band, in mean fine edges."""


def measure(short: bool) -> list[Row]:
    """The skirt's rows."""
    shot = opened("skirt", 2)
    single, double = problem_of(shot), problem_of(shot, torch.float64)
    [frame] = frames_of(shot, [TIME])
    settings = replace(COLD, contact=replace(COLD.contact, cloth="off"))
    ours = single.solve(frame, settings).points[0]
    found = find_reference(double, frame, settings=settings, short=short)
    least = found.points[0]
    smooth = single.upsampled(frame, smooth=True)[0]
    energies = [double.judge(frame, [points], settings).energies for points in (ours, smooth)]
    known = found.lowered(energies[0], "refine's default")
    gaps = [100 * known.gap(sum(each.values())) for each in energies]
    level = single.refiner.groups[0].levels[-1]
    h = float(level.spacing.mean())
    bands = [band_energy(level, points - smooth) for points in (ours, least)]
    apart = chamfer(ours, least)
    return [
        under("gap of refine's default", gaps[0], 5.0, unit=" %"),
        Row("gap of Loop subdivision", f"{gaps[1]:.3g} %"),
        within("detail of 4 to 10 edges, over the converged solve's", bands[0] / bands[1], 0.25),
        Row("distance from the converged solve", f"{1e3 * apart:.2f} mm ({apart / h:.2f} edges)"),
        Row("distance of Loop subdivision from it", f"{1e3 * chamfer(smooth, least):.2f} mm"),
    ]


def within(what: str, value: float, most: float) -> Row:
    """A ratio that must be near one."""
    return Row(what, f"{value:.3g}", "-", f"1 +- {most:g}", bool(abs(value - 1.0) <= most))


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance of each set of points to the other [m]."""
    there, back = cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]
    return 0.5 * float(np.mean(there) + np.mean(back))


def band_energy(level: Level, field: np.ndarray, band: tuple[float, float] = BAND) -> float:
    """Area-weighted square of a vector field's part of a band of wavelengths [m^4].

    Args:
        level: The mesh.
        field: One vector a vertex [m], shape (V, 3).
        band: The wavelengths, in mean edges.
    """
    h = float(level.spacing.mean())
    short, long = (smoothed(field) for smoothed in lowpass(level, [each * h for each in band]))
    return float((vertex_area(level)[:, None] * (short - long) ** 2).sum())
