"""Reads the coarse cage: a mesh prim's topology, checked, and its points at a time code, with broken points repaired.

Holes and faces with fewer than three corners are left out, and corners given twice in a row become one. An unusable
topology is refused.

Repair: a non-finite point moves with its finite neighbours since the last good sample: its old position plus the
neighbours' mean displacement. Without finite neighbours the point keeps its old position; without an earlier good
sample the next good sample is used; without either, the point is the mean of its neighbours. Repair reads only the
stage, never results of earlier reads, so the order of reading frames does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom

from ...errors import GarmentError, counted
from ...interrupts import leave_if_asked
from ...solver.mesh.topology import PolygonMesh
from ..mesh.attributes import kept_corners, single_corners
from ..stage import Notice, value_at
from .absence import missing_value

_CONTROLS = {
    "subdivisionScheme": ("catmullClark", "loop", "bilinear", "none"),
    "orientation": ("rightHanded", "leftHanded"),
}
_SPLIT = "export the garment with one topology, or split the shot where it changes and use --frames"
MOST_CORNERS, MOST_TWICE = 1000, 64
"""Most corners of a face, and of each of two faces with equal corners. Subdivision joins all corners at a single
vertex, and the number of contact pairs there grows with the square: 1,000 corners take seconds, 2,000 on a body a
minute, two equal faces of 500 half a minute."""
MOST_BROKEN = 0.1
"""Largest fraction of points replaced by repair."""


@dataclass(frozen=True, eq=False)
class Cage:
    """A garment's topology: the kept faces, their numbers among the authored faces, int32, and notices."""

    mesh: PolygonMesh
    kept_faces: np.ndarray
    notices: tuple[Notice, ...]


def read_cage(prim: Usd.Prim, vertex_count: int, times: Sequence[float]) -> Cage:
    """Read the topology of a mesh with a given number of points and time codes (none for a still mesh).

    Raises:
        GarmentError: When the topology is empty, broken or varies in time.
    """
    path, usd = str(prim.GetPath()), UsdGeom.Mesh(prim)
    counts_attr, indices_attr = usd.GetFaceVertexCountsAttr(), usd.GetFaceVertexIndicesAttr()
    holes_attr = usd.GetHoleIndicesAttr()
    for attribute in (counts_attr, indices_attr, holes_attr):
        refuse_varying(attribute, times)
    time = times[0] if times else None
    counts, indices = (read_integers(attribute, time) for attribute in (counts_attr, indices_attr))
    check_topology(path, counts, indices, vertex_count=vertex_count, time=time)
    holes = read_integers(holes_attr, time)
    valid_holes = np.unique(holes[(holes >= 0) & (holes < len(counts))])
    notices = _left_out(path, counts >= 3, len(holes) - np.isin(holes, valid_holes).sum())
    sizes = np.bincount(np.repeat(np.arange(len(counts)), counts), single_corners(counts, indices), len(counts))
    keep = sizes >= 3
    keep[valid_holes] = False
    if not keep.any():
        raise GarmentError(path, f"every one of its {len(counts)} faces is a hole", remedy="clear holeIndices")
    _refuse_large_faces(path, counts, indices, keep)
    kept_faces = np.flatnonzero(keep).astype(np.int32)
    kept_indices = indices[kept_corners(counts, indices, kept_faces)]
    mesh = PolygonMesh(sizes[keep].astype(np.int32), kept_indices, vertex_count)
    return Cage(mesh, kept_faces, (*notices, *_odd_controls(usd)))


def read_integers(attribute: Usd.Attribute, time: float | None) -> np.ndarray:
    """Integer array at a time code, or at the first sample if there is no default; empty when unauthored."""
    value = value_at(attribute, time)
    array = np.zeros(0) if value is None else np.asarray(value)
    if array.ndim != 1 or (len(array) and not np.issubdtype(array.dtype, np.integer)):
        message = f"{attribute.GetName()} is {type(value).__name__}, not an array of integers"
        raise GarmentError(str(attribute.GetPrim().GetPath()), message, time=time, remedy="author int[]")
    return array.astype(np.int32)


def refuse_varying(attribute: Usd.Attribute, times: Sequence[float]) -> None:
    """Refuse (GarmentError) an attribute with different samples between the first and last time code."""
    samples = attribute.GetTimeSamples()
    if len(samples) < 2 or not times:
        return
    first = read_integers(attribute, times[0])
    for time in samples:
        if not times[0] < time <= times[-1] or np.array_equal(first, read_integers(attribute, time)):
            continue
        if not missing_value(attribute.GetPrim(), time):
            message = f"{attribute.GetName()} changes: the topology of a garment must stay the same over the shot"
            raise GarmentError(str(attribute.GetPrim().GetPath()), message, time=time, remedy=_SPLIT)


