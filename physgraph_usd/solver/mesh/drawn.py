"""The surface that a renderer draws from a polygon mesh: without holes, and subdivided where its scheme says so.

A mesh of scheme Catmull-Clark or Loop is a cage of a smooth limit surface. Its vertices are moved to the limit surface,
after as many subdivisions as bring the flat faces between them near enough to it. The distance left falls to a quarter
with each subdivision, as the square of the edge length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import reduce

import numpy as np
from scipy import sparse

from .subdivide import fine_count, smooth, subdivide
from .topology import PolygonMesh

MOST_VERTICES = 25_000
"""Most vertices that a mesh is subdivided to, about as many as the cloth over it has. Frames of a shirt of 22,000
vertices over a body of 53,000 take half as long again as over one of 13,000: its hierarchy is refitted in each."""
NEAR_PART = 0.95
"""Fraction of the surface that has to be near enough: nostrils and fingertips would ask for more everywhere."""
TO_LIMIT = 4.0 / 3.0
"""A vertex's distance to the limit surface over its move in one subdivision: 1 + 1/4 + 1/16 + ..."""


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """Faces as they are drawn.

    Attributes:
        mesh: The faces without holes.
        stencil: Matrix from the authored points to those of the faces, shape (V, V_authored); None where they are the
            authored ones.
        error: Distance from the limit surface that is left over `NEAR_PART` of the surface, in the points' unit.
    """

    mesh: PolygonMesh
    stencil: sparse.csr_matrix | None = None
    error: float = 0.0

    def place(self, points: np.ndarray) -> np.ndarray:
        """Points of the faces, shape (V, 3), from the authored ones; a point that is not finite spoils its neighbours'.

        Args:
            points: Authored points, shape (V_authored, 3).
        """
        return points if self.stencil is None else np.asarray(self.stencil @ points)


def drawn_mesh(mesh: PolygonMesh, points: np.ndarray, *, holes: np.ndarray, scheme: str, within: float) -> DrawnMesh:
    """The faces that a renderer draws.

    Args:
        mesh: The authored faces.
        points: Authored points of any one pose, shape (V, 3): they decide the number of subdivisions.
        holes: Numbers of the authored faces that are holes.
        scheme: "catmullClark", "loop", or another for faces that are drawn flat.
        within: Distance from the limit surface that is near enough, in the points' unit.
    """
    kept = ~np.isin(np.arange(mesh.face_count), holes)
    if scheme not in ("catmullClark", "loop") or not mesh.face_count:
        return DrawnMesh(_some_faces(mesh, kept))
    cage = PolygonMesh(mesh.counts, mesh.indices, mesh.vertex_count, 3 if scheme == "catmullClark" else 4)
    error = flatness(cage, points)
    wanted = 0 if error <= within else math.ceil(math.log(error / within, 4.0))
    levels = next(n for n in range(wanted, -1, -1) if n == 0 or fine_count(cage, n) <= MOST_VERTICES)
    steps = []
    for _ in range(levels):
        step = subdivide(cage)
        steps.append(smooth(cage, step))
        kept, cage = kept[step.parent_face], step.mesh
    stencil = reduce(lambda product, step: step @ product, [*steps, _to_limit(cage)])
    return DrawnMesh(_some_faces(cage, kept), sparse.csr_matrix(stencil), error / 4.0**levels)


def flatness(cage: PolygonMesh, points: np.ndarray) -> float:
    """Distance from the limit surface of the faces between vertices on it, over `NEAR_PART` of the surface.

    A vertex that subdivision makes is as far from the face of the old vertices, all moved by one subdivision.

    Args:
        cage: The cage.
        points: Its points, shape (V, 3).
    """
    step = subdivide(cage)
    moved = smooth(cage, step) @ np.nan_to_num(points)
    away = np.linalg.norm(moved - step.linear @ moved[: cage.vertex_count], axis=1)[cage.vertex_count :]
    return float(np.quantile(away, NEAR_PART)) if len(away) else 0.0


def _to_limit(cage: PolygonMesh) -> sparse.csr_matrix:
    """The matrix that moves vertices to the limit surface, shape (V, V)."""
    moved = smooth(cage, subdivide(cage))[: cage.vertex_count, :]
    same = sparse.identity(cage.vertex_count, format="csr")
    return sparse.csr_matrix(same + TO_LIMIT * (moved - same))


def _some_faces(mesh: PolygonMesh, kept: np.ndarray) -> PolygonMesh:
    """The mesh with some of its faces."""
    if kept.all():
        return mesh
    return PolygonMesh(mesh.counts[kept], mesh.indices[kept[mesh.corner_face]], mesh.vertex_count)
