"""Finds bodies other than garments and colliders on a stage, and the frames of possible contact with cloth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from ...errors import GarmentError
from ...solver.colliders.pose import Collider, Pose
from ...solver.colliders.primitives import tessellated
from ..lookup import with_ancestors
from ..stage import TRAVERSAL, pxr_errors, quiet, timecode
from ..times import motion_of
from .absence import visibility_varies
from .bodies import ColliderReader, kind_of, parts_of, positions
from .find import BODIES, MARKS, has_schema, why_not_drawn
from .garment import is_visible
from .placement import place, to_metres
from .reader import Shot
from .skinning import find_skinned

Box = np.ndarray
"""Least and greatest corner [m], world space, shape (2, 3)."""
KEPT_POSES = 4
"""Poses of a body kept in memory."""
_PURPOSES = [UsdGeom.Tokens.default_, UsdGeom.Tokens.render, UsdGeom.Tokens.proxy]


@dataclass(frozen=True, eq=False)
class OtherBody:
    """A body that is neither a garment nor a collider.

    Attributes:
        why: Reason for no contact, or "".
        unread: Type of a prim whose shape is not read, or "".
        frames: Numbers of the frames in which the body's bounds meet the cloth's.
        pose: Its pose in a frame by number; a shape that is not read has points and no exact triangles.
        hull: Points in a frame by number whose convex hull contains the shape [m], shape (N, 3). Between two frames no
            point of the shape moves farther than one of these.
    """

    path: str
    why: str = ""
    unread: str = ""
    frames: Sequence[int] = ()
    pose: Callable[[int], Pose | None] = lambda _: None
    hull: Callable[[int], np.ndarray] = lambda _: np.zeros((0, 3))


def other_bodies(shot: Shot, times: Sequence[float | None], boxes: Sequence[Box]) -> Iterator[OtherBody]:
    """Bodies that are neither garments nor colliders of a shot, in stage order.

    Bounds are those of points and instances, not authored extents.

    Args:
        shot: An open shot.
        times: Time codes of the frames.
        boxes: Bounds of garments and their neighbourhood in each frame.

    Raises:
        StageError: USD can no longer read the files.
    """
    in_shot = {*shot.colliders, *(garment.path for garment in shot.scene.garments)}
    in_shot |= {path for source in shot.sources for path in source.apart_from}
    in_shot |= {str(target.path) for target in shot.bound}
    with pxr_errors(f"cannot read {shot.path}"), quiet():
        unfit = {prim: _why_left(prim, times) for prim in _bodies(shot.stage) if str(prim.GetPath()) not in in_shot}
        prims = [prim for prim, reason in unfit.items() if not reason]
        skinned = _Skinning(shot, [prim.GetPath() for prim in prims if _is_skinned(prim)])
        posed = zip(shot.scene.colliders, shot.frame(times[0]).colliders, strict=True) if prims else ()
        seen = [(collider.path, pose) for collider, pose in posed]
        near = np.stack([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])
        for prim, reason in unfit.items():
            path = str(prim.GetPath())
            body = OtherBody(path, reason) if reason else _body(prim, shot, times, skinned=skinned, near=near)
            if reason or body is None:
                yield body or OtherBody(path)
                continue
            body = replace(body, frames=[k for k, box in enumerate(boxes) if _meets(body.hull(k), box)])
            if body.frames and not body.unread:
                first = body.pose(0)
                copied = next((original for original, pose in seen if _same_place(first, pose)), "")
                seen.append((path, first))
                body = OtherBody(path, f"a copy of <{copied}>") if copied else body
            yield body


def _bodies(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    """Gprims and point instancers, without prims below instancers."""
    prims = iter(Usd.PrimRange.Stage(stage, TRAVERSAL))
    for prim in prims:
        if any(kind(prim) for kind in BODIES):
            yield prim
        if UsdGeom.PointInstancer(prim):
            prims.PruneChildren()


def _body(
    prim: Usd.Prim, shot: Shot, times: Sequence[float | None], *, skinned: _Skinning, near: Box
) -> OtherBody | None:
    """A visible body; None for an instancer without readable shapes in the prototypes."""
    metres, path, kind = shot.metres_per_unit, prim.GetPath(), kind_of(prim)
    reader = ColliderReader(prim, Collider(str(path), kind or "mesh"), metres)
    if kind == "instancer":
        reader = replace(reader, collider=Collider(str(path), "mesh"), instancer=prim, near=near)
        reader.parts, _ = parts_of(reader, prim)
        if not reader.parts:
            return None

    @lru_cache(KEPT_POSES)
    def pose(index: int) -> Pose | None:
        return skinned.pose(reader, times[index]) if kind else _rough(prim, metres, times[index])

    def hull(index: int) -> np.ndarray:
        points = skinned.points(path, times[index])
        if points is None and UsdGeom.PointBased(prim):
            points = _points(prim, metres, times[index])
        elif points is None:
            posed = pose(index)
            points = np.zeros((0, 3)) if posed is None else posed.corners()
        return points[np.isfinite(points).all(axis=1)]

    unread = "" if kind else str(prim.GetTypeName())
    if _moves(prim, reader):
        return OtherBody(str(path), unread=unread, pose=pose, hull=hull)
    still = hull(0)
    return OtherBody(str(path), unread=unread, pose=lambda _: pose(0), hull=lambda _: still)


def _moves(prim: Usd.Prim, reader: ColliderReader) -> bool:
    """Whether a body's shape, place or visibility has more than one sample."""
    if _is_skinned(prim):
        return True
    shapes = [prim, *(part.prim for part in reader.parts.values())]
    times = set[float]()
    for shape in shapes:
        times |= {time for attribute in shape.GetAuthoredAttributes() for time in attribute.GetTimeSamples()}
        times |= {*motion_of(shape).times}
    return len(times) > 1 or any(visibility_varies(shape) for shape in shapes)