def check_topology(
    path: str, counts: np.ndarray, indices: np.ndarray, *, vertex_count: int, time: float | None
) -> None:
    """Refuse an unusable topology; GarmentError gives the faulty index or sum."""
    remedy = "export the mesh again or repair it in its host program"
    if len(counts) == 0 or vertex_count == 0 or not (counts >= 3).any():
        message = f"the mesh is empty: {vertex_count} points, {len(counts)} faces"
        raise GarmentError(path, message, time=time, remedy="leave it out with --garment, or remove the schema from it")
    if counts.min() < 0:
        face = int(np.argmin(counts))
        raise GarmentError(path, f"faceVertexCounts[{face}] is {counts[face]}", time=time, remedy=remedy)
    if counts.sum(dtype=np.int64) != len(indices):
        message = f"faceVertexCounts sum to {counts.sum(dtype=np.int64)} but there are {len(indices)} faceVertexIndices"
        raise GarmentError(path, message, time=time, remedy=remedy)
    outside = np.flatnonzero((indices < 0) | (indices >= vertex_count))
    if len(outside):
        corner = int(outside[0])
        message = f"faceVertexIndices[{corner}] is {indices[corner]} but there are {vertex_count} points"
        raise GarmentError(path, message, time=time, remedy=remedy)


def _refuse_large_faces(path: str, counts: np.ndarray, indices: np.ndarray, keep: np.ndarray) -> None:
    """Refuse faces with too many corners to solve; two equal faces have a lower limit."""
    starts, faces = np.cumsum(counts) - counts, dict[bytes, int]()
    for face in np.flatnonzero(keep & (counts > MOST_TWICE)).tolist():
        count = int(counts[face])
        remedy = "remesh it, or triangulate it"
        if count > MOST_CORNERS:
            raise GarmentError(path, f"face {face} has {count:,} corners; {MOST_CORNERS:,} are the most", remedy=remedy)
        first = faces.setdefault(np.sort(indices[starts[face] :][:count]).tobytes(), face)
        if first != face:
            raise GarmentError(path, f"faces {first} and {face} have the same {count} corners", remedy="remove one")


def _left_out(path: str, keep: np.ndarray, unknown_holes: int) -> list[Notice]:
    notices = []
    if not keep.all():
        face = int(np.argmin(keep))
        message = (
            f"{counted(int(np.sum(~keep)), 'face')} with fewer than three corners left out, the first is face {face}"
        )
        notices.append(Notice(path, None, message))
    if unknown_holes:
        notices.append(Notice(path, None, f"{unknown_holes} holeIndices name no face and are ignored"))
    return notices


def _odd_controls(usd: UsdGeom.Mesh) -> list[Notice]:
    """Notices of topology controls undefined in USD or, against USD's rules, varying in time."""
    path, notices = str(usd.GetPath()), []
    for name, tokens in _CONTROLS.items():
        attribute = usd.GetPrim().GetAttribute(name)
        value = attribute.Get(Usd.TimeCode.EarliestTime())
        if value not in tokens:
            message = f"{name} is {value!r}; USD knows {', '.join(tokens)}; {tokens[0]} assumed"
            notices.append(Notice(path, None, message))
        if attribute.GetNumTimeSamples() > 1:
            notices.append(Notice(path, None, f"{name} has time samples, which USD does not allow; the first is used"))
    return notices


