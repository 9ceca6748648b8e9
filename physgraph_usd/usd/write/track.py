"""Writes the animated opinions of a garment, time code by time code.

Points, normals, extent and velocities; heat maps of depth inside bodies and of crossings; and the bounds authored on
ancestors, possibly too small for the finer cloth.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from ...errors import LayerError
from ..instances import placements
from ..lookup import with_ancestors
from ..stage import at_time, timecode
from ..times import SAME_TIME
from .normals import VertexNormals
from .stream import LayerStream

PREFIX = "primvars:physgraph:"
HEAT = ("penetration", "crossing")
"""Depth in the deepest body [mm], 0 outside; and 1 at the corners of crossing edges and faces, 0 elsewhere."""
ATTRIBUTE = "extentsHint"
TYPES = {
    "points": Sdf.ValueTypeNames.Point3fArray,
    "normals": Sdf.ValueTypeNames.Normal3fArray,
    "extent": Sdf.ValueTypeNames.Float3Array,
    "velocities": Sdf.ValueTypeNames.Vector3fArray,
}
"""Attributes of a garment written frame by frame."""
_FIRST = Usd.TimeCode.EarliestTime()
_PURPOSES = ("default", "render", "proxy", "guide")


@dataclass(frozen=True, eq=False)
class _Sample:
    """Local points at one time code, shape (V, 3), and given normals or orientations, shape (M, 3 or 4), or None."""

    time: float
    points: np.ndarray
    normals: np.ndarray | None = None


def refuse_not_finite(values: np.ndarray, place: str) -> None:
    """Refuse (LayerError) NaN or infinite values, naming the first; ``place`` begins the message."""
    if not np.isfinite(values).all():
        first = int(np.argwhere(~np.isfinite(values))[0][0])
        raise LayerError(f"{place}: value {first} is {values[first].tolist()}, not finite")


def _set_sample(stream: LayerStream, path: Sdf.Path, values: np.ndarray, time: float | None) -> None:
    """Author solved values; all solved values enter the layer here, checked to be finite."""
    refuse_not_finite(values, f"<{path}>" + at_time(time))
    kind: Any = Vt.FloatArray if values.ndim == 1 else {"f2": Vt.QuathArray, "f4": Vt.QuatfArray}[values.dtype.str[1:]]
    kind = Vt.Vec3fArray if values.shape[1:] == (3,) else kind
    stream.set(path, kind.FromNumpy(values), time=time)


class PointTrack:
    """Writes one garment's samples in order, holding at most three in memory.

    Only the first and last of a run of equal samples are written; USD gives the same value in between. With velocities
    every sample is written, because each velocity belongs to a sample's time.

    Velocities are differences of samples connected by continuous motion. A sample without connected neighbours gets the
    shot's own velocity, or a block. Samples beside the layer's, where points are held, have velocity zero.

    Attributes:
        box: Extent of the last sample.
        unknown: Time codes of the samples with blocked velocities.
    """

    def __init__(
        self,
        stream: LayerStream,
        target: Sdf.Path,
        normals: VertexNormals | None,
        *,
        rest: np.ndarray | None,
        still: bool,
        rate: float | None,
        margin: float = 0.0,
        turned: Sdf.Path | None = None,
        points: str = "points",
        own: Callable[[float | None], np.ndarray | None] = lambda _: None,
        absent: Sequence[float] = (),
        outside: Sequence[float] = (),
    ) -> None:
        """Author the attributes, without values.

        Args:
            normals: Computes normals of local points; None without.
            rest: Local points for the default time, shape (V, 3); if None, the first sample's points.
            still: Whether the garment itself has no samples: only a default is written until the cloth moves.
            rate: Time codes per second for velocities; None leaves velocities out.
            turned: Attribute of normals or orientations given with each sample, authored by the caller; None without.
            points: Name of the attribute of the points.
            margin: Distance by which the extent exceeds the points, such as half the width of curves.
            own: The shot's velocities at a time code [units/s], shape (V, 3), float32; None without velocities.
            absent: Time codes to block, ascending: the garment is absent.
            outside: The shot's time codes without a sample in the layer, ascending.
        """
        self._stream, self._normals, self._margin = stream, normals, np.float32(margin)
        self._paths = {name: target.AppendProperty(points if name == "points" else name) for name in TYPES}
        stream.attribute(self._paths["points"], TYPES["points"])
        if normals is not None:
            stream.attribute(self._paths["normals"], TYPES["normals"], interpolation=UsdGeom.Tokens.vertex)
        stream.attribute(self._paths["extent"], TYPES["extent"])
        self._has_normals = normals is not None or turned is not None
        if turned is not None:
            self._paths["normals"] = turned
        self._rest, self._still, self._rate, self._own = rest, still, rate, own
        self._absent, self._outside = list(absent), outside
        self.unknown: list[float] = []
        self._has_default = False
        self._last: _Sample | None = None
        self._matrix: np.ndarray | None = None
        self._run_end: float | None = None
        self._queue: list[_Sample] = []
        self.box = np.zeros((2, 3), np.float32)

    def write(
        self,
        time: float | None,
        points: np.ndarray,
        to_metres: np.ndarray,
        *,
        normals: np.ndarray | None = None,
        changed: bool = True,
        cut: bool = False,
    ) -> None:
        """Write one time code.

        Args:
            time: Time code, or None for the default of a shot without samples.
            points: Fine points [m], world space, shape (V, 3).
            to_metres: Local space to world metres, shape (4, 4), for column vectors.
            normals: For a track of given ones, local normals, shape (M, 3), or orientations, quaternions with the real
                part last, shape (M, 4).
            changed: False when the world points are known to equal the previous sample's.
            cut: Whether the cloth jumps to this sample from the previous sample.

        Raises:
            LayerError: The points are not finite, or the matrix cannot be inverted.
        """
        if time is not None:
            self._block_until(time)
        if cut and self._rate is not None and time is not None:
            self._end_stretch()
        same_matrix = self._matrix is not None and np.array_equal(self._matrix, to_metres)
        if not changed and same_matrix and self._last is not None and time is not None:
            self._take(_Sample(time, self._last.points, self._last.normals), moved=False)
            return
        self._matrix = to_metres
        points = to_local(points, to_metres, str(self._paths["points"].GetPrimPath()), time)
        if not self._has_default:
            self._author(None, points if self._rest is None else self._rest, normals if self._still else None)
            self._has_default, self._rest = True, None
            if self._still and self._rate is not None and (velocity := self._own(time)) is not None:
                self._set_velocity(None, velocity)
        if time is None:
            self.box = self._extent(points)
            return
        moved = self._last is None or not np.array_equal(points, self._last.points)
        self._take(_Sample(time, points, normals), moved=moved)

    def _take(self, sample: _Sample, *, moved: bool) -> None:
        """Author a sample, and the end of the previous run; a sample equal to the previous sample extends the run."""
        last = self._last
        if last is not None and not moved:
            if self._rate is None or self._still:
                self._run_end = sample.time
            else:
                self._emit(sample)
            return
        if last is None:
            self.box = self._extent(sample.points)
        elif self._still:
            self._still = False
            self._emit(last)
        self._end_run()
        self._last = sample
        if not self._still:
            self._emit(sample)

    def _end_run(self) -> None:
        """Author the last of a run of equal samples."""
        if self._run_end is not None and self._last is not None and not self._still:
            self._emit(_Sample(self._run_end, self._last.points, self._last.normals))
            self._run_end = None

    def _emit(self, sample: _Sample) -> None:
        """Author a sample, and the velocity of the sample before."""
        self._author(sample.time, sample.points, sample.normals)
        if self._rate is None:
            return
        self._queue.append(sample)
        if len(self._queue) > 1:
            self._author_velocity(self._queue[-2], self._queue[0], sample)
            del self._queue[:-2]

    def finish(self) -> None:
        """Author the last velocity, and the blocks after the last sample."""
        if self._absent:
            self._end_run()
        self._end_stretch()
        self._block_until(np.inf)
        if self._rate is not None:
            _hold(self._stream, self._paths, self._outside)

    def _end_stretch(self) -> None:
        """Author the velocity of the last sample before a cut, a block or the end."""
        if self._queue:
            self._author_velocity(self._queue[-1], self._queue[0], self._queue[-1])
            self._queue.clear()

    def _block_until(self, time: float) -> None:
        """Author blocks at the garment's absences before a time code; samples after a block start a new run."""
        while self._absent and self._absent[0] < time:
            self._end_run()
            self._end_stretch()
            self._last = self._matrix = None
            blocked = self._absent.pop(0)
            optional = {"normals": self._has_normals, "velocities": self._rate is not None}
            for name in ("points", "extent", *(name for name, is_wanted in optional.items() if is_wanted)):
                self._block(name, blocked)

    def _block(self, name: str, time: float) -> None:
        self._stream.attribute(self._paths[name], TYPES[name])
        self._stream.set(self._paths[name], Sdf.ValueBlock(), time=time)

    def _author(self, time: float | None, points: np.ndarray, normals: np.ndarray | None = None) -> None:
        """Author points, extent, and normals if given or computed, at one time."""
        self.box = self._extent(points)
        values = {"points": points, "extent": self.box}
        normals = normals if self._normals is None else self._normals(points)
        values |= {} if normals is None else {"normals": normals}
        for name, value in values.items():
            _set_sample(self._stream, self._paths[name], value, time)

    def _extent(self, points: np.ndarray) -> np.ndarray:
        """Least and greatest corner with the margin, shape (2, 3), float32."""
        return extent_of(points) + np.array([[-self._margin], [self._margin]], np.float32)

    def _author_velocity(self, at: _Sample, before: _Sample, after: _Sample) -> None:
        """Author the velocity of a sample: by finite differences, the shot's own for an isolated sample, or a block."""
        velocity = _difference(at, before, after, rate=self._rate or 24.0)
        velocity = self._own(at.time) if velocity is None else velocity
        if velocity is not None:
            self._set_velocity(at.time, velocity)
        else:
            self._block("velocities", at.time)
            self.unknown.append(at.time)

    def _set_velocity(self, time: float | None, velocity: np.ndarray) -> None:
        self._stream.attribute(self._paths["velocities"], TYPES["velocities"])
        _set_sample(self._stream, self._paths["velocities"], np.ascontiguousarray(velocity, np.float32), time)


