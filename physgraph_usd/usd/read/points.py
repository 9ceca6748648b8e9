"""A garment's points at a time, with broken ones repaired.

Repair: a point that is not finite is put where its finite neighbours moved it since the last good sample: its own
position there plus the neighbours' mean displacement. Without finite neighbours it is held there; without an earlier
good sample the next good one is used; without either it is the mean of its neighbours. It reads only the stage, never
what was read before, so the order in which frames are read does not matter. A frame in which more than a tenth of the
points are broken is refused.
"""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom

from ...errors import GarmentError
from ..stage import Notice

MOST_BROKEN = 0.1
"""Largest part of the points that repair may replace."""


class PointReader:
    """Reads and repairs local points of one mesh.

    Attributes:
        path: Prim path.
        count: Number of points, the same at every time.
    """

    def __init__(self, prim: Usd.Prim, first: float | None) -> None:
        """Take the points of a mesh prim; ``first`` is the time code whose number of points counts."""
        self.path = str(prim.GetPath())
        self._attribute = UsdGeom.Mesh(prim).GetPointsAttr()
        self._times = self._attribute.GetTimeSamples()
        self.count = len(self._raw(first))

    def read(self, time: float | None, edges: np.ndarray) -> tuple[np.ndarray, tuple[Notice, ...]]:
        """Read the points at a time code.

        Args:
            time: Time code, or None for the default.
            edges: Edges of the mesh, shape (E, 2).

        Returns:
            Local positions [stage units], shape (V, 3), float64, all finite, and what was repaired.

        Raises:
            GarmentError: When the number of points changes or too many are broken.
        """
        points = self._raw(time)
        if len(points) != self.count:
            said = f"the number of points changes from {self.count} to {len(points)}"
            remedy = "export the garment with one topology, or use --frames for the part where it is the same"
            raise GarmentError(self.path, said, time=time, remedy=remedy)
        broken = ~np.isfinite(points).all(axis=1)
        if not broken.any():
            return points, ()
        if broken.mean() > MOST_BROKEN and broken.sum() > 1:
            said = f"{broken.sum()} of {self.count} points are NaN or infinite, the first is points[{broken.argmax()}]"
            remedy = "cache that frame again, or leave it out with --frames"
            raise GarmentError(self.path, said, time=time, remedy=remedy)
        reference = self._good_sample(time)
        repaired = repair(points, edges, reference)
        if not np.isfinite(repaired).all():
            said = f"points[{broken.argmax()}] is NaN or infinite, with no neighbour or other sample to repair it from"
            raise GarmentError(self.path, said, time=time, remedy="cache that frame again")
        which = ", ".join(f"points[{index}]" for index in np.flatnonzero(broken)[:3])
        more = " ..." if broken.sum() > 3 else ""
        said = f"{which}{more} NaN or infinite: {broken.sum()} repaired from neighbours and the nearest good sample"
        return repaired, (Notice(self.path, time, said),)

    def _raw(self, time: float | None) -> np.ndarray:
        value = self._attribute.Get(Usd.TimeCode.Default() if time is None else Usd.TimeCode(time))
        if value is None:
            value = self._attribute.Get(Usd.TimeCode.EarliestTime())
        return as_points(value, self.path, "points", time=time)

    def _good_sample(self, time: float | None) -> np.ndarray | None:
        """The nearest earlier sample whose points are all finite, else the nearest later one."""
        at = -np.inf if time is None else time
        earlier = [each for each in reversed(self._times) if each < at]
        for each in (*earlier, *(later for later in self._times if later > at)):
            points = self._raw(each)
            if len(points) == self.count and np.isfinite(points).all():
                return points
        return None


def as_points(value: object, path: str, name: str, *, time: float | None = None) -> np.ndarray:
    """Turn any USD array of three-vectors into positions, shape (V, 3), float64.

    Raises:
        GarmentError: When there is no value or it is of another kind.
    """
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
    """Replace points that are not finite, ring by ring inwards.

    Args:
        points: Positions, shape (V, 3).
        edges: Edges, shape (E, 2).
        reference: Positions at a sample where all are finite, shape (V, 3), or None.

    Returns:
        Repaired positions, shape (V, 3); what could not be repaired is left as it was. Others keep their bits.
    """
    base = np.zeros_like(points) if reference is None else reference
    out = points.copy()
    both = np.concatenate([edges, edges[:, ::-1]]).astype(np.int64) if len(edges) else np.zeros((0, 2), np.int64)
    while True:
        finite = np.asarray(np.isfinite(out).all(axis=1))
        use = both[~finite[both[:, 0]] & finite[both[:, 1]]]
        if len(use) == 0:
            break
        total, count = np.zeros_like(out), np.zeros(len(out))
        np.add.at(total, use[:, 0], out[use[:, 1]] - base[use[:, 1]])
        np.add.at(count, use[:, 0], 1.0)
        some = count > 0
        out[some] = base[some] + total[some] / count[some, None]
    left = np.flatnonzero(~np.isfinite(out).all(axis=1))
    if reference is not None:
        out[left] = reference[left]
    return out
