"""The surface drawn by a renderer from a polygon mesh: without holes, and subdivided if the scheme requires.

A mesh of scheme Catmull-Clark or Loop is a cage of a smooth limit surface. The mesh is subdivided until its flat faces
are near enough to the limit surface, and the vertices are moved onto the limit surface. The remaining distance falls to
a quarter with each subdivision, as the square of the edge length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from scipy import sparse

from ...solver.mesh.subdivide import ControlMesh, fine_count, subdivide
from ...solver.mesh.topology import PolygonMesh

MOST_VERTICES = 25_000
"""Most vertices after subdivision, about as many as the cloth on top. Frames of a shirt of 22,000 vertices over a body
of 53,000 take half as long again as over a body of 13,000: the body's hierarchy is refitted in each frame."""
NEAR_PART = 0.95
"""Fraction of the surface required to be near enough: nostrils and fingertips would ask for more everywhere."""
TO_LIMIT = 4.0 / 3.0
"""Ratio of a vertex's distance to the limit surface to the move in a subdivision: 1 + 1/4 + 1/16 + ..."""


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """Faces as drawn.

    Attributes:
        mesh: The faces without holes.
        parents: The authored face of each face, shape (F,).
        stencil: Matrix from the authored points to the points of the faces, shape (V, V_authored); None for identity.
        error: Remaining distance from the limit surface over `NEAR_PART` of the surface, in the points' unit.
    """

    mesh: PolygonMesh
    parents: np.ndarray
    stencil: sparse.csr_matrix | None = None
    error: float = 0.0

    def place(self, points: np.ndarray) -> np.ndarray:
        """Points of the faces, shape (V, 3), from the authored points; a non-finite point spoils its neighbours'.

        Args:
            points: Authored points, shape (V_authored, 3).
        """
        return points if self.stencil is None else np.asarray(self.stencil @ points)


def to_limit(cage: ControlMesh) -> sparse.csr_matrix:
    """The matrix moving a cage's vertices to the limit surface, shape (V, V)."""
    count = cage.mesh.vertex_count
    moved = cage.subdivided(subdivide(cage.mesh))[0][:count, :]
    same = sparse.identity(count, format="csr")
    return sparse.csr_matrix(same + TO_LIMIT * (moved - same))


def drawn_surface(
    cage: ControlMesh, points: np.ndarray, *, holes: np.ndarray, scheme: str, within: float, levels: int | None = None
) -> DrawnSurface:
    """The faces drawn by a renderer.

    Args:
        cage: The authored faces.
        points: Authored points of any pose, shape (V, 3), to choose the number of subdivisions.
        holes: Numbers of the authored hole faces.
        scheme: "catmullClark", "loop", or another word for flat faces.
        within: Allowed distance from the limit surface, in the points' unit.
        levels: Number of subdivisions; None chooses by ``within``.
    """
    parents = np.arange(cage.mesh.face_count)
    if scheme not in ("catmullClark", "loop") or not cage.mesh.face_count:
        drawn_faces = ~np.isin(parents, holes)
        return DrawnSurface(_some_faces(cage.mesh, drawn_faces), parents[drawn_faces])
    cage = replace(cage, mesh=replace(cage.mesh, least_polygon=3 if scheme == "catmullClark" else 4))
    error = flatness(cage, points)
    wanted = 0 if error <= within else math.ceil(math.log(error / within, 4.0))
    if levels is None:
        levels = next(n for n in range(wanted, -1, -1) if n == 0 or fine_count(cage.mesh, n) <= MOST_VERTICES)
    stencils = []
    for _ in range(levels):
        step = subdivide(cage.mesh)
        stencil, cage = cage.subdivided(step)
        stencils.append(stencil)
        parents = parents[step.parent_face]
    stencil = reduce(lambda product, matrix: matrix @ product, [*stencils, to_limit(cage)])
    drawn_faces = ~np.isin(parents, holes)
    return DrawnSurface(
        _some_faces(cage.mesh, drawn_faces), parents[drawn_faces], sparse.csr_matrix(stencil), error / 4.0**levels
    )


def flatness(cage: ControlMesh, points: np.ndarray) -> float:
    """Distance of flat faces, with vertices on the limit surface, from the limit surface, over `NEAR_PART` of its area.

    The distance is estimated from the vertices added by a subdivision: their distance from the flat faces of the old
    vertices after smoothing. Distances that overflow are ignored.

    Args:
        cage: The cage.
        points: Points of the cage, shape (V, 3).
    """
    step, count = subdivide(cage.mesh), cage.mesh.vertex_count
    moved = cage.subdivided(step)[0] @ np.nan_to_num(points)
    with np.errstate(over="ignore", invalid="ignore"):  # A broken skeleton throws points far away.
        away = np.linalg.norm(moved - step.linear @ moved[:count], axis=1)[count:]
    away = away[np.isfinite(away)]
    return float(np.quantile(away, NEAR_PART)) if len(away) else 0.0


def _some_faces(mesh: PolygonMesh, selected: np.ndarray) -> PolygonMesh:
    if selected.all():
        return mesh
    return PolygonMesh(mesh.counts[selected], mesh.indices[selected[mesh.corner_face]], mesh.vertex_count)
