"""Welding: borders of one mesh that stay at one place are one line of vertices to the solver.

Exporters split a garment at its seams. Forces that bend, smooth surfaces and normals need a face on both sides of an
edge, so open edges that lie on one another are joined two by two. Edges where more than two sheets meet, and sheets
that lie on one another all over, stay as they are: `seams` sews those.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from .borders import open_edges
from .subdivide import Refinement, subdivide_times
from .topology import PolygonMesh, find_edges, joined_by

AT_ONE_PLACE = 5e-3
"""Distance under which points are at one place, in mean edges."""
WIDEST = 0.25
"""Most that a tolerance may be, in mean edges."""


@dataclass(frozen=True, eq=False)
class Weld:
    """A mesh before and after welding.

    Attributes:
        apart: The mesh as it was.
        mesh: The welded mesh, with the same faces in the same order.
        number: Vertex of the welded mesh for each vertex, shape (V,).
    """

    apart: PolygonMesh
    mesh: PolygonMesh
    number: Int[np.ndarray, " vertices"]

    @property
    def is_none(self) -> bool:
        """Whether no vertices were joined."""
        return self.mesh is self.apart

    def joined(self, values: np.ndarray) -> np.ndarray:
        """The mean value of the vertices that are one, exact where they are equal, shape (W, ...)."""
        if self.is_none:
            return values
        first = self._first
        out = np.zeros((len(first), *values.shape[1:]), values.dtype)
        np.add.at(out, self.number, values - values[first][self.number])
        count = np.bincount(self.number).reshape(-1, *[1] * (values.ndim - 1))
        return values[first] + (out / count).astype(values.dtype)

    def largest(self, values: Float[np.ndarray, " vertices"]) -> Float[np.ndarray, " welded"]:
        """The largest value of the vertices that are one."""
        out = np.full(len(self._first), -np.inf)
        np.maximum.at(out, self.number, values)
        return out

    def split(self, values: np.ndarray) -> np.ndarray:
        """Values of the welded vertices at the vertices they were, shape (V, ...)."""
        return values if self.is_none else values[self.number]

    def subdivided(self, levels: int) -> tuple[tuple[Refinement, ...], Weld]:
        """Subdivisions of the mesh as it was, and the weld of the finest one."""
        steps = subdivide_times(self.apart, levels)
        if not steps or self.is_none:
            finest = steps[-1].mesh if steps else self.apart
            return steps, Weld(finest, finest, np.arange(finest.vertex_count))
        welded, number, apart = self.mesh, self.number, self.apart
        for step, fine in zip(steps, subdivide_times(self.mesh, levels), strict=True):
            of_edges = welded.vertex_count + find_edges(fine.edges, number[step.edges])
            centres = step.mesh.vertex_count - apart.vertex_count - len(step.edges)
            of_faces = fine.mesh.vertex_count - centres + np.arange(centres)
            number = np.concatenate([number, of_edges, of_faces])
            apart, welded = step.mesh, fine.mesh
        return steps, Weld(apart, welded, number)

    @property
    def _first(self) -> np.ndarray:
        """The first vertex of each welded one, shape (W,)."""
        return np.unique(self.number, return_index=True)[1]


def unwelded(mesh: PolygonMesh) -> Weld:
    """A mesh that stays as it is."""
    return Weld(mesh, mesh, np.arange(mesh.vertex_count))


def weld(mesh: PolygonMesh, poses: Sequence[Float[np.ndarray, "vertices 3"]], within: float) -> Weld:
    """Join the open edges of a mesh that lie on one another in every pose, two by two.

    Args:
        mesh: The mesh.
        poses: Positions [m], at least one.
        within: Distance under which two vertices are at one place [m].
    """
    edges = open_edges(mesh)
    pairs = pairs_within(poses, np.unique(edges), within)
    pairs = pairs[~_in_one_face(mesh, pairs)]
    if not len(pairs):
        return unwelded(mesh)
    place = joined_by(pairs, mesh.vertex_count)
    ends = np.sort(place[edges], axis=1)
    order = np.lexsort(ends.T)
    same = np.flatnonzero((ends[order[1:]] == ends[order[:-1]]).all(axis=1))
    count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    alone = count[2][count[1].reshape(-1)][order[same]] == 2
    first, second = edges[order[same[alone]]], edges[order[same[alone] + 1]]
    kept = (place[first[:, 0]] != place[first[:, 1]]) & ~_on_one_another(mesh, poses[0], first, second, within)
    first, second = first[kept], second[kept]
    crossed = place[first[:, 0]] != place[second[:, 0]]
    second = np.where(crossed[:, None], second[:, ::-1], second)
    joined = np.stack([first.ravel(), second.ravel()], axis=1)
    if not len(joined):
        return unwelded(mesh)
    label = joined_by(joined, mesh.vertex_count)
    _, first_of, number = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first_of), np.int64)
    rank[np.argsort(first_of)] = np.arange(len(first_of))  # Welded vertices keep the order of the vertices.
    number = rank[number.reshape(-1)]
    whole = replace(mesh, indices=number[mesh.indices].astype(np.int32), vertex_count=len(first_of))
    return Weld(mesh, whole, number)


def seam_reach(mesh: PolygonMesh, points: Float[np.ndarray, "vertices 3"], tolerance: float) -> float:
    """Distance under which vertices are at one place [m]: the tolerance, or `AT_ONE_PLACE` where that is larger.

    Never more than a quarter of the mean edge, or vertices of one border would be taken for one.
    """
    ends = mesh.half_edges.edges
    edge = float(np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1).mean())
    return float(np.clip(tolerance, AT_ONE_PLACE * edge, WIDEST * edge))


def pairs_within(poses: Sequence[np.ndarray], which: np.ndarray, within: float) -> np.ndarray:
    """Pairs of some vertices that are nearer than a distance [m] in every pose, shape (N, 2)."""
    for pose in poses:
        which = which[np.isfinite(pose[which]).all(axis=1)]
    if len(which) < 2:
        return np.zeros((0, 2), np.int64)
    pairs = which[cKDTree(poses[0][which]).query_pairs(within, output_type="ndarray")].reshape(-1, 2)
    for pose in poses[1:]:
        pairs = pairs[np.linalg.norm(pose[pairs[:, 0]] - pose[pairs[:, 1]], axis=1) <= within]
    return pairs


def _in_one_face(mesh: PolygonMesh, pairs: np.ndarray) -> np.ndarray:
    """Whether each pair of vertices has a face in common."""
    if not len(pairs):
        return np.zeros(0, bool)
    used = np.unique(pairs)
    corners = np.flatnonzero(np.isin(mesh.indices, used))
    key = mesh.corner_face[corners].astype(np.int64) * mesh.vertex_count + mesh.indices[corners]
    order = np.argsort(mesh.indices[corners], kind="stable")
    starts = np.searchsorted(mesh.indices[corners][order], np.arange(mesh.vertex_count + 1))
    found, known = np.zeros(len(pairs), bool), np.sort(key)
    widest = int(np.diff(starts)[used].max(initial=0))
    for place in range(widest):  # The faces of the first vertex, one after another.
        at = starts[pairs[:, 0]] + place
        there = at < starts[pairs[:, 0] + 1]
        face = mesh.corner_face[corners[order[np.where(there, at, 0)]]].astype(np.int64)
        wanted = face * mesh.vertex_count + pairs[:, 1]
        where = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        found |= there & (known[where] == wanted)
    return found


def _on_one_another(
    mesh: PolygonMesh, points: np.ndarray, first: np.ndarray, second: np.ndarray, within: float
) -> np.ndarray:
    """Whether the faces of two open edges have their middles at one place, as a doubled sheet's have, shape (N,)."""
    half = mesh.half_edges
    face_of = np.empty(len(half.edges), np.int64)
    face_of[half.edge] = mesh.corner_face
    sums = np.zeros((mesh.face_count, 3))
    np.add.at(sums, mesh.corner_face, points[mesh.indices])
    middle = sums / np.maximum(mesh.counts, 1)[:, None]
    one, two = (middle[face_of[find_edges(half.edges, each)]] for each in (first, second))
    length = np.linalg.norm(points[first[:, 0]] - points[first[:, 1]], axis=1)
    return np.linalg.norm(one - two, axis=1) <= np.maximum(within, AT_ONE_PLACE * length)
