"""Finds targets of ``physgraph:bind:targets``: meshes, curves, points and instances that follow refined garments."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...errors import GarmentError, SchemaError
from ...solver.mesh.topology import PolygonMesh, edges_of, joined_by
from ..mesh.bind import closest
from ..stage import timecode
from ..times import motion_of
from .find import find_paths, targets_of
from .placement import place, to_metres

FOLLOWERS = (UsdGeom.PointBased, UsdGeom.PointInstancer)
"""Classes of prims that can follow: of a point instancer, positions and orientations."""
TARGETS, RIGID, MODE = "physgraph:bind:targets", "physgraph:bind:rigid", "physgraph:bind:mode"
FOLLOW, DETAIL = "follow", "detail"
"""Modes: the cloth's motion in place of the target's own, or the difference of refined cloth and cage beside it."""
FAR = 0.1
"""Greatest distance of a target from its garment, relative to the garment's diagonal."""
SMALL = 0.05
"""Largest diagonal of a closed piece that is rigid unasked, relative to the garment's diagonal."""
ASKED = 2_000
"""Most points of a target compared to choose garment and bind pose."""
UNLIKELY = 2.0
"""Times by which the less likely pose must be closer: the default of what moves, the first sample of what stands."""


Cage = Callable[[int, float | None], np.ndarray]
"""A garment's coarse points [m] in world space at a time code, by number."""


@dataclass(frozen=True, eq=False)
class Target:
    """A mesh, curves, points or instances that follow a garment.

    Attributes:
        garment: Number of the garment.
        on: Parent target, a mesh; None for the cloth.
        time: Time code of the bind pose; None for the default.
        points: Positions in the bind pose [m], world space, shape (N, 3).
        mesh: Faces; None for curves, points and instances.
        rigid: Number of the rigid part of each point, or -1, shape (N,).
        detail: Whether the difference of refined cloth and cage is added to the target's own motion.
        skinned: Whether the points came from baking UsdSkel skinning.
        distance: Greatest distance from the cage, or from ``on``, in the bind pose [m].
        size: Diagonal of the garment's cage in the bind pose [m].
    """

    path: Sdf.Path
    garment: int
    on: Sdf.Path | None
    time: float | None
    points: np.ndarray
    mesh: PolygonMesh | None
    rigid: np.ndarray
    detail: bool
    skinned: bool
    distance: float
    size: float

    @property
    def parts(self) -> int:
        """Number of rigid parts."""
        return len(np.unique(self.rigid[self.rigid >= 0]))


@dataclass(frozen=True)
class Bound:
    """A prim to be bound.

    Attributes:
        on: Garment or parent target; None for the nearest garment.
    """

    path: Sdf.Path
    on: Sdf.Path | None


def find_bound(stage: Usd.Stage, garments: Sequence[Usd.Prim], wanted: Sequence[str]) -> list[Bound]:
    """Prims bound to garments, each after its parent.

    Args:
        wanted: Prim paths, names, globs or collections bound to the nearest garment.

    Raises:
        AbsentError: A wanted prim does not exist.
        StageError: A relationship's target does not exist.
        GarmentError: A prim is bound twice, or is a garment.
    """
    cloth = {prim.GetPath() for prim in garments}
    bound = [follower for prim in garments for follower in _below(stage, prim)]
    listed = {follower.path for follower in bound}
    requested = dict.fromkeys(path for item in wanted for path in find_paths(stage, item, FOLLOWERS))
    bound += [Bound(path, None) for path in requested if path not in listed | cloth]
    seen: dict[Sdf.Path, Sdf.Path | None] = {}
    for follower in bound:
        if follower.path in cloth:
            remedy = f"take it out of {TARGETS} on <{follower.on}>, or refine without it"
            raise GarmentError(str(follower.path), f"is a garment, and bound to <{follower.on}>", remedy=remedy)
        if follower.path in seen:
            message = f"is bound to <{seen[follower.path]}> and to <{follower.on}>"
            raise GarmentError(str(follower.path), message, remedy=f"leave it in one {TARGETS}")
        seen[follower.path] = follower.on
        bound += _below(stage, stage.GetPrimAtPath(follower.path))  # The loop reaches them too.
    return bound


def _below(stage: Usd.Stage, prim: Usd.Prim) -> list[Bound]:
    """Prims named by a garment's or target's relationship."""
    named = [path for item in targets_of(prim, TARGETS) for path in find_paths(stage, str(item), FOLLOWERS)]
    return [Bound(path, prim.GetPath()) for path in dict.fromkeys(named)]


