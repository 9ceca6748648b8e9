"""Head of a report's page: a one-sentence verdict, and the worst place in the refined cloth or its best fold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ...errors import counted
from ...solver.collide.crossings import crossings
from ...solver.collide.parts import Parts
from ...solver.frame.scene_frame import SceneCloth
from ...solver.frame.settings import SolveSettings
from ...solver.level import Level, build_levels, hinge_geometry, refine_garments
from ...solver.mesh.elements import hinges_of
from ...solver.mesh.weld import Weld
from ...solver.scene import recentred
from ...usd.read.meshes import RefinedLayer
from ...usd.read.reader import Shot
from ...usd.stage import at_time
from ..report import RefineReport, levels_of

CLOSE = 0.12
"""Radius of a close picture relative to the diagonal of the mesh's bounds: large enough to show the surroundings."""
MOST_TRIED = 24
"""Most places tried for the best fold in open view."""
CROSSINGS, INSIDE = "edges pass through faces", "vertices are inside bodies"


@dataclass(frozen=True)
class CloseUp:
    """A place in refined cloth for a close picture.

    Attributes:
        path: Prim of the refined mesh.
        vertices: Numbers of the vertices, the best first; the first in open view is shown.
        caption: Title of the picture.
    """

    time: float | None
    path: str
    vertices: Sequence[int]
    caption: str


def verdict(report: RefineReport) -> str:
    """One-sentence verdict of a run: faults first, then successes, and the time."""
    count, failed = len(report.frames), len(report.failed)
    wrong = [f"{failed} of {count} frames could not be solved"] if failed else []
    right = [f"{counted(count - failed, 'frame')} refined"]
    for name, nothing in ((CROSSINGS, "nothing crosses"), (INSIDE, "nothing is inside a body")):
        remaining = [
            (counts_left[name], frame["time"])
            for frame in report.frames
            if name in (counts_left := _left(report, frame))
        ]
        most, time = max(remaining, key=lambda entry: entry[0], default=(0, None))
        if most:
            wrong.append(f"{most:,} {name}{at_time(time)}, the worst frame")
        elif remaining:
            right.append(nothing)
    if report.unsettled:
        wrong.append(f"{counted(len({frame['time'] for frame in report.unsettled}), 'frame')} did not settle")
    pace = [f"{seconds_as_text(report.seconds.get('frames', 0.0) / count)} of wall time per frame"] if count else []
    sentence = "; ".join([*wrong, ", ".join([*right, *pace])])
    return f"{sentence[:1].upper()}{sentence[1:]}."


def seconds_as_text(seconds: float) -> str:
    """A duration [s] with two significant digits and no exponent, such as "0.42 s", "5.9 s" or "280 s"."""
    return f"{float(f'{seconds:.2g}'):,g} s"


def close_up(report: RefineReport, shot: Shot) -> CloseUp | None:
    """The place with most crossings and vertices inside bodies; without any, the place that refinement folds most.

    Args:
        report: The report of a run with a written layer.
        shot: The shot, open.
    """
    frames = [frame for frame in report.frames if frame.get("garments")]
    if not frames or report.out is None:
        return None
    frame = max(frames, key=lambda candidate: sum(_left(report, candidate).values()))
    remaining = {name: count for name, count in _left(report, frame).items() if count}
    frame = frame if remaining else max(frames, key=_bending)
    layer, time = RefinedLayer(report.out), frame["time"]
    welds, cloth = list[Weld](), list[np.ndarray]()
    for index, garment in enumerate(report.garments):
        weld, points = shot.sources[index].weld.subdivided(garment["level"])[1], layer.points(shot, index, time)
        if points is None:
            return None
        welds.append(weld)
        cloth.append(weld.joined(points[: len(weld.number)]))  # A shell's outer side comes first.
    marks = _faults(report, shot, time, cloth) if remaining else []
    caption = "The worst place: " + "; ".join(f"{count:,} {name}" for name, count in remaining.items())
    if not any(mark.any() for mark in marks):
        marks, caption = _folds(report, shot, time, cloth), caption if remaining else "The best fold"
    densest = [_densest(positions, weight) for positions, weight in zip(cloth, marks, strict=True)]
    index = max(range(len(densest)), key=lambda number: densest[number][1])
    most = 1 if remaining else MOST_TRIED
    path = layer.target(shot, index)
    vertices = [int(np.flatnonzero(welds[index].number == welded)[0]) for welded in densest[index][0][:most]]
    return None if path is None else CloseUp(time, path, vertices, f"{caption}{at_time(time)}")


