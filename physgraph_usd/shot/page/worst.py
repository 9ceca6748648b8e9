"""Head of a report's page: a one-sentence verdict, and the worst place in the refined cloth."""

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
from ...solver.scene import recentred
from ...usd.read.meshes import RefinedLayer
from ...usd.read.reader import Shot
from ...usd.stage import at_time
from ..report import RefineReport

CLOSE = 0.12
"""Radius of a close picture relative to the diagonal of the mesh's bounds: large enough to show the surroundings."""
CROSSINGS, INSIDE = "edges pass through faces", "vertices are inside bodies"


@dataclass(frozen=True)
class Worst:
    """A place in refined cloth.

    Attributes:
        path: Prim of the refined mesh.
        vertex: Number of the vertex.
        reason: Description of the fault.
    """

    time: float | None
    path: str
    vertex: int
    reason: str


def verdict(report: RefineReport) -> str:
    """One-sentence verdict of a run: faults first, then successes, and the time."""
    count, failed = len(report.frames), len(report.failed)
    wrong = [f"{failed} of {count} frames could not be solved"] if failed else []
    right = [f"{counted(count - failed, 'frame')} refined"]
    for name, nothing in ((CROSSINGS, "nothing crosses"), (INSIDE, "nothing is inside a body")):
        found = [(left[name], frame["time"]) for frame in report.frames if name in (left := _left(report, frame))]
        most, time = max(found, key=lambda each: each[0], default=(0, None))
        if most:
            wrong.append(f"{most:,} {name}{at_time(time)}, the worst frame")
        elif found:
            right.append(nothing)
    if report.unsettled:
        wrong.append(f"{counted(len({each['time'] for each in report.unsettled}), 'frame')} did not settle")
    pace = [f"{report.seconds.get('frames', 0.0) / count:.2g} s a frame"] if count else []
    sentence = "; ".join([*wrong, ", ".join([*right, *pace])])
    return f"{sentence[:1].upper()}{sentence[1:]}."


def worst_place(report: RefineReport, shot: Shot) -> Worst | None:
    """The place with most crossings and vertices inside bodies; without any, the place with most folds.

    Args:
        report: The report of a run with a written layer.
        shot: The shot, open.
    """
    frames = [frame for frame in report.frames if frame.get("garments")]
    if not frames or report.out is None:
        return None
    frame = max(frames, key=lambda each: sum(_left(report, each).values()))
    left = {name: count for name, count in _left(report, frame).items() if count}
    frame = frame if left else max(frames, key=_folds)
    layer, time = RefinedLayer(report.out), frame["time"]
    points = [layer.points(shot, index, time) for index in range(len(report.garments))]
    if any(each is None for each in points):
        return None
    cloth = [each for each in points if each is not None]
    marks = _faults(report, shot, time, cloth) if left else []
    reason = "; ".join(f"{count:,} {name}" for name, count in left.items())
    if not any(each.any() for each in marks):
        marks, reason = _angles(report, shot, cloth), reason or "nothing is wrong: the sharpest folds"
    places = [_densest(each, weight) for each, weight in zip(cloth, marks, strict=True)]
    index = max(range(len(places)), key=lambda each: places[each][1])
    path = layer.target(shot, index)
    return None if path is None else Worst(time, path, places[index][0], f"{reason}{at_time(time)}")


def _left(report: RefineReport, frame: dict[str, Any]) -> dict[str, int]:
    """Faults remaining in a frame, as far as measured."""
    found: dict[str, int] = {}
    for contact in report.measured(frame):
        bodies = [each["after"] for each in (contact.get("bodies") or {}).values()]
        cloth = [contact["cloth"]["after"]] if contact.get("cloth") else []
        if bodies or cloth:
            found[CROSSINGS] = found.get(CROSSINGS, 0) + sum(each["crossings"] for each in (*bodies, *cloth))
        if bodies:
            found[INSIDE] = found.get(INSIDE, 0) + sum(each["inside"] for each in bodies)
    return found


def _folds(frame: dict[str, Any]) -> float:
    return max(entry.get("sharp_folds") or 0.0 for entry in frame["garments"])


def _faults(report: RefineReport, shot: Shot, time: float | None, points: Sequence[np.ndarray]) -> list[np.ndarray]:
    """For each garment: 1 at vertices inside bodies, plus 1 at crossing edges or faces, shape (V,)."""
    cloth = SceneCloth(shot.scene, _levels(report), dtype=torch.float32, device="cpu", threads=1)
    cloth.bodies.pose(shot.frame(time).colliders)
    level, origin = _finest(report, shot), np.concatenate(points).mean(axis=0)
    every = np.ones((len(points), len(points)), bool)
    found = crossings(Parts(level, every), torch.as_tensor(np.concatenate(points) - origin, dtype=torch.float32))
    crossing = np.zeros(level.vertex_count, bool)
    crossing[level.edges.numpy()[found.edge.numpy()]] = True
    heat = [
        cloth.heat(i, each, crossing[span], SolveSettings())
        for i, (each, span) in enumerate(zip(points, level.spans, strict=True))
    ]
    return [(each["penetration"] > 0) + 1.0 * (each["crossing"] > 0) for each in heat]


def _angles(report: RefineReport, shot: Shot, points: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Squares of the angles by which the edges at each vertex fold, summed, shape (V,) for each garment."""
    found = []
    for garment, level, each in zip(shot.scene.garments, _levels(report), points, strict=True):
        chain = refine_garments([garment], [level])[0]
        hinges = hinges_of((chain[-1].mesh if chain else garment.mesh).triangulate().triangles)
        squares = hinge_geometry(each, hinges)[0] ** 2
        found.append(np.bincount(hinges[:, :2].ravel(), np.repeat(squares, 2), minlength=len(each)))
    return found


def _densest(points: np.ndarray, weights: np.ndarray) -> tuple[int, float]:
    """The heaviest vertex in the heaviest cube the size of a close picture, and the cube's weight."""
    size = CLOSE * float(np.linalg.norm(np.ptp(points, axis=0)))
    cell = np.unique(np.floor(points / max(size, 1e-9)), axis=0, return_inverse=True)[1].reshape(-1)
    sums = np.bincount(cell, weights)
    return int(np.where(cell == sums.argmax(), weights, -1.0).argmax()), float(sums.max())


def _finest(report: RefineReport, shot: Shot) -> Level:
    garments = [recentred(garment) for garment in shot.scene.garments]
    return build_levels(garments, refine_garments(garments, _levels(report)))[-1]


def _levels(report: RefineReport) -> list[int]:
    return [garment["level"] for garment in report.garments]