def read_targets(
    stage: Usd.Stage,
    bound: Sequence[Bound],
    garments: Sequence[tuple[Sdf.Path, PolygonMesh, float | None]],
    *,
    cage: Cage,
    metres: float,
    skinned: Sequence[Sdf.Path],
) -> list[Target]:
    """Read targets in the closest bind pose.

    Args:
        stage: The stage, skinning baked.
        bound: From `find_bound`; prims bound to garments that are not refined are left out.
        garments: Path, mesh and first time code of each garment.
        cage: Places the garments.
        skinned: Prims with baked points.

    Raises:
        GarmentError: A target lies too far from its garment, changes its topology, or cannot be placed.
        SchemaError: An attribute is invalid.
    """
    numbers = {path: number for number, (path, _, _) in enumerate(garments)}
    targets: dict[Sdf.Path, Target] = {}
    for follower in bound:
        prim = stage.GetPrimAtPath(follower.path)
        _check_topology(prim)
        if follower.on is not None and follower.on in targets:
            targets[follower.path] = _on_target(prim, targets[follower.on], metres, skinned=follower.path in skinned)
            continue
        named = [number for path, number in numbers.items() if path == follower.on]
        nearest = range(len(garments)) if follower.on is None else named
        poses = [pose for number in nearest for pose in _poses(prim, number, garments, cage=cage, metres=metres)]
        if not poses and nearest:
            remedy = "author its points, or leave it out of the bound prims"
            raise GarmentError(
                str(follower.path), "has no points where the garment has its first sample", remedy=remedy
            )
        if not poses:
            continue
        best = min(poses, key=lambda pose: pose.away)
        targets[follower.path] = _placed(prim, best, None, skinned=follower.path in skinned)
    return [*targets.values()]


@dataclass(frozen=True, eq=False)
class _Pose:
    """A target beside a garment at a time."""

    garment: int
    time: float | None
    points: np.ndarray
    surface: np.ndarray
    triangles: np.ndarray
    size: float
    away: float


