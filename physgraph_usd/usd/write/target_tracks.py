"""Writes targets, frame after frame: points, or instances, with normals or orientations, extents and velocities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt
from scipy.spatial.transform import Rotation

from ...solver.mesh.subdivide import Refinement
from ...solver.scene import GarmentResult
from ..instances import instance_reach
from ..mesh.bind import Follower
from ..read.bindings import GarmentBindings, PlacedTarget
from ..read.find import instance_roots
from ..read.placement import to_metres
from ..read.reader import Shot
from ..read.targets import Target, points_attribute
from ..stage import flattened, timecode
from . import overs
from .primvars import hide_influences
from .stream import LayerStream
from .track import BoundsAbove, PointTrack

_FIRST = Usd.TimeCode.EarliestTime()


class TargetTracks:
    """The targets of one garment during writing.

    Attributes:
        notices: Properties changed, with the reason.
    """

    def __init__(
        self,
        stream: LayerStream,
        shot: Shot,
        index: int,
        *,
        steps: Sequence[Refinement],
        absent: Sequence[float],
        outside: Sequence[float],
        velocities: bool,
    ) -> None:
        """Bind the targets of a garment, by number and refinements, coarse to fine, and author constant properties.

        Args:
            absent: Time codes at which the garment is absent.
            outside: The shot's time codes without a sample of the garment in the layer, ascending.
            velocities: Whether velocities are authored for all.
        """
        self._bindings = GarmentBindings(shot, index, steps)
        still = shot.sources[index].still
        self._tracks = [
            _TargetTrack(stream, shot, target, still=still, absent=absent, outside=outside, velocities=velocities)
            for target in self._bindings.targets
        ]
        self.notices = [notice for track in self._tracks for notice in track.notices]

    @property
    def paths(self) -> list[Sdf.Path]:
        """Paths of the targets."""
        return [target.path for target in self._bindings.targets]

    def write(self, time: float | None, garment: GarmentResult, *, cut: bool) -> None:
        """Write a time code at which the garment has points."""
        if garment.points is None:
            return
        for track, placed in zip(self._tracks, self._bindings.at(time, garment.points), strict=True):
            track.write(time, placed, changed=not garment.reused, cut=cut)

    def finish(self) -> None:
        """Author pending samples at the end."""
        for track in self._tracks:
            track.finish()


class _TargetTrack:
    """One target during writing."""

    def __init__(
        self,
        stream: LayerStream,
        shot: Shot,
        target: Target,
        *,
        still: bool,
        absent: Sequence[float],
        outside: Sequence[float],
        velocities: bool,
    ) -> None:
        """Author constant properties, and start the track."""
        prim, path = shot.stage.GetPrimAtPath(target.path), target.path
        self._metres, self._prim = shot.metres_per_unit, prim
        self.notices = overs.open_instances(stream, path, instance_roots(prim))
        overs.author_unskinned(stream, path, prim, skinned=target.skinned)
        hide_influences(stream, path, prim)
        authored = prim.GetAttribute("velocities").HasAuthoredValue()
        rate = shot.stage.GetTimeCodesPerSecond() if velocities or authored else None
        for name in ("accelerations", "angularVelocities"):
            if prim.GetAttribute(name).HasAuthoredValue():
                stream.block(path.AppendProperty(name), Sdf.ValueTypeNames.Vector3fArray)
        turned = _Orientations if UsdGeom.PointInstancer(prim) else _TurnedNormals
        self._turned = turned.of(stream, shot, target)
        turned_path, points = None if self._turned is None else self._turned.path, points_attribute(prim)
        default = None if still else shot.default_points(path)
        fits = default is not None and len(default) == len(target.points)
        rest = np.asarray(default, np.float32) if fits else None
        self._track = PointTrack(
            stream,
            path,
            None,
            rest=rest,
            turned=turned_path,
            points=points.GetName(),
            rate=rate,
            absent=absent,
            outside=outside,
            still=still,
            margin=_half_width(prim),
        )
        self._bounds = BoundsAbove(stream, shot.stage, path, purpose=UsdGeom.Imageable(prim).ComputePurpose())

    def write(self, time: float | None, placed: PlacedTarget, *, changed: bool, cut: bool) -> None:
        """Write a time code; ``changed`` and ``cut`` are the cloth's, as in `PointTrack.write`."""
        to_world = to_metres(self._prim, self._metres, time)
        normals = None if self._turned is None else self._turned.at(placed.follower, to_world)
        changed = changed or placed.target.detail
        self._track.write(time, placed.points, to_world, normals=normals, changed=changed, cut=cut)
        self._bounds.write(time, self._track.box)

    def finish(self) -> None:
        """Author pending samples at the end."""
        self._track.finish()
        self._bounds.finish()


