"""Pictures of gaps: the cloth of a frame as it is at a few of them, drawn from the same side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from ...shot.page.drawing import Surface, draw, fit_view
from ...solver.scene import Frame
from ...usd.read.meshes import upright
from ..methods import METHODS
from .measure import find_curves
from .problem import COLD, Problem
from .table import GAPS, Chart, Point
from .words import percent

COLOUR = (0.20, 0.33, 0.52)
SIZE = (420, 460)
NEAR = 1.5
"""Largest ratio between the energy gap of a drawn method and the wanted gap."""
FILE = "chart.looks.{}.png"


def draw_looks(chart: Chart, problem: Problem, frame: Frame, best: Sequence[np.ndarray] | None, folder: Path) -> None:
    """Draw a frame upsampled, at each of `GAPS` reached by a method, and at the best result.

    Args:
        problem: The problem in float32.
        frame: A measured frame.
        best: Fine world positions [m] of each garment at Phi*, or None where they are not known.
    """
    shapes: dict[str, Sequence[np.ndarray]] = {"100": problem.upsampled(frame, smooth=False)}
    for gap in GAPS:
        if point := _nearest(chart, gap):
            shapes[f"{100 * gap:g}"] = _solved(problem, frame, point)
    if best is not None:
        shapes["0"] = best
    up = -problem.scene.gravity if problem.scene.gravity.any() else np.array([0.0, 1.0, 0.0])
    turn = upright(up / np.linalg.norm(up))
    cloud = np.concatenate([np.concatenate(list(frames)) for frames in shapes.values()]) @ turn.T
    view, floor = fit_view(cloud, SIZE[0] / SIZE[1]), float(cloud[:, 1].min() - 0.03 * np.ptp(cloud, axis=0).max())
    meshes = [chain[-1].mesh for chain in problem.refiner.refinements if chain]
    for name, points in shapes.items():
        surfaces = [
            Surface(positions @ turn.T, triangles, np.tile(COLOUR, (len(triangles), 1)))
            for positions, mesh in zip(points, meshes, strict=False)
            for triangles in [mesh.triangulate().triangles]
        ]
        Image.fromarray(draw(surfaces, view, size=SIZE, floor=floor)).save(folder / FILE.format(name), optimize=True)


def looks_of(chart: Chart, folder: Path) -> list[tuple[Path, str]]:
    """Existing pictures of a chart and their captions, by falling energy gap."""
    captions = {"100": "100%: plain upsampling, no physics"}
    for gap in GAPS:
        if point := _nearest(chart, gap):
            left = f"{percent(point.gap, digits=2)} above the best known"
            captions[f"{100 * gap:g}"] = f"{left}: {point.method}, {point.ms:.0f} ms a frame"
    captions["0"] = "0%: the best known"
    files = ((folder / FILE.format(name), words) for name, words in captions.items())
    return [(file, words) for file, words in files if file.exists()]


def _nearest(chart: Chart, gap: float) -> Point | None:
    """The point of a method of ours that lies nearest to a gap, or None where none lies near."""
    near = [point for point in chart.points if point.integrator in METHODS and gap / NEAR <= point.gap <= gap * NEAR]
    return min(near, key=lambda point: abs(np.log(point.gap / gap)), default=None)


def _solved(problem: Problem, frame: Frame, point: Point) -> tuple[np.ndarray, ...]:
    [curve] = [curve_ for curve_ in find_curves() if curve_.name == point.method] or find_curves([point.integrator])[:1]
    return problem.solve(frame, replace(COLD, method=curve.method, steps=point.steps, tolerance=0.0)).points