def _difference(at: _Sample, before: _Sample, after: _Sample, *, rate: float) -> np.ndarray | None:
    """Velocity of a sample between two others, by finite differences [units/s]; None if all three are the same sample.

    The velocity of cloth that begins or ends to move at the sample is that of its motion, not half of it.
    """
    stops = [beside is not at and np.array_equal(beside.points, at.points) for beside in (before, after)]
    if stops == [True, False] and after is not at:
        before = at
    elif stops == [False, True] and before is not at:
        after = at
    if after.time - before.time <= SAME_TIME:
        return None
    return (after.points.astype(np.float64) - before.points) / ((after.time - before.time) / rate)


def _hold(stream: LayerStream, paths: Mapping[str, Sdf.Path], outside: Sequence[float]) -> None:
    """Repeat the first and the last of several samples, with velocity zero, at the time codes beside them.

    Args:
        paths: Attributes of a garment or target by name.
        outside: The shot's time codes without a sample in the layer, ascending.
    """
    written = stream.layer.ListTimeSamplesForPath(paths["points"])
    before = [(time, written[0]) for time in outside if len(written) > 1 and time < written[0]]
    after = [(time, written[-1]) for time in outside if len(written) > 1 and time > written[-1]]
    for time, nearest in (*before[-1:], *after[:1]):
        for name, path in paths.items():
            value = stream.layer.QueryTimeSample(path, nearest)
            if name == "velocities" and isinstance(value, Vt.Vec3fArray):
                value = Vt.Vec3fArray(len(value))
            if value is not None:
                stream.set(path, value, time=time)