def _poses(
    prim: Usd.Prim,
    number: int,
    garments: Sequence[tuple[Sdf.Path, PolygonMesh, float | None]],
    *,
    cage: Cage,
    metres: float,
) -> Iterator[_Pose]:
    """A target in the garment's first sample, and in the default pose, with its mean distance, which decides."""
    path, mesh, first = garments[number]
    stage = prim.GetStage()
    default = UsdGeom.PointBased(stage.GetPrimAtPath(path)).GetPointsAttr().Get(Usd.TimeCode.Default()) is not None
    moves = bool(motion_of(prim).times)
    for time in [first, None] if default and first is not None else [first]:
        points = points_at(prim, metres, time)
        if points is None:
            continue
        surface = cage(number, time)
        triangles = mesh.triangulate(surface).triangles
        sampled = points[:: max(len(points) // ASKED, 1)]
        away = float(closest(sampled, surface, triangles).distance.mean())
        size = float(np.linalg.norm(np.ptp(surface, axis=0)))
        away *= UNLIKELY if moves == (time is None) else 1.0
        yield _Pose(number, time, points, surface, triangles, size, away)


def _placed(prim: Usd.Prim, pose: _Pose, on: Sdf.Path | None, *, skinned: bool) -> Target:
    path, size = prim.GetPath(), pose.size
    distance = float(closest(pose.points, pose.surface, pose.triangles).distance.max(initial=0.0))
    if distance > FAR * size:
        message = f"lies up to {distance:.3g} m from what it is bound to: over a tenth of the garment's {size:.3g} m"
        remedy = f"leave it out of {TARGETS} and --bind, or bind it to the garment that it lies on"
        raise GarmentError(str(path), message, time=pose.time, remedy=remedy)
    mesh = _mesh_of(prim)
    rigid = _rigid_parts(prim, mesh, pose.points, SMALL * size)
    detail = _mode(prim) == DETAIL
    return Target(path, pose.garment, on, pose.time, pose.points, mesh, rigid, detail, skinned, distance, size)


def _on_target(prim: Usd.Prim, parent: Target, metres: float, *, skinned: bool) -> Target:
    """A target bound to a parent target, in the parent's bind pose."""
    if parent.mesh is None:
        message, remedy = f"is bound to <{parent.path}>, which has no faces", "bind it to a mesh"
        raise GarmentError(str(prim.GetPath()), message, remedy=remedy)
    points = points_at(prim, metres, parent.time)
    if points is None:
        message = "has no points in the pose in which it is bound"
        raise GarmentError(str(prim.GetPath()), message, time=parent.time, remedy="author its points there")
    triangles = parent.mesh.triangulate(parent.points).triangles
    pose = _Pose(parent.garment, parent.time, points, parent.points, triangles, parent.size, 0.0)
    return _placed(prim, pose, parent.path, skinned=skinned)


def points_attribute(prim: Usd.Prim) -> Usd.Attribute:
    """The attribute of a target's points, or of its instances' positions."""
    return prim.GetAttribute("positions" if UsdGeom.PointInstancer(prim) else "points")


def points_at(prim: Usd.Prim, metres: float, time: float | None) -> np.ndarray | None:
    """World positions [m] of a prim's points at a time code, shape (N, 3), float64; None without points.

    Raises:
        GarmentError: A point is not finite, or the prim cannot be placed.
    """
    value = points_attribute(prim).Get(timecode(time))
    if value is None or not np.size(value):
        return None
    if np.ndim(value) != 2 or np.shape(value)[1] != 3:
        kind = points_attribute(prim).GetTypeName()
        raise GarmentError(str(prim.GetPath()), f"its points are of type {kind}", remedy="author them as point3f[]")
    points = place(np.asarray(value, np.float64), to_metres(prim, metres, time))
    if not np.isfinite(points).all():
        first = int(np.argwhere(~np.isfinite(points))[0][0])
        remedy = "mend its points, or leave it out of the bound prims"
        raise GarmentError(str(prim.GetPath()), f"point {first} is not finite", time=time, remedy=remedy)
    return points


def _check_topology(prim: Usd.Prim) -> None:
    points = points_attribute(prim)
    counted = [UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr()] if UsdGeom.Mesh(prim) else []
    counted += [UsdGeom.Curves(prim).GetCurveVertexCountsAttr()] if UsdGeom.Curves(prim) else []
    counted += [UsdGeom.PointInstancer(prim).GetIdsAttr()] if UsdGeom.PointInstancer(prim) else []
    for attribute in [points, *counted]:
        times = attribute.GetTimeSamples()
        first = attribute.Get(times[0]) if times else None
        for time in times[1:]:
            value = attribute.Get(time)
            changed = _count(value) != _count(first) or (attribute is not points and value != first)
            if changed:
                remedy = "bind a mesh of one topology, or leave this one out"
                raise GarmentError(str(prim.GetPath()), "its topology changes", time=time, remedy=remedy)


def _count(value: Any) -> int:
    return 0 if value is None else np.size(value)


def _mesh_of(prim: Usd.Prim) -> PolygonMesh | None:
    """The faces of a mesh with a polygon or more, else None."""
    mesh, first = UsdGeom.Mesh(prim), Usd.TimeCode.EarliestTime()
    topology = (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetPointsAttr())
    counts, indices, points = (attribute.Get(first) if mesh else None for attribute in topology)
    if not counts or not indices or not points:
        return None
    mesh_read = PolygonMesh(np.asarray(counts, np.int32), np.asarray(indices, np.int32), len(points))
    return mesh_read if (mesh_read.counts > 2).any() else None


def _rigid_parts(prim: Usd.Prim, mesh: PolygonMesh | None, points: np.ndarray, small: float) -> np.ndarray:
    """Number of the rigid part of each point, or -1: connected pieces; unasked, those small [m] and closed."""
    rigid = prim.GetAttribute(RIGID).Get()
    if rigid not in (None, True, False):
        raise SchemaError(f"<{prim.GetPath()}>.{RIGID} is {rigid!r}; give true or false")
    none = np.full(len(points), -1)
    if rigid is False or (mesh is None and not rigid):
        return none
    if mesh is None:
        return np.zeros(len(points), np.int64)
    edges = edges_of(mesh.triangulate(points).triangles, len(points))
    piece = joined_by(edges.vertices, len(points))
    if rigid:
        return piece
    count = int(piece.max()) + 1
    ends = np.zeros((2, count, 3))
    for axis in range(3):
        ends[0, :, axis], ends[1, :, axis] = np.inf, -np.inf
        np.minimum.at(ends[0, :, axis], piece, points[:, axis])
        np.maximum.at(ends[1, :, axis], piece, points[:, axis])
    closed = np.bincount(piece[edges.vertices[:, 0]], edges.face_count != 2, count) == 0
    closed &= np.bincount(piece[edges.vertices[:, 0]], minlength=count) > 0
    stays = closed & (np.linalg.norm(ends[1] - ends[0], axis=1) <= small)
    return np.where(stays[piece], piece, -1)


def _mode(prim: Usd.Prim) -> str:
    """How a target follows; SchemaError for another word."""
    mode = prim.GetAttribute(MODE).Get() or FOLLOW
    if mode not in (FOLLOW, DETAIL):
        raise SchemaError(f"<{prim.GetPath()}>.{MODE} is {mode!r}; known: {FOLLOW}, {DETAIL}")
    return str(mode)
