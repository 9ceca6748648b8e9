"""Finds where bodies show through cloth because a program draws one of them otherwise than contact takes it.

Cloth keeps its distance from the limit surface of a subdivided body, as renderers draw the body. A viewport that draws
the authored polygons shows corners outside that surface.

Contact keeps the polygons of refined cloth outside bodies. A renderer that subdivides the cloth draws its limit
surface, which is rounder, and may enter a body with sharp edges.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...solver.colliders.pose import bounds_of
from ...solver.contact.broad_phase import Bodies
from ...solver.contact.measure import DEEP
from ...solver.contact.report import penetration_map
from ...solver.scene import Result
from ...usd.mesh.bind import closest
from ...usd.read.bodies import DRAWN_WITHIN, Polygons
from ...usd.read.meshes import limit_of
from ...usd.read.reader import Shot

MOST_FRAMES, EVERY = 8, 8
"""Most frames of a run in which bodies are compared with the cloth, and least step between them: a comparison takes
about 30 ms."""
STEP = 5e-4
"""Step of the offsets proposed [m]."""


@dataclass(frozen=True)
class Shown:
    """A body whose polygons stand above a garment in a frame.

    Attributes:
        garment: Path of the garment.
        body: Path of the body.
        height: Largest height of a polygon above the cloth [m].
        offset: The garment's contact offset at which the cloth covers the polygons [m]; infinite if it would hide the
            cloth's folds.
    """

    garment: str
    body: str
    time: float | None
    height: float
    offset: float


class Compared:
    """A few frames of a run, compared with the bodies as programs draw cloth and bodies.

    Attributes:
        shown: Bodies whose polygons stand above the cloth by more than a body's surface may be off.
        depths: By time code, depths [m] inside bodies of the surface that renderers draw, by path of the garment.
    """

    def __init__(self, shot: Shot, levels: Sequence[int], *, count: int) -> None:
        """Start without a frame.

        Args:
            shot: The shot, open.
            levels: Number of subdivisions of each garment; () to measure no depths.
            count: Number of frames of the run; 0 to compare none.
        """
        self._shot, self._number = shot, 0
        self._compared = range(0, count, max(EVERY, math.ceil(count / MOST_FRAMES)))
        self._limits = [limit_of(shot, index, level) for index, level in enumerate(levels)]
        self._bodies = Bodies(shot.scene.colliders, device="cpu", threads=1)
        self.shown, self.depths = list[Shown](), dict[float | None, dict[str, float]]()

    def add(self, result: Result) -> None:
        """Compare the next frame, if it is one of the few."""
        self._number += 1
        if self._number - 1 in self._compared and result.garments:
            self.shown += self._shown(result)
            self.depths[result.time] = self._depths(result) if self._limits else {}

    def _depths(self, result: Result) -> dict[str, float]:
        """Depth inside bodies of the surface drawn from each garment that contact has kept outside [m], by path.

        The surface is measured at the vertices of the refined cloth. Depths up to `DEEP` are left out.
        """
        deepest = dict[str, float]()
        self._bodies.pose(self._shot.frame(result.time).colliders)
        for index, garment in enumerate(self._shot.scene.garments):
            cloth, limit = result.garments[index].points, self._limits[index]
            if cloth is None or limit is None:
                continue
            near = self._bodies.near(garment, bounds_of(cloth), 0.0)
            surfaces = [body.surface for body in self._bodies.touching(near, [[0.0] * len(near)])]
            solved, drawn = (1e-3 * penetration_map(surfaces, positions) for positions in (cloth, limit @ cloth))
            depth = float(drawn[solved <= DEEP].max(initial=0.0))
            if depth > DEEP:
                deepest[garment.path] = depth
        return deepest

    def _shown(self, result: Result) -> Iterator[Shown]:
        """Bodies whose polygons stand above refined cloth by more than a body's surface may be off."""
        shot, bodies = self._shot, self._shot.polygons(result.time)
        for index, solved in enumerate(result.garments):
            garment = shot.scene.garments[index]
            for number in garment.colliders:
                body, collider = bodies[number], shot.scene.colliders[number]
                if solved.points is None or body is None:
                    continue
                height, lift = _height(body, solved.points, kept=shot.offset(index, result.time) + collider.offset)
                if height > DRAWN_WITHIN:
                    offset = STEP * math.ceil((lift - collider.offset) / STEP)
                    suits = offset <= shot.readers[index].largest_offset
                    yield Shown(garment.path, collider.path, result.time, height, offset if suits else math.inf)


def _height(body: Polygons, cloth: np.ndarray, *, kept: float) -> tuple[float, float]:
    """Largest height of polygons above cloth, and of their corners above the limit surface [m]; 0 where none stands.

    Args:
        cloth: Fine positions [m], shape (V, 3).
        kept: Distance kept from the limit surface [m]; corners nearer to the surface are below the cloth.
    """
    lift = np.linalg.norm(body.points - body.limit, axis=1)
    raised = np.flatnonzero(lift > kept)
    if not len(raised):
        return 0.0, 0.0
    faces = body.triangles[np.isin(body.triangles, raised).any(axis=1) & np.isfinite(lift[body.triangles]).all(axis=1)]
    sides = np.linalg.norm(body.points[faces] - body.points[np.roll(faces, 1, axis=1)], axis=2)
    reach = np.zeros(len(lift))
    np.maximum.at(reach, faces, 0.5 * sides.max(axis=1, keepdims=True))  # Beyond, the other corner is as near.
    reach = (reach + lift)[raised]
    tree = cKDTree(cloth, balanced_tree=False)
    beside = [np.asarray(indices, np.int64) for indices in tree.query_ball_point(body.points[raised], reach)]
    near = cloth[np.unique(np.concatenate(beside))]
    faces = faces[np.isin(faces, raised[[len(neighbours) > 0 for neighbours in beside]]).any(axis=1)]
    if not len(faces):
        return 0.0, 0.0
    nearest = closest(near, body.points, faces)
    corners = faces[nearest.triangle]
    polygon, smooth = (
        np.einsum("nk,nkd->nd", nearest.weights, vertices[corners]) for vertices in (body.points, body.limit)
    )
    above = (np.einsum("nd,nd->n", polygon - near, near - smooth) > 0.0) & (
        nearest.distance < lift[corners].max(axis=1)
    )
    return float(nearest.distance[above].max(initial=0.0)), float(lift[corners[above]].max(initial=0.0))
