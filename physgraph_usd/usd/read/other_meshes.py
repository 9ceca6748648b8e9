"""Finds meshes of a stage that are neither garments nor colliders, posed in a few frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from ...errors import GarmentError
from ...solver.colliders.pose import Collider, Pose
from ..lookup import with_ancestors
from ..stage import TRAVERSAL, pxr_errors, quiet, timecode
from .bodies import ColliderReader
from .find import MARKS, has_schema, is_drawn, traverse
from .garment import is_visible
from .placement import place, to_metres
from .reader import Shot

Box = np.ndarray
"""Least and greatest corner [m], world space, shape (2, 3)."""


def other_meshes(
    shot: Shot, times: Sequence[float | None], boxes: Sequence[Box]
) -> Iterator[tuple[str, str, Iterator[tuple[int, Pose]]]]:
    """Meshes that are neither garments nor colliders of a shot, and their poses in some frames.

    Args:
        shot: An open shot.
        times: Time codes of the frames.
        boxes: Bounds of garments and their neighbourhood in each frame.

    Yields:
        The path of each mesh, in stage order; the reason for no contact, or ""; and the numbers and poses of the frames
        in which its bounds meet a garment's: to be consumed before the next path.

    Raises:
        StageError: USD can no longer read the files.
    """
    in_shot = {*shot.colliders, *(garment.path for garment in shot.scene.garments)}
    in_shot |= {path for source in shot.sources for path in source.apart_from}
    in_shot |= {str(each.path) for each in shot.bound}
    with pxr_errors(f"cannot read {shot.path}"), quiet():
        meshes = [prim for prim in traverse(shot.stage) if UsdGeom.Mesh(prim) and str(prim.GetPath()) not in in_shot]
        unfit = {prim: _why_left(prim, times) for prim in meshes}
        prims = [prim for prim, why in unfit.items() if not why]
        skinned = _Skinning(shot, [prim.GetPath() for prim in prims if _is_skinned(prim)])
        posed = zip(shot.scene.colliders, shot.frame(times[0]).colliders, strict=True) if prims else ()
        seen = [(collider.path, pose) for collider, pose in posed]
        for prim, why in unfit.items():
            path = str(prim.GetPath())
            if why or not (_is_skinned(prim) or _may_meet(prim, shot.metres_per_unit, times, boxes)):
                yield path, why, iter(())
                continue
            reader = ColliderReader(prim, Collider(path, "mesh"), shot.metres_per_unit)
            first = skinned.pose(reader, times[0])
            copied = next((other for other, pose in seen if _same_place(first, pose)), "")
            seen.append((path, first))
            poses = (first if index == 0 else skinned.pose(reader, time) for index, time in enumerate(times))
            yield path, f"a copy of <{copied}>" if copied else "", iter(()) if copied else _meeting(poses, boxes)


def _why_left(prim: Usd.Prim, times: Sequence[float | None]) -> str:
    """The reason for no contact with a mesh: a deciding schema, the purpose or the visibility; or ""."""
    for each in with_ancestors(prim):
        if mark := next((mark for mark in MARKS if has_schema(each, mark)), None):
            return f"{mark} on <{each.GetPath()}> marks it, and this run does not have it"
    if not is_drawn(prim):
        return f"a {UsdGeom.Imageable(prim).ComputePurpose()}, which no final render shows"
    visible = is_visible(prim, [time for time in times if time is not None])
    return "" if visible else "invisible"


def _is_skinned(prim: Usd.Prim) -> bool:
    return bool(UsdSkel.BindingAPI(prim).GetJointIndicesAttr().HasAuthoredValue())


def _may_meet(prim: Usd.Prim, metres: float, times: Sequence[float | None], boxes: Sequence[Box]) -> bool:
    """Whether a mesh's USD bounds meet the boxes; True if the points are animated but an authored extent is not."""
    extent, points = UsdGeom.Mesh(prim).GetExtentAttr(), UsdGeom.Mesh(prim).GetPointsAttr()
    if extent.HasAuthoredValue() and points.ValueMightBeTimeVarying() and not extent.ValueMightBeTimeVarying():
        return True
    every = [UsdGeom.Tokens.default_, UsdGeom.Tokens.render, UsdGeom.Tokens.proxy]
    for time, box in zip(times, boxes, strict=True):
        bound = UsdGeom.BBoxCache(timecode(time), every).ComputeWorldBound(prim).ComputeAlignedRange()
        bounds = metres * np.array([bound.GetMin(), bound.GetMax()], dtype=np.float64)
        if not bound.IsEmpty() and _meets(bounds, box):
            return True
    return False


