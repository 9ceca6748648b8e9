"""Writes what follows a garment: points, normals and velocities of targets, frame after frame."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np
from pxr import Sdf, Usd, UsdGeom
from scipy import sparse

from ...errors import LayerError
from ...solver.mesh.bind import Binding, Follower
from ...solver.mesh.subdivide import Refinement, smooth
from ...solver.mesh.topology import PolygonMesh
from ..read.placement import to_metres
from ..read.reader import Shot
from ..read.targets import Target, points_at, roots_of
from ..stage import Notice, at_time
from . import overs
from .stream import LayerStream
from .track import ModelHints, PointTrack, set_sample

_FIRST = Usd.TimeCode.EarliestTime()


class Followers:
    """The targets of one garment, each after the prim that it is bound to.

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
        """Bind to the smoothly subdivided cage and author what does not change.

        Args:
            stream: The layer.
            shot: The shot.
            index: Number of the garment.
            steps: Its refinements, coarse to fine.
            absent: Time codes at which it is absent.
            velocities: Whether velocities are authored for all.
        """
        garment, targets = shot.scene.garments[index], [each for each in shot.targets if each.garment == index]
        self._shot, self._index = shot, index
        self._smooth = _smooth_map(garment.mesh, steps) if targets else None
        self._fine = steps[-1].mesh if steps else garment.mesh
        self._tracks: dict[Sdf.Path, _BoundTrack] = {}
        self.notices: list[Notice] = []
        for target in targets:
            surface, mesh = self._surface_of(target)
            triangles = mesh.triangulate(surface).triangles
            binding = Binding.of(target.points, surface, triangles, rigid=target.rigid)
            still = not shot.sources[index].times
            given = {"still": still, "absent": absent, "velocities": velocities}
            self._tracks[target.path] = track = _BoundTrack(stream, shot, target, binding, **given)
            self.notices += track.notices

    @property
    def paths(self) -> list[Sdf.Path]:
        """Paths of the targets."""
        return [*self._tracks]

    def _surface_of(self, target: Target) -> tuple[np.ndarray, PolygonMesh]:
        """Bind pose [m] and faces of what a target is bound to."""
        if target.on is None:
            return self._smoothed(target.time), self._fine
        parent = self._tracks[target.on].target
        assert parent.mesh is not None
        return parent.points, parent.mesh

    def _smoothed(self, time: float | None) -> np.ndarray:
        """The smoothly subdivided cage [m] at a time code, shape (V, 3)."""
        cage = self._shot.cage(self._index, time)
        return cage if self._smooth is None else self._smooth @ cage

    def write(self, time: float | None, points: np.ndarray, *, changed: bool, cut: bool) -> None:
        """Write one time code; points are those of the refined garment [m], world space, shape (V, 3)."""
        placed: dict[Sdf.Path, np.ndarray] = {}
        before = np.zeros((0, 3))
        if any(track.target.detail for track in self._tracks.values()):
            before = self._smoothed(time)
        for path, track in self._tracks.items():
            surface = points if track.target.on is None else placed[track.target.on]
            cloth = track.target.detail and track.target.on is None
            placed[path] = track.write(time, surface, before if cloth else None, changed=changed, cut=cut)

    def finish(self) -> None:
        """Author pending samples at the end."""
        for track in self._tracks.values():
            track.finish()


def _smooth_map(mesh: PolygonMesh, steps: Sequence[Refinement]) -> sparse.csr_matrix | None:
    """The smooth map from a cage to its fine mesh, shape (V, C); None at level 0."""
    meshes = [mesh, *(step.mesh for step in steps)]
    maps = [smooth(parent, step) for parent, step in zip(meshes, steps, strict=False)]
    return reduce(lambda product, one: one @ product, maps[1:], maps[0]) if maps else None