class _TurnedNormals:
    """Authored normals of a target, turned with the points.

    Attributes:
        path: The attribute, normals or primvars:normals; the interpolation stays.
    """

    def __init__(self, path: Sdf.Path, normals: np.ndarray, owner: np.ndarray) -> None:
        """Take normals in world space in the bind pose, shape (M, 3), and the point of each, shape (M,)."""
        self.path, self._normals, self._owner = path, normals, owner

    @classmethod
    def of(cls, stream: LayerStream, shot: Shot, target: Target) -> _TurnedNormals | None:
        """The normals of a target, primvar or attribute; None without any that follow points."""
        prim = shot.stage.GetPrimAtPath(target.path)
        code = Usd.TimeCode.Default() if target.time is None else Usd.TimeCode(target.time)
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals")
        attribute, kind = UsdGeom.PointBased(prim).GetNormalsAttr(), UsdGeom.PointBased(prim).GetNormalsInterpolation()
        values = attribute.Get(code) if attribute.HasAuthoredValue() else None
        if primvar and primvar.HasAuthoredValue():
            attribute, kind, values = primvar.GetAttr(), primvar.GetInterpolation(), flattened(primvar, code)
        owner = _owners(target, kind)
        if values is None or owner is None or len(values) != len(owner):
            return None
        path = target.path.AppendProperty(attribute.GetName())
        if attribute.GetName().startswith("primvars:") and primvar.IsIndexed():
            stream.block(target.path.AppendProperty(f"{attribute.GetName()}:indices"), Sdf.ValueTypeNames.IntArray)
        stream.attribute(path, Sdf.ValueTypeNames.Normal3fArray, interpolation=kind)
        linear = np.linalg.inv(to_metres(prim, shot.metres_per_unit, target.time)[:3, :3])
        return cls(path, np.asarray(values, float) @ linear, owner)

    def at(self, follower: Follower, to_world: np.ndarray) -> np.ndarray:
        """Unit normals in local space, shape (M, 3), float32, by the matrix from local space to world metres."""
        turned = follower.turned(self._normals, self._owner) @ to_world[:3, :3]
        lengths = np.linalg.norm(turned, axis=1, keepdims=True)
        return (turned / np.maximum(lengths, 1e-30)).astype(np.float32)


class _Orientations:
    """Orientations of instances, turned with their positions.

    Attributes:
        path: The attribute, orientations or orientationsf.
    """

    def __init__(self, path: Sdf.Path, axes: np.ndarray, kind: type) -> None:
        """Take the axes of each instance in world space in the bind pose, shape (N, 3, 3), and the type of numbers."""
        self.path, self._axes, self._kind = path, axes, kind
        self._last = np.zeros((len(axes), 4))

    @classmethod
    def of(cls, stream: LayerStream, shot: Shot, target: Target) -> _Orientations:
        """The orientations of a target; of one without, none turned in the bind pose."""
        prim, code = shot.stage.GetPrimAtPath(target.path), timecode(target.time)
        names = "orientationsf", "orientations"
        name = next((name for name in names if prim.GetAttribute(name).HasAuthoredValue()), names[1])
        values = prim.GetAttribute(name).Get(code)
        orientations = (
            values if isinstance(values, Vt.QuathArray | Vt.QuatfArray) and len(values) == len(target.points) else ()
        )
        quaternions = [[*orientation.GetImaginary(), orientation.GetReal()] for orientation in orientations]
        fits = len(quaternions) > 0 and np.isfinite(quaternions).all() and np.linalg.norm(quaternions, axis=1).all()
        local = Rotation.from_quat(quaternions).as_matrix() if fits else np.tile(np.eye(3), (len(target.points), 1, 1))
        single = name == names[0]
        path, types = target.path.AppendProperty(name), Sdf.ValueTypeNames
        stream.attribute(path, types.QuatfArray if single else types.QuathArray)
        axes = to_metres(prim, shot.metres_per_unit, target.time)[:3, :3] @ local
        return cls(path, axes, np.float32 if single else np.float16)

    def at(self, follower: Follower, to_world: np.ndarray) -> np.ndarray:
        """Quaternions with the real part last in local space, shape (N, 4), by the matrix to world metres."""
        count = len(self._axes)
        vectors = self._axes.swapaxes(1, 2).reshape(-1, 3)
        turned = follower.turned(vectors, np.repeat(np.arange(count), 3)) * np.linalg.norm(vectors, axis=1)[:, None]
        local = np.linalg.inv(to_world[:3, :3]) @ turned.reshape(-1, 3, 3).swapaxes(1, 2)
        u, _, v = np.linalg.svd(local)
        u[:, :, 2] *= np.linalg.det(u @ v)[:, None]
        rotations = Rotation.from_matrix(u @ v).as_quat()
        rotations *= np.where(np.einsum("nq,nq->n", rotations, self._last) < 0.0, -1.0, 1.0)[:, None]
        self._last = rotations
        return rotations.astype(self._kind)


def _owners(target: Target, interpolation: str) -> np.ndarray | None:
    """The point of each value of an interpolation; None where values have no point."""
    if interpolation in ("vertex", "varying"):
        return np.arange(len(target.points))
    if target.mesh is None:
        return None
    corners = {"faceVarying": target.mesh.indices, "uniform": target.mesh.indices[target.mesh.starts[:-1]]}
    return corners.get(interpolation)


def _half_width(prim: Usd.Prim) -> float:
    """Half the greatest width of curves or points, or the reach of instances about their positions; 0 of a mesh."""
    if UsdGeom.PointInstancer(prim):
        return instance_reach(prim)
    for kind in (UsdGeom.Curves, UsdGeom.Points):
        if shape := kind(prim):
            widths = shape.GetWidthsAttr().Get(_FIRST)
            return 0.5 * float(max(widths)) if widths else 0.0
    return 0.0