def _meeting(poses: Iterable[Pose | None], boxes: Sequence[Box]) -> Iterator[tuple[int, Pose]]:
    """Numbers and poses of the frames in which posed points meet the boxes."""
    for index, (pose, box) in enumerate(zip(poses, boxes, strict=True)):
        points = np.zeros((0, 3)) if pose is None else pose.corners()
        points = points[np.isfinite(points).all(axis=1)]
        if pose is None or not len(points):
            continue
        if _meets(np.stack([points.min(axis=0), points.max(axis=0)]), box):
            yield index, pose


def _meets(bounds: Box, box: Box) -> bool:
    return bool((bounds[0] <= box[1]).all() and (box[0] <= bounds[1]).all())


def _same_place(a: Pose | None, b: Pose | None) -> bool:
    """Whether two poses have the same points, up to float32 rounding."""
    if a is None or b is None or a.points.shape != b.points.shape:
        return False
    return bool(np.allclose(a.points, b.points, rtol=1e-5, atol=1e-6, equal_nan=True))


class _Skinning:
    """Joint skinning of meshes at single time codes, without blend shapes: accurate enough to find cloth contact."""

    def __init__(self, shot: Shot, paths: Sequence[Sdf.Path]) -> None:
        """Find the skeletons of meshes, on a stage like the shot's before garments were baked."""
        self._metres, self._stage = shot.metres_per_unit, None
        self._bound: Mapping[Sdf.Path, tuple[UsdSkel.SkeletonQuery, UsdSkel.SkinningQuery]] = {}
        if paths:
            self._stage = shot.view.open(mask=Usd.StagePopulationMask(paths))
            self._stage.ExpandPopulationMask()
            self._cache = UsdSkel.Cache()
            self._bound = dict(self._bindings({*paths}))

    def _bindings(
        self, paths: set[Sdf.Path]
    ) -> Iterator[tuple[Sdf.Path, tuple[UsdSkel.SkeletonQuery, UsdSkel.SkinningQuery]]]:
        assert self._stage is not None
        for root in filter(None, map(UsdSkel.Root, traverse(self._stage))):
            self._cache.Populate(root, TRAVERSAL)
            for binding in self._cache.ComputeSkelBindings(root, TRAVERSAL):
                skeleton = self._cache.GetSkelQuery(binding.GetSkeleton())
                for query in binding.GetSkinningTargets():
                    path = query.GetPrim().GetPath()
                    if path in paths and query.HasJointInfluences() and not query.IsRigidlyDeformed():
                        yield path, (skeleton, query)

    def pose(self, reader: ColliderReader, time: float | None) -> Pose | None:
        """A mesh at a time code, skinned if bent by joints."""
        return reader.pose(time, self._points(reader.prim.GetPath(), time))[0]

    def _points(self, path: Sdf.Path, time: float | None) -> np.ndarray | None:
        """World positions of a skinned mesh [m], shape (V, 3), float64; None for a mesh not bent by joints."""
        if path not in self._bound or self._stage is None:
            return None
        skeleton, query = self._bound[path]
        code = timecode(time)
        points = UsdGeom.Mesh(query.GetPrim()).GetPointsAttr().Get(code)
        if points is None:
            return None
        joints: Any = skeleton.ComputeSkinningTransforms(code)
        if joints is None or not query.ComputeSkinnedPoints(joints, points, code):
            return None
        try:
            matrix = to_metres(skeleton.GetPrim(), self._metres, time)
        except GarmentError:
            return None
        return place(np.asarray(points, dtype=np.float64), matrix)