class _BoundTrack:
    """One target during writing.

    Attributes:
        target: The target.
        notices: Properties changed, with the reason.
    """

    def __init__(
        self,
        stream: LayerStream,
        shot: Shot,
        target: Target,
        binding: Binding,
        *,
        still: bool,
        absent: Sequence[float],
        velocities: bool,
    ) -> None:
        """Author what does not change, and start the track."""
        prim, path = shot.stage.GetPrimAtPath(target.path), target.path
        self.target, self._binding, self._shot, self._prim = target, binding, shot, prim
        self.notices = overs.open_instances(stream, path, roots_of(shot.stage, target))
        overs.author_unskinned(stream, path, prim, skinned=target.skinned)
        authored = UsdGeom.PointBased(prim).GetVelocitiesAttr().HasAuthoredValue()
        rate = shot.stage.GetTimeCodesPerSecond() if velocities or authored else None
        if UsdGeom.PointBased(prim).GetAccelerationsAttr().HasAuthoredValue():
            stream.block(path.AppendProperty("accelerations"), Sdf.ValueTypeNames.Vector3fArray)
        moves = {"rate": rate, "absent": absent, "still": still, "margin": _half_width(prim)}
        self._track = PointTrack(stream, path, None, rest=_default_points(prim, len(target.points)), **moves)
        self._normals = _TurnedNormals.of(stream, shot, target)
        purpose = UsdGeom.Imageable(prim).ComputePurpose()
        self._hints = ModelHints(stream, shot.stage, path, purpose=purpose)

    def write(
        self, time: float | None, surface: np.ndarray, before: np.ndarray | None, *, changed: bool, cut: bool
    ) -> np.ndarray:
        """Write one time code, and return the points [m] in world space.

        Args:
            time: The time code.
            surface: Positions of what it is bound to [m].
            before: The smoothly subdivided cage [m] where only the difference to it is added, else None.
            changed: False when the cloth is known to equal the previous sample's.
            cut: Whether the cloth jumps here.
        """
        follower = self._binding.at(surface)
        points, to_world = follower.points, to_metres(self._prim, self._shot.metres_per_unit, time)
        if before is not None:
            points = self._own(time) + points - self._binding.at(before).points
        self._track.write(time, points, to_world, changed=changed or before is not None, cut=cut)
        self._hints.write(time, self._track.box)
        if self._normals is not None:
            self._normals.write(time, follower, to_world)
        return points

    def _own(self, time: float | None) -> np.ndarray:
        """The target's own points [m] at a time code."""
        points = points_at(self._prim, self._shot.metres_per_unit, time)
        if points is None or len(points) != len(self.target.points):
            raise LayerError(f"<{self.target.path}>{at_time(time)}: has no points of its own")
        return points

    def finish(self) -> None:
        """Author pending samples at the end."""
        self._track.finish()


class _TurnedNormals:
    """Authored normals of a target, which turn with it; their interpolation stays."""

    def __init__(self, stream: LayerStream, path: Sdf.Path, normals: np.ndarray, owner: np.ndarray) -> None:
        """Take normals in world space in the bind pose, shape (M, 3), and the point of each."""
        self._stream, self._path, self._normals, self._owner = stream, path, normals, owner

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
        return cls(stream, path, np.asarray(values, float) @ linear, owner)

    def write(self, time: float | None, follower: Follower, to_world: np.ndarray) -> None:
        """Write one time code."""
        turned = follower.turned(self._normals, self._owner) @ to_world[:3, :3]
        lengths = np.linalg.norm(turned, axis=1, keepdims=True)
        set_sample(self._stream, self._path, (turned / np.maximum(lengths, 1e-30)).astype(np.float32), time)


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


def _default_points(prim: Usd.Prim, count: int) -> np.ndarray | None:
    """Authored default points, shape (N, 3), float32; None without as many."""
    value = UsdGeom.PointBased(prim).GetPointsAttr().Get(Usd.TimeCode.Default())
    if value is None or len(value) != count:
        return None
    return np.asarray(value, np.float32)