def _left(report: RefineReport, frame: dict[str, Any]) -> dict[str, int]:
    """Faults remaining in a frame, as far as measured."""
    total: dict[str, int] = {}
    for contact in report.measured(frame):
        bodies = [body["after"] for body in (contact.get("bodies") or {}).values()]
        cloth = [contact["cloth"]["after"]] if contact.get("cloth") else []
        if bodies or cloth:
            total[CROSSINGS] = total.get(CROSSINGS, 0) + sum(measured["crossings"] for measured in (*bodies, *cloth))
        if bodies:
            total[INSIDE] = total.get(INSIDE, 0) + sum(body["inside"] for body in bodies)
    return total


def _bending(frame: dict[str, Any]) -> float:
    """Largest bending energy of a garment in a frame [J]."""
    energies = [(entry.get("energy_joules") or {}).get("output", {}) for entry in frame["garments"]]
    return max(terms.get("bending", 0.0) for terms in energies)


def _faults(report: RefineReport, shot: Shot, time: float | None, points: Sequence[np.ndarray]) -> list[np.ndarray]:
    """For each garment: 1 at vertices inside bodies, plus 1 at crossing edges or faces, shape (V,)."""
    cloth = SceneCloth(shot.scene, levels_of(report.garments), dtype=torch.float32, device="cpu", threads=1)
    cloth.bodies.pose(shot.frame(time).colliders)
    level, origin = _finest(report, shot), np.concatenate(points).mean(axis=0)
    every = np.ones((len(points), len(points)), bool)
    crossing_pairs = crossings(
        Parts(level, every), torch.as_tensor(np.concatenate(points) - origin, dtype=torch.float32)
    )
    crossing = np.zeros(level.vertex_count, bool)
    crossing[level.edges.numpy()[crossing_pairs.edge.numpy()]] = True
    heat = [cloth.heat(i, points[i], crossing[span], SolveSettings()) for i, span in enumerate(level.spans)]
    return [(maps["penetration"] > 0) + 1.0 * (maps["crossing"] > 0) for maps in heat]


def _folds(report: RefineReport, shot: Shot, time: float | None, points: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Squares of the angles by which the edges at each vertex fold, summed, shape (V,) for each garment.

    Folds of the smoothly subdivided input are subtracted: the input's own corners and hems are no folds of the cloth.
    """
    folds, cages = [], shot.frame(time).garments
    for garment, level, fine, cage in zip(shot.scene.garments, levels_of(report.garments), points, cages, strict=True):
        control, coarse = garment.control, cage.points
        for step in refine_garments([garment], [level])[0]:
            smooth, control = control.subdivided(step)
            coarse = smooth @ coarse
        hinges = hinges_of(control.mesh.triangulate().triangles)
        squares, before = (hinge_geometry(pose, hinges)[0] ** 2 for pose in (fine, coarse))
        added = np.maximum(squares - before, 0.0)
        folds.append(np.bincount(hinges[:, :2].ravel(), np.repeat(added, 2), minlength=len(fine)))
    return folds


def _densest(points: np.ndarray, weights: np.ndarray) -> tuple[list[int], float]:
    """The heaviest vertex of each cube the size of a close picture, the heaviest cube first, and that cube's weight."""
    size = CLOSE * float(np.linalg.norm(np.ptp(points, axis=0)))
    cell = np.unique(np.floor(points / max(size, 1e-9)), axis=0, return_inverse=True)[1].reshape(-1)
    sums = np.bincount(cell, weights)
    heaviest = [
        int(np.where(cell == cell_number, weights, -1.0).argmax()) for cell_number in np.argsort(-sums)[:MOST_TRIED]
    ]
    return heaviest, float(sums.max())


def _finest(report: RefineReport, shot: Shot) -> Level:
    garments = [recentred(garment) for garment in shot.scene.garments]
    return build_levels(garments, refine_garments(garments, levels_of(report.garments)))[-1]