def _points(prim: Usd.Prim, metres: float, time: float | None) -> np.ndarray:
    """World positions of a prim's own points [m], shape (N, 3); empty without."""
    matrix = np.array(UsdGeom.XformCache(timecode(time)).GetLocalToWorldTransform(prim), np.float64).T
    matrix[:3] *= metres
    return place(positions(prim, time).astype(np.float64), matrix)


def _rough(prim: Usd.Prim, metres: float, time: float | None) -> Pose:
    """Points of an unread shape, or corners of the shape's bounds; and triangles of a control net, or none."""
    triangles = np.zeros((0, 3), np.int32)
    if UsdGeom.PointBased(prim):
        points = _points(prim, metres, time)
        net = UsdGeom.NurbsPatch(prim)
        counts = (net.GetVVertexCountAttr().Get(), net.GetUVertexCountAttr().Get()) if net else ()
        shape = tuple(count for count in counts if isinstance(count, int))
        if len(shape) > 1 and np.prod(shape) == len(points) and min(shape) > 1:
            ids = np.arange(len(points), dtype=np.int32).reshape(shape)
            a, b, c, d = (corner.ravel() for corner in (ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]))
            triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
        return Pose(points, triangles)
    bound = UsdGeom.BBoxCache(timecode(time), _PURPOSES).ComputeWorldBound(prim).ComputeAlignedRange()
    ends = metres * np.array([bound.GetMin(), bound.GetMax()], np.float64)
    if bound.IsEmpty():
        return Pose(np.zeros((0, 3)), triangles)
    points, triangles = tessellated("cube", *(0.5 * (ends[1] - ends[0])).tolist())
    return Pose(points + ends.mean(axis=0), triangles)


def _why_left(prim: Usd.Prim, times: Sequence[float | None]) -> str:
    """The reason for no contact with a body: a deciding schema, the purpose or the visibility; or ""."""
    for ancestor in with_ancestors(prim):
        if mark := next((mark for mark in MARKS if has_schema(ancestor, mark)), None):
            return f"{mark} on <{ancestor.GetPath()}> marks it, and this run does not have it"
    if reason := why_not_drawn(prim):
        return f"{reason}, which no final render shows"
    codes = [time for time in times if time is not None]
    visible = is_visible(prim, codes if visibility_varies(prim) else codes[:1])
    return "" if visible else "invisible"


def _is_skinned(prim: Usd.Prim) -> bool:
    return bool(UsdSkel.BindingAPI(prim).GetJointIndicesAttr().HasAuthoredValue())


def _meets(points: np.ndarray, box: Box) -> bool:
    """Whether the bounds of points, shape (N, 3), meet a box."""
    return bool(len(points) and (points.min(axis=0) <= box[1]).all() and (box[0] <= points.max(axis=0)).all())


def _same_place(a: Pose | None, b: Pose | None) -> bool:
    """Whether two poses have the same points, up to float32 rounding."""
    if a is None or b is None or a.points.shape != b.points.shape:
        return False
    return bool(np.allclose(a.points, b.points, rtol=1e-5, atol=1e-6, equal_nan=True))


class _Skinning:
    """Meshes other than colliders, skinned by UsdSkel at single time codes."""

    def __init__(self, shot: Shot, paths: Sequence[Sdf.Path]) -> None:
        """Find the skeletons of the meshes."""
        self._metres, self._stage = shot.metres_per_unit, shot.stage
        self._skinned, _ = find_skinned(shot.stage, paths)

    def pose(self, reader: ColliderReader, time: float | None) -> Pose | None:
        """A mesh at a time code, skinned if UsdSkel deforms it."""
        return reader.pose(time, self.points(reader.prim.GetPath(), time))[0]

    def points(self, path: Sdf.Path, time: float | None) -> np.ndarray | None:
        """World positions of a skinned mesh [m], shape (V, 3), float64; None for a mesh that is not skinned."""
        skinned = self._skinned.get(path)
        points = None if skinned is None else skinned.points(time)
        if skinned is None or points is None:
            return None
        try:
            matrix = to_metres(self._stage.GetPrimAtPath(skinned.space), self._metres, time)
        except GarmentError:
            return None
        return place(np.asarray(points, dtype=np.float64), matrix)