def to_local(world: np.ndarray, to_metres: np.ndarray, path: str, time: float | None) -> np.ndarray:
    """Convert world metres to local units, shape (V, 3): float64 inside, float32 out.

    Args:
        world: Positions [m], shape (V, 3).
        to_metres: Local space to world metres, shape (4, 4), for column vectors.
        path: The prim, for the message.
        time: The time code, for the message.

    Raises:
        LayerError: A position is not finite, or the matrix cannot be inverted.
    """
    when = at_time(time)
    try:
        inverse = np.linalg.inv(to_metres[:3, :3])
    except np.linalg.LinAlgError as error:
        raise LayerError(f"<{path}>{when}: its transform has no inverse (a scale of zero?)") from error
    # Column by column: several times faster than one product with a small matrix.
    x, y, z = (np.asarray(world[:, axis], np.float64) - to_metres[axis, 3] for axis in range(3))
    with np.errstate(invalid="ignore", over="ignore"):
        local = np.stack([(a * x + b * y + c * z).astype(np.float32) for a, b, c in inverse])
    points = np.ascontiguousarray(local.T)
    refuse_not_finite(points, f"<{path}>{when}: points")
    return points


def extent_of(points: np.ndarray) -> np.ndarray:
    """Least and greatest corner, shape (2, 3), float32."""
    if not len(points):
        return np.zeros((2, 3), np.float32)
    columns = np.ascontiguousarray(points.T)
    return np.stack([columns.min(axis=1), columns.max(axis=1)])