class PointReader:
    """Reads and repairs local points of one mesh.

    Attributes:
        count: Number of points, the same at every time.
        edges: Edges of the mesh, by which points are repaired, shape (E, 2); set when the topology is known.
    """

    def __init__(self, prim: Usd.Prim, first: float | None) -> None:
        """Read the number of points of a mesh prim at a time code."""
        self.path = str(prim.GetPath())
        self._attribute = UsdGeom.Mesh(prim).GetPointsAttr()
        self._times = sorted(self._attribute.GetTimeSamples())
        self.count = len(self._raw(first))
        self.edges = np.zeros((0, 2), np.int32)

    def read(self, time: float | None) -> tuple[np.ndarray, tuple[Notice, ...]]:
        """Local positions [stage units] at a time code, shape (V, 3), float64, all finite, and notices of repairs.

        Raises:
            GarmentError: When the number of points changes or too many are broken.
        """
        points = self._raw(time)
        if len(points) != self.count:
            message = f"the number of points changes from {self.count} to {len(points)}"
            remedy = "export the garment with one topology, or use --frames for the part where it is the same"
            raise GarmentError(self.path, message, time=time, remedy=remedy)
        points = gather_unused(points, self.edges)
        finite = np.isfinite(points)
        if finite.all():
            return points, ()
        broken = ~finite.all(axis=1)
        if broken.mean() > MOST_BROKEN and broken.sum() > 1:
            message = (
                f"{broken.sum()} of {self.count} points are NaN or infinite, the first is points[{broken.argmax()}]"
            )
            remedy = "cache that frame again, or leave it out with --frames"
            raise GarmentError(self.path, message, time=time, remedy=remedy)
        reference = self._good_sample(time)
        repaired = repair(points, self.edges, reference)
        if not np.isfinite(repaired).all():
            message = (
                f"points[{broken.argmax()}] is NaN or infinite, with no neighbour or other sample to repair it from"
            )
            raise GarmentError(self.path, message, time=time, remedy="cache that frame again")
        listed = ", ".join(f"points[{index}]" for index in np.flatnonzero(broken)[:3])
        ellipsis = " ..." if broken.sum() > 3 else ""
        message = (
            f"{listed}{ellipsis} NaN or infinite: {broken.sum()} repaired from neighbours and the nearest good sample"
        )
        return repaired, (Notice(self.path, time, message),)

    def _raw(self, time: float | None) -> np.ndarray:
        leave_if_asked()
        return as_points(value_at(self._attribute, time), self.path, "points", time=time)

    def _good_sample(self, time: float | None) -> np.ndarray | None:
        """The nearest earlier sample with only finite points, or the nearest later."""
        at = -np.inf if time is None else time
        earlier = [time for time in reversed(self._times) if time < at]
        for candidate in (*earlier, *(later for later in self._times if later > at)):
            points = (
                self._raw(candidate) if self._attribute.Get(candidate) else np.zeros((0, 3))
            )  # The sample may be blocked.
            if len(points) == self.count and np.isfinite(points).all():
                return points
        return None


def gather_unused(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Positions with the points that are in no face at a point of a face, shape (V, 3): only faces are cloth."""
    used = np.zeros(len(points), bool)
    used[edges.ravel()] = True
    if used.all() or not used.any():
        return points
    return np.where(used[:, None], points, points[used.argmax()])


def as_points(value: object, path: str, name: str, *, time: float | None = None) -> np.ndarray:
    """Convert a USD array of three-vectors to positions, shape (V, 3), float64; GarmentError for other types."""
    if value is None:
        raise GarmentError(path, f"has no {name}", time=time, remedy="author point3f[] points, or leave the prim out")
    array = np.asarray(value)
    if array.ndim == 2 and array.shape[1] == 3:
        return array.astype(np.float64)
    if array.size == 0 and array.ndim:
        return np.zeros((0, 3))
    kind = type(value).__name__
    raise GarmentError(path, f"{name} is a {kind}, not an array of positions", time=time, remedy="author point3f[]")


def repair(points: np.ndarray, edges: np.ndarray, reference: np.ndarray | None) -> np.ndarray:
    """Replace non-finite points, shape (V, 3), ring by ring inwards; finite points are unchanged to the bit.

    ``reference`` are the positions at a sample with only finite points, shape (V, 3), or None. Points for which nothing
    is available stay as they are. Edges have shape (E, 2).
    """
    base = np.zeros_like(points) if reference is None else reference
    out = points.copy()
    directed = np.concatenate([edges, edges[:, ::-1]]).astype(np.int64) if len(edges) else np.zeros((0, 2), np.int64)
    while True:
        finite = np.asarray(np.isfinite(out).all(axis=1))
        use = directed[~finite[directed[:, 0]] & finite[directed[:, 1]]]
        if len(use) == 0:
            break
        total, count = np.zeros_like(out), np.zeros(len(out))
        np.add.at(total, use[:, 0], out[use[:, 1]] - base[use[:, 1]])
        np.add.at(count, use[:, 0], 1.0)
        has_neighbours = count > 0
        out[has_neighbours] = base[has_neighbours] + total[has_neighbours] / count[has_neighbours, None]
    unfilled = np.flatnonzero(~np.isfinite(out).all(axis=1))
    if reference is not None:
        out[unfilled] = reference[unfilled]
    return out
