"""Writes targets, frame after frame: points, normals, extents and velocities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...solver.mesh.subdivide import Refinement
from ..mesh.bind import Follower
from ..read.bindings import GarmentBindings, PlacedTarget
from ..read.find import instance_roots
from ..read.placement import to_metres
from ..read.reader import Shot
from ..read.targets import Target
from . import overs
from .primvars import hide_influences
from .stream import LayerStream
from .track import ModelHints, PointTrack

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
        velocities: bool,
    ) -> None:
        """Bind the targets of a garment, by number and refinements, coarse to fine, and author constant properties.

        Args:
            absent: Time codes at which the garment is absent.
            velocities: Whether velocities are authored for all.
        """
        self._bindings = GarmentBindings(shot, index, steps)
        given = {"still": shot.sources[index].still, "absent": absent, "velocities": velocities}
        self._tracks = [_TargetTrack(stream, shot, target, **given) for target in self._bindings.targets]
        self.notices = [notice for track in self._tracks for notice in track.notices]

    @property
    def paths(self) -> list[Sdf.Path]:
        """Paths of the targets."""
        return [target.path for target in self._bindings.targets]

    def write(self, time: float | None, points: np.ndarray, *, changed: bool, cut: bool) -> None:
        """Write one time code; points are those of the refined garment [m], world space, shape (V, 3)."""
        for track, placed in zip(self._tracks, self._bindings.at(time, points), strict=True):
            track.write(time, placed, changed=changed, cut=cut)

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
        velocities: bool,
    ) -> None:
        """Author constant properties, and start the track."""
        prim, path = shot.stage.GetPrimAtPath(target.path), target.path
        shape = UsdGeom.PointBased(prim)
        self._metres, self._prim = shot.metres_per_unit, prim
        self.notices = overs.open_instances(stream, path, instance_roots(prim))
        overs.author_unskinned(stream, path, prim, skinned=target.skinned)
        hide_influences(stream, path, prim)
        authored = shape.GetVelocitiesAttr().HasAuthoredValue()
        rate = shot.stage.GetTimeCodesPerSecond() if velocities or authored else None
        if shape.GetAccelerationsAttr().HasAuthoredValue():
            stream.block(path.AppendProperty("accelerations"), Sdf.ValueTypeNames.Vector3fArray)
        moves = {"rate": rate, "absent": absent, "still": still, "margin": _half_width(prim)}
        self._normals = _TurnedNormals.of(stream, shot, target)
        given = None if self._normals is None else self._normals.path
        default = shape.GetPointsAttr().Get(Usd.TimeCode.Default())
        fits = default is not None and len(default) == len(target.points)
        rest = np.asarray(default, np.float32) if fits else None
        self._track = PointTrack(stream, path, None, rest=rest, given_normals=given, **moves)
        self._hints = ModelHints(stream, shot.stage, path, purpose=UsdGeom.Imageable(prim).ComputePurpose())

    def write(self, time: float | None, placed: PlacedTarget, *, changed: bool, cut: bool) -> None:
        """Write one time code; ``changed`` and ``cut`` are those of the cloth, as in `PointTrack.write`."""
        to_world = to_metres(self._prim, self._metres, time)
        normals = None if self._normals is None else self._normals.at(placed.follower, to_world)
        moves = {"changed": changed or placed.target.detail, "cut": cut}
        self._track.write(time, placed.points, to_world, normals=normals, **moves)
        self._hints.write(time, self._track.box)

    def finish(self) -> None:
        """Author pending samples at the end."""
        self._track.finish()


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
            attribute, kind, values = primvar.GetAttr(), primvar.GetInterpolation(), primvar.ComputeFlattened(code)
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


def _owners(target: Target, interpolation: str) -> np.ndarray | None:
    """The point of each value of an interpolation; None where values have no point."""
    if interpolation in ("vertex", "varying"):
        return np.arange(len(target.points))
    if target.mesh is None:
        return None
    corners = {"faceVarying": target.mesh.indices, "uniform": target.mesh.indices[target.mesh.starts[:-1]]}
    return corners.get(interpolation)


def _half_width(prim: Usd.Prim) -> float:
    """Half the greatest width of curves or points [stage units]; 0 of a mesh."""
    for kind in (UsdGeom.Curves, UsdGeom.Points):
        if shape := kind(prim):
            widths = shape.GetWidthsAttr().Get(_FIRST)
            return 0.5 * float(max(widths)) if widths else 0.0
    return 0.0