class HeatTrack:
    """Writes a garment's heat maps in order; an attribute is authored with the first values.

    Only the first and last of a run of equal samples are written.
    """

    def __init__(self, stream: LayerStream, target: Sdf.Path, count: int, *, still: bool) -> None:
        """Author nothing yet.

        Args:
            count: Number of fine vertices.
            still: Whether the garment itself has no samples: a default is written instead of the first sample.
        """
        self._stream, self._target, self._count, self._still = stream, target, count, still
        self._runs: dict[str, tuple[np.ndarray, float | None]] = {}

    def check(self, heat: Mapping[str, np.ndarray], time: float | None) -> None:
        """Refuse arrays without exactly one number per vertex."""
        for name, values in heat.items():
            location = f"<{self._path(name)}>" + at_time(time)
            if name not in HEAT:
                raise LayerError(f"{location}: no such heat map; known: {', '.join(HEAT)}")
            if values.shape != (self._count,):
                raise LayerError(f"{location}: needs {self._count} values, got shape {values.shape}")

    def write(self, time: float | None, heat: Mapping[str, np.ndarray]) -> None:
        """Write the maps of a time code by name, each of shape (V,); an omitted map gets no sample."""
        for name, array in heat.items():
            values = np.ascontiguousarray(array, np.float32)
            if name not in self._runs:
                path = self._path(name)
                self._stream.attribute(path, Sdf.ValueTypeNames.FloatArray, interpolation=UsdGeom.Tokens.vertex)
                self._set(name, None if self._still else time, values)
                self._runs[name] = values, time if self._still else None
                continue
            last, end = self._runs[name]
            if np.array_equal(values, last):
                self._runs[name] = last, time
                continue
            if end is not None:
                self._set(name, end, last)
            self._set(name, time, values)
            self._runs[name] = values, None

    def _path(self, name: str) -> Sdf.Path:
        return self._target.AppendProperty(PREFIX + name)

    def _set(self, name: str, time: float | None, values: np.ndarray) -> None:
        _set_sample(self._stream, self._path(name), values, time)


