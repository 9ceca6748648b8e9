"""Finds defects of a mesh, element by element. Only indices out of range stop a refinement."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .topology import PolygonMesh

NO_AREA = 1e-7
"""Area, as a fraction of the longest edge squared, below which a face counts as having no area in float32."""


@dataclass(frozen=True)
class Defect:
    """One defect.

    Attributes:
        kind: "index-out-of-range", "degenerate-face", "zero-area-face", "duplicate-face", "non-manifold-edge",
            "inconsistent-winding", "bow-tie-vertex" or "isolated-point".
        index: The face, vertex or, for edges, row of ``mesh.half_edges.edges``.
        message: Description in words.
    """

    kind: str
    index: int
    message: str


def defects(mesh: PolygonMesh, points: np.ndarray | None = None) -> list[Defect]:
    """Find all defects of a mesh.

    Args:
        mesh: Any mesh; faces with an index out of range are reported and left out of the other checks, so edges are
            then numbered without such faces.
        points: Positions, shape (V, 3); without positions no areas are checked.

    Returns:
        Defects by kind, in the order of :attr:`Defect.kind`, then by index; empty for a clean manifold mesh.
    """
    broken = (mesh.indices < 0) | (mesh.indices >= mesh.vertex_count)
    bad_faces = np.unique(mesh.corner_face[broken])
    faults = [
        Defect("index-out-of-range", int(face), f"face {face} uses a vertex that does not exist") for face in bad_faces
    ]
    valid = np.setdiff1d(np.arange(mesh.face_count), bad_faces)
    corners = ~np.isin(mesh.corner_face, bad_faces)
    sound = PolygonMesh(mesh.counts[valid], mesh.indices[corners], mesh.vertex_count) if len(bad_faces) else mesh
    faults += _face_defects(sound, points, valid)
    return faults + _edge_defects(sound) + _vertex_defects(sound)


def in_brief(faults: Sequence[Defect]) -> list[str]:
    """A line for each kind of defects: the first in words, and the number of further defects."""
    kinds = Counter(defect.kind for defect in faults)
    first = {defect.kind: defect.message for defect in reversed(faults)}
    return [first[kind] + (f", and {count - 1:,} more" if count > 1 else "") for kind, count in kinds.items()]


def _named(kind: str, indices: Iterable[int], message: str) -> list[Defect]:
    """One defect per index; the message has a placeholder for the index."""
    return [Defect(kind, int(index), message.format(index)) for index in indices]


def _face_defects(mesh: PolygonMesh, points: np.ndarray | None, names: np.ndarray) -> list[Defect]:
    """Check faces; ``names`` are the face numbers to report."""
    degenerate, duplicate = mesh.counts < 3, np.zeros(mesh.face_count, bool)
    for size in np.unique(mesh.counts):
        faces = np.flatnonzero(mesh.counts == size)
        corners = np.sort(mesh.indices[mesh.starts[faces, None] + np.arange(size)], axis=1)
        degenerate[faces] |= (corners[:, 1:] == corners[:, :-1]).any(axis=1)
        first = np.unique(corners, axis=0, return_index=True)[1]
        duplicate[np.setdiff1d(faces, faces[first])] = True
    faults = _named("degenerate-face", names[degenerate], "face {} repeats a vertex or has fewer than three corners")
    if points is not None:
        flat = _areas_vanish(mesh, np.asarray(points, np.float64)) & ~degenerate
        faults += _named("zero-area-face", names[flat], "face {} has no area")
    return faults + _named("duplicate-face", names[duplicate], "face {} has the vertices of an earlier face")


def _areas_vanish(mesh: PolygonMesh, points: np.ndarray) -> np.ndarray:
    """Whether each face's area is negligible compared with its longest edge squared, shape (F,)."""
    start, end = points[mesh.indices], points[mesh.indices[mesh.next_corner]]
    origin = start[mesh.starts[mesh.corner_face]]
    twice = np.cross(start - origin, end - origin)
    area = np.stack([np.bincount(mesh.corner_face, column, mesh.face_count) for column in twice.T], axis=1)
    longest = np.zeros(mesh.face_count)
    np.maximum.at(longest, mesh.corner_face, ((end - start) ** 2).sum(axis=1))
    return ~(0.5 * np.linalg.norm(area, axis=1) > NO_AREA * longest)


def _edge_defects(mesh: PolygonMesh) -> list[Defect]:
    """Check edges; a face containing an edge twice, because of a repeated vertex, counts once."""
    half = mesh.half_edges
    proper = half.edges[:, 0] != half.edges[:, 1]
    forward = np.bincount(half.edge, half.forward, len(half.edges))
    visits = np.unique(np.stack([half.edge, mesh.corner_face]), axis=1)
    faces = np.bincount(visits[0], minlength=len(half.edges))
    crowded = np.flatnonzero(proper & (faces > 2))
    twisted = np.flatnonzero(proper & (half.count == 2) & (faces == 2) & (forward != 1))
    faults = [
        Defect("non-manifold-edge", int(row), f"edge {_pair(half.edges[row])} has {faces[row]} faces")
        for row in crowded
    ]
    return faults + [
        Defect("inconsistent-winding", int(row), f"both faces run through edge {_pair(half.edges[row])} the same way")
        for row in twisted
    ]


def _pair(edge: np.ndarray) -> str:
    return f"{edge[0]}-{edge[1]}"


def _vertex_defects(mesh: PolygonMesh) -> list[Defect]:
    bow_ties, isolated = np.flatnonzero(mesh.fan_counts > 1), np.flatnonzero(mesh.fan_counts == 0)
    faults = _named("bow-tie-vertex", bow_ties, "vertex {} joins several fans of faces in a point")
    return faults + _named("isolated-point", isolated, "no face uses vertex {}")