class BoundsAbove:
    """Enlarges the authored bounds of one garment's ancestors to contain the fine cloth.

    The bounds are extent hints of models, and the extents of skel roots and point instancers.
    """

    def __init__(self, stream: LayerStream, stage: Usd.Stage, path: Sdf.Path, *, purpose: str) -> None:
        """Find the ancestors of a coarse garment with bounds; the fine mesh's purpose chooses the hint's box."""
        self._stream, self._prim = stream, stage.GetPrimAtPath(path)
        self._row = 2 * _PURPOSES.index(purpose if purpose in _PURPOSES else "default")
        self._boxes = dict[str, list[tuple[float | None, np.ndarray]]]()
        above = [*with_ancestors(self._prim.GetParent())]
        self._instancers = [prim for prim in above if UsdGeom.PointInstancer(prim)]
        bounds = [prim.GetAttribute(ATTRIBUTE) for prim in (self._prim, *above)]
        # A skel root is an Xform while its skinning is baked; a gprim's extent is that of its own points.
        bounds += [prim.GetAttribute("extent") for prim in above if not UsdGeom.Gprim(prim)]
        authored = (attribute for attribute in bounds if attribute and attribute.HasAuthoredValue())
        self._bounds = [attribute for attribute in authored if isinstance(attribute.Get(_FIRST), Vt.Vec3fArray)]

    def write(self, time: float | None, box: np.ndarray) -> None:
        """Enlarge the bounds by the local extent of the fine mesh, shape (2, 3), at a time code."""
        corners = np.array([[box[i][0], box[j][1], box[k][2], 1.0] for i, j, k in product((0, 1), repeat=3)])
        for attribute in self._bounds:
            to_world = np.array(UsdGeom.XformCache(timecode(time)).GetLocalToWorldTransform(attribute.GetPrim()))
            grown = (self._in_world(attribute, time, corners) @ np.linalg.pinv(to_world))[:, :3]
            if np.isfinite(grown).all():
                ends = np.stack([grown.min(axis=0), grown.max(axis=0)])
                self._boxes.setdefault(str(attribute.GetPath()), []).append((time, ends))
                if time is not None or not attribute.GetNumTimeSamples():
                    self._grow(attribute, time, ends)

    def _in_world(self, bound: Usd.Attribute, time: float | None, corners: np.ndarray) -> np.ndarray:
        """Local corners of the garment in the world, shape (N, 4), at each instance that a bound holds."""
        instancers = [
            instancer for instancer in self._instancers if instancer.GetPath().HasPrefix(bound.GetPrim().GetPath())
        ]
        transforms = (placements(instancers[-1], time) or {}).get(self._prim.GetPath()) if instancers else None
        if transforms is None:
            return corners @ np.array(UsdGeom.XformCache(timecode(time)).GetLocalToWorldTransform(self._prim))
        return np.concatenate([corners @ transform.T for transform in transforms])

    def finish(self) -> None:
        """Enlarge the bounds at their other samples by the cloth at the time codes written on either side."""
        for attribute in self._bounds:
            boxes, path = self._boxes.get(str(attribute.GetPath()), []), attribute.GetPath()
            written = [time for time, _ in boxes if time is not None]
            samples = {*attribute.GetTimeSamples(), *self._stream.layer.ListTimeSamplesForPath(path)}
            for time in sorted(samples.difference(written)) if boxes else ():
                after = bisect_left(written, time)
                for _, ends in boxes[max(after - 1, 0) : after + 1]:
                    self._grow(attribute, time, ends)

    def _grow(self, attribute: Usd.Attribute, time: float | None, ends: np.ndarray) -> None:
        """Author the union of a bound and a box, shape (2, 3), at the time code for an animated bound, else default."""
        time = time if attribute.GetNumTimeSamples() > 0 else None
        path = attribute.GetPath()
        spec = self._stream.attribute(path, Sdf.ValueTypeNames.Float3Array)
        grown = self._stream.layer.QueryTimeSample(path, time) if time is not None else spec.default
        value = attribute.Get(timecode(time)) if grown is None else grown
        row = self._row if attribute.GetName() == ATTRIBUTE else 0
        rows = np.array(value if value is not None else [], np.float32).reshape(-1, 3)
        empty = np.tile(np.array([[np.finfo(np.float32).max], [-np.finfo(np.float32).max]], np.float32), (1, 3))
        while len(rows) < row + 2:
            rows = np.concatenate([rows, empty])
        low, high = np.minimum(rows[row], ends[0]), np.maximum(rows[row + 1], ends[1])
        rows[row : row + 2] = low, high
        self._stream.set(path, Vt.Vec3fArray.FromNumpy(rows), time=time)
