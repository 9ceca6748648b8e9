"""Skins prims as UsdSkel plays them, by joints and blend shapes, into an anonymous layer of the session.

Nothing is written to disk and the stage's own layers are not touched. Points are computed at exactly the time codes
that are read, whatever moves them: the animation, the skeleton, the mesh or a transform above. After baking, a skinned
mesh has ordinary point samples, in its own local space.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ..lookup import with_ancestors
from ..stage import TRAVERSAL, Notice, in_brief, quiet, timecode, value_at
from ..times import Motion, merge, motion_alone, motion_by, motion_of
from .find import instance_roots
from .placement import place

_ANIMATED = ("rotations", "translations", "scales", "blendShapeWeights")
"""Attributes of an animation. Translations alone, and weights of shapes without in-betweens, move points straight."""
_API, _SKELETON, _ANIMATION = "SkelBindingAPI", "skel:skeleton", "skel:animationSource"


@dataclass(frozen=True, eq=False)
class Skinned:
    """A mesh deformed by UsdSkel.

    Attributes:
        motion: Motion of the mesh by the skeleton's animation, and by the transforms of skeleton and mesh.
        query: UsdSkel's query of the binding.
        joints: UsdSkel's query of the skeleton's pose.
        skeleton: Path of the skeleton.
        animation: Path of its animation, or None.
        shapes: UsdSkel's query of the blend shapes, or None.
    """

    path: Sdf.Path
    motion: Motion
    query: UsdSkel.SkinningQuery
    joints: UsdSkel.SkeletonQuery
    skeleton: Sdf.Path
    animation: Sdf.Path | None
    shapes: UsdSkel.BlendShapeQuery | None

    @property
    def space(self) -> Sdf.Path:
        """The prim in whose space `points` are: the skeleton, or the mesh itself without joint influences."""
        return self.skeleton if self.query.HasJointInfluences() else self.path

    def points(self, time: float | None, posed: float = 1.0) -> Vt.Vec3fArray | None:
        """Deformed points in the space of `space`; None where the mesh has no points or UsdSkel rejects its influences.

        Read before baking.

        Args:
            time: A time code.
            posed: From 0, the bind pose moved along with the root joints, to 1, the pose at the time code.
        """
        code = timecode(time)
        points = _points(self.query.GetPrim(), code)
        if not points:
            return None
        animation, mapper = self.joints.GetAnimQuery(), self.query.GetBlendShapeMapper()
        if self.shapes is not None and animation and mapper is not None:
            weights: Any = mapper.Remap(animation.ComputeBlendShapeWeights(code))
            indices, offsets = self.shapes.ComputeBlendShapePointIndices(), self.shapes.ComputeSubShapePointOffsets()
            deform: Any = self.shapes.ComputeDeformedPoints
            deform(*self.shapes.ComputeSubShapeWeights(weights), indices, offsets, points)
        if not self.query.HasJointInfluences():
            return points
        # Without a bind pose, UsdSkel's Python binding gives the joints' poses in place of skinning transforms.
        transforms: Any = _skinning_transforms(self.joints, code, posed) if self.joints.HasBindPose() else None
        return points if transforms and self.query.ComputeSkinnedPoints(transforms, points, code) else None

    def bind_transform(self, code: Usd.TimeCode) -> Gf.Matrix4d:
        """Matrix (row vectors) from authored points to the space of `space`."""
        return self.query.GetGeomBindTransform(code) if self.query.HasJointInfluences() else Gf.Matrix4d(1.0)


class Bake:
    """The anonymous layer of baked points, on top of the stage.

    Attributes:
        skinned: The baked meshes, by prim path.
        defaults: Deformed points of these meshes at the default time in their own space, by prim path; None where the
            mesh has no points then.
        layer: The anonymous layer; keep the layer alive as long as the stage.
    """

    def __init__(self, stage: Usd.Stage) -> None:
        """Put an empty anonymous layer on the stage's session layer."""
        self._stage = stage
        self.skinned: dict[Sdf.Path, Skinned] = {}
        self.defaults: dict[Sdf.Path, Vt.Vec3fArray | None] = {}
        self.layer = Sdf.Layer.CreateAnonymous("physgraph-skinning.usda")
        # A layer without authored rate has 24 time codes per second, and USD would rescale the baked samples.
        self.layer.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
        stage.GetSessionLayer().subLayerPaths.insert(0, self.layer.identifier)

    def bind(self, paths: Sequence[Sdf.Path]) -> list[Notice]:
        """Find the skinned among mesh prims, to be baked; notices of skinning that UsdSkel does not play as authored.

        Prims inside instances become editable in the anonymous layer.
        """
        for path in [path for path in paths if skel_root(self._stage.GetPrimAtPath(path))]:
            while roots := instance_roots(self._stage.GetPrimAtPath(path)):
                Sdf.CreatePrimInLayer(self.layer, roots[0]).instanceable = False
        self.skinned, notices = find_skinned(self._stage, paths)
        rejected = {notice.path for notice in notices}
        bare = [
            self._stage.GetPrimAtPath(path) for path in paths if path not in self.skinned and str(path) not in rejected
        ]
        return [*notices, *(notice for prim in bare for notice in _unskinned(prim))]

    def motion(self, prim: Usd.Prim) -> Motion:
        """Motion of a prim as by `motion_of`, with that of skinned prims by their skeletons."""
        return motion_of(prim, skinned={path: skin.motion for path, skin in self.skinned.items()})

    def bake(self, times: Sequence[float]) -> list[Notice]:
        """Bake the skinned prims at given time codes and at samples of the motion; notices of UsdSkel's rejections."""
        notices = []
        for skinned in self.skinned.values():
            with quiet() as diagnostics:
                every = merge(times, skinned.motion.times) or (None,)
                poses = {time: self._local(skinned, time) for time in every}
                texts = [diagnostic.commentary for diagnostic in diagnostics.TakeUncoalescedDiagnostics()]
                default = self._local(skinned, None)
            self.defaults[skinned.path] = None if isinstance(default, Sdf.ValueBlock) else default
            notices += _diagnosed(skinned, texts)
            with Usd.EditContext(self._stage, self.layer):
                attribute = self._points(skinned)
                for time, points in poses.items():
                    attribute.Set(points, timecode(time))
        return notices

    def _points(self, skinned: Skinned) -> Usd.Attribute:
        """The points of a baked mesh."""
        return UsdGeom.PointBased(self._stage.GetPrimAtPath(skinned.path)).GetPointsAttr()

    @contextmanager
    def posed(self, time: float | None, part: float) -> Iterator[None]:
        """Replace the baked points, for a while, by one sample of a pose between the bind pose (0) and theirs (1)."""
        baked = {self._points(skinned).GetPath(): skinned for skinned in self.skinned.values()}
        samples = {path: self._samples(path) for path in baked}
        try:
            for path, skinned in baked.items():
                self._replace_samples(path, {})  # The pose is computed from the authored points.
                self._replace_samples(path, {time: self._local(skinned, time, part)})
            yield
        finally:
            for path, values in samples.items():
                self._replace_samples(path, values)

    def _samples(self, path: Sdf.Path) -> dict[float | None, Any]:
        """The values of an attribute in the layer, by time code; the default's is None."""
        samples: dict[float | None, Any] = {
            time: self.layer.QueryTimeSample(path, time) for time in self.layer.ListTimeSamplesForPath(path)
        }
        default = self.layer.GetAttributeAtPath(path).default
        return samples if default is None else samples | {None: default}

    def _replace_samples(self, path: Sdf.Path, samples: Mapping[float | None, Any]) -> None:
        """Make these the values of an attribute in the layer."""
        spec = self.layer.GetAttributeAtPath(path)
        with Sdf.ChangeBlock():
            spec.ClearDefaultValue()
            for time in self.layer.ListTimeSamplesForPath(path):
                self.layer.EraseTimeSample(path, time)
            for time, value in samples.items():
                if time is None:
                    spec.default = value
                else:
                    self.layer.SetTimeSample(path, time, value)

    def _local(self, skinned: Skinned, time: float | None, posed: float = 1.0) -> Vt.Vec3fArray | Sdf.ValueBlock:
        """A mesh's deformed points in the mesh's space; as authored if UsdSkel rejects the influences."""
        code, prim = timecode(time), self._stage.GetPrimAtPath(skinned.path)
        points = skinned.points(time, posed)
        if points is None:
            return _points(prim, code) or Sdf.ValueBlock()
        if skinned.space == skinned.path:
            return points
        transforms = UsdGeom.XformCache(code)
        deforming = transforms.GetLocalToWorldTransform(self._stage.GetPrimAtPath(skinned.space))
        matrix = np.array(deforming * transforms.GetLocalToWorldTransform(prim).GetInverse()).T
        with np.errstate(over="ignore"):  # The inverse of a singular matrix; the prim is absent at this time code.
            local = place(np.asarray(points, dtype=np.float64), matrix).astype(np.float32)
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(local))

    def prims(self) -> list[Sdf.Path]:
        """Paths of the skeletons and animations of the baked meshes."""
        paths = [path for skinned in self.skinned.values() for path in (skinned.skeleton, skinned.animation)]
        return [path for path in dict.fromkeys(paths) if path is not None]

    def rest_transform(self, path: Sdf.Path, time: float | None) -> Gf.Matrix4d:
        """Matrix (row vectors) from a skinned mesh's rest points to world: its bind transform, then the skeleton's."""
        skinned, code = self.skinned[path], timecode(time)
        placed = UsdGeom.XformCache(code).GetLocalToWorldTransform(self._stage.GetPrimAtPath(skinned.space))
        return skinned.bind_transform(code) * placed


def _skinning_transforms(joints: UsdSkel.SkeletonQuery, code: Usd.TimeCode, posed: float) -> Vt.Matrix4dArray:
    """Matrices (row vectors) of the joints from the bind pose to a pose between it (0) and that at a time code (1).

    Each joint turns, moves and scales relative to its parent; joints without a parent are as at the time code.
    """
    if posed >= 1.0:
        return joints.ComputeSkinningTransforms(code)
    inverse = [matrix.GetInverse() for matrix in joints.GetJointWorldBindTransforms()]
    places = list[Gf.Matrix4d]()  # In the skeleton's space; parents come before their children.
    for joint, animated in enumerate(joints.ComputeJointLocalTransforms(code)):
        parent = joints.GetTopology().GetParent(joint)
        if parent < 0:
            places.append(animated)
        else:
            bound = inverse[joint].GetInverse() * inverse[parent]
            places.append(_between(bound, animated, posed) * places[parent])
    return Vt.Matrix4dArray([start * place for start, place in zip(inverse, places, strict=True)])


def _between(first: Gf.Matrix4d, second: Gf.Matrix4d, part: float) -> Gf.Matrix4d:
    """A transform (row vectors) between two: rotations by the shortest way, translations and scales linearly."""
    decompose, make = cast(Any, UsdSkel.DecomposeTransform), cast(Any, UsdSkel.MakeTransform)
    (start, turn, scale), (end, last_turn, last_scale) = decompose(first), decompose(second)
    sizes = Gf.Lerp(part, Gf.Vec3d(scale), Gf.Vec3d(last_scale))
    return make(Gf.Lerp(part, start, end), Gf.Slerp(part, turn, last_turn), Gf.Vec3h(sizes))


def skel_root(prim: Usd.Prim) -> Usd.Prim | None:
    """The skel root above a prim; None if UsdSkel does not affect the prim."""
    return next((ancestor for ancestor in with_ancestors(prim) if UsdSkel.Root(ancestor)), None)


def find_skinned(stage: Usd.Stage, paths: Iterable[Sdf.Path]) -> tuple[dict[Sdf.Path, Skinned], list[Notice]]:
    """The meshes that UsdSkel deforms, by path, and notices of bindings that UsdSkel rejects or ignores."""
    skins, notices, wanted = dict[Sdf.Path, Skinned](), list[Notice](), dict.fromkeys(paths)
    for root in dict.fromkeys(root for path in wanted if (root := skel_root(stage.GetPrimAtPath(path)))):
        cache = UsdSkel.Cache()
        with quiet() as diagnostics:
            cache.Populate(UsdSkel.Root(root), TRAVERSAL)
            bindings = cache.ComputeSkelBindings(UsdSkel.Root(root), TRAVERSAL)
            texts = [diagnostic.commentary for diagnostic in diagnostics.TakeUncoalescedDiagnostics()]
        targets = [
            (query, binding_of.GetSkeleton()) for binding_of in bindings for query in binding_of.GetSkinningTargets()
        ]
        for query, skeleton in targets:
            if query.GetPrim().GetPath() in wanted and (query.HasJointInfluences() or query.HasBlendShapes()):
                skinned = _skinned(query, cache.GetSkelQuery(skeleton))
                fault = _rejected(skinned)
                skins |= {} if fault else {skinned.path: skinned}
                notices += [*fault, *_diagnosed(skinned, texts), *_ignored_animation(stage, skinned)]
    return skins, notices


def _points(prim: Usd.Prim, code: Usd.TimeCode) -> Vt.Vec3fArray | None:
    """A mesh's authored points; None without any, or if the value is of another type."""
    points = UsdGeom.PointBased(prim).GetPointsAttr().Get(code)
    return points if isinstance(points, Vt.Vec3fArray) else None


def _skinned(query: UsdSkel.SkinningQuery, joints: UsdSkel.SkeletonQuery) -> Skinned:
    """A mesh and its motion, from UsdSkel's queries."""
    prim, played = query.GetPrim(), joints.GetAnimQuery()
    skeleton = _target(_binder(prim, _SKELETON), _SKELETON) or joints.GetPrim().GetPath()
    bones = prim.GetStage().GetPrimAtPath(skeleton)
    values = [played.GetPrim().GetAttribute(name) for name in _ANIMATED] if played else []
    bent = {"rotations", "scales"} | ({"blendShapeWeights"} if _has_inbetweens(prim) else set())
    by = [motion_by(attribute, turns=attribute.GetName() in bent) for attribute in values if attribute]
    motion = Motion.joined([*by, motion_alone(bones), motion_alone(prim)])
    shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim)) if query.HasBlendShapes() else None
    animation = _target(_binder(bones, _ANIMATION), _ANIMATION) if played else None
    return Skinned(prim.GetPath(), motion, query, joints, skeleton, animation, shapes)


def _has_inbetweens(prim: Usd.Prim) -> bool:
    """Whether a mesh has a blend shape with in-between shapes."""
    targets = UsdSkel.BindingAPI(prim).GetBlendShapeTargetsRel().GetTargets()
    shapes = (UsdSkel.BlendShape(prim.GetStage().GetPrimAtPath(path)) for path in targets)
    return any(shape and shape.GetInbetweens() for shape in shapes)


def _binder(prim: Usd.Prim, name: str, *, applied: bool = True) -> Usd.Prim | None:
    """The nearest prim up to the skel root with a binding relationship; UsdSkel reads those with SkelBindingAPI.

    Args:
        prim: A mesh or a skeleton.
        name: Name of the relationship.
        applied: Whether prims without SkelBindingAPI are passed over, as UsdSkel does.
    """
    for ancestor in with_ancestors(prim):
        if ancestor.GetRelationship(name).HasAuthoredTargets() and (not applied or ancestor.HasAPI(_API)):
            return ancestor
        if UsdSkel.Root(ancestor):
            break
    return None


def _target(prim: Usd.Prim | None, name: str) -> Sdf.Path | None:
    """The target of a prim's relationship; None without prim or target."""
    return next(iter(prim.GetRelationship(name).GetForwardedTargets()), None) if prim else None


def _rejected(skinned: Skinned) -> list[Notice]:
    """A notice of points, of joint influences or of a bind pose that UsdSkel rejects; empty if the mesh is skinned."""
    prim, time = skinned.query.GetPrim(), next(iter(skinned.motion.times), None)
    points = value_at(UsdGeom.PointBased(prim).GetPointsAttr(), time) if UsdGeom.PointBased(prim) else None
    if points is not None and not isinstance(points, Vt.Vec3fArray):
        message = "is not skinned and stays in its bind pose, because its points are of another type; author point3f[]"
        return [Notice(str(skinned.path), None, message)]
    with quiet() as diagnostics:
        if not points or skinned.points(time) is not None:
            return []
        texts = [in_brief(diagnostic.commentary).rstrip(".") for diagnostic in diagnostics.TakeUncoalescedDiagnostics()]
    indices, size = skinned.query.GetJointIndicesPrimvar(), skinned.query.GetNumInfluencesPerComponent()
    count, remainder = divmod(np.size(value_at(indices.GetAttr(), time) or ()), len(points))
    reason = f"UsdSkel rejects its joint influences: {texts[0]}" if texts else "UsdSkel rejects them"
    remedy = (
        "bind it again" if remainder or count in (0, size) else f"set elementSize of its joint influences to {count}"
    )
    if not skinned.joints.HasBindPose():
        reason, remedy = (
            f"<{skinned.skeleton}> has no bind pose",
            "author one bindTransform for each of its joints",
        )
    message = f"is not skinned and stays in its bind pose, because {reason}; {remedy}"
    return [Notice(str(skinned.path), None, message)]


def _diagnosed(skinned: Skinned, texts: Iterable[str]) -> list[Notice]:
    """The first of UsdSkel's diagnostics of a mesh, of its skeleton and of its animation, as notices.

    A missing rest pose does not matter where the animation moves every joint.
    """
    played, partial = skinned.joints.GetAnimQuery(), skinned.joints.GetMapper().IsSparse()
    prims = {str(skinned.query.GetPrim().GetPath()): (skinned.path, "bind it again")}
    prims[str(skinned.joints.GetPrim().GetPath())] = skinned.skeleton, "correct it there"
    if played and skinned.animation:
        remedy = "author one translation, one rotation and one scale for each of its joints"
        prims[str(played.GetPrim().GetPath())] = skinned.animation, remedy
    notices_at = dict[Sdf.Path, Notice]()
    for text in texts:
        location, _, reason = text.partition(" -- ")
        path, remedy = prims.get(location.partition(".")[0], (None, ""))
        if path is not None and not (played and not partial and "restTransforms" in reason):
            message = f"UsdSkel rejects a part of it: {in_brief(reason).rstrip('.')}; {remedy}"
            notices_at.setdefault(path, Notice(str(path), None, message))
    return [*notices_at.values()]


def _ignored_animation(stage: Usd.Stage, skinned: Skinned) -> list[Notice]:
    """A notice of an animation ignored by UsdSkel: a prim without SkelBindingAPI authors skel:animationSource."""
    binder = _binder(stage.GetPrimAtPath(skinned.skeleton), _ANIMATION, applied=False)
    if binder is None or binder.HasAPI(_API):
        return []
    message = f"names the animation <{_target(binder, _ANIMATION)}> but has no {_API}: UsdSkel ignores the animation,"
    message += f" and <{skinned.path}> stays in the skeleton's rest pose; apply {_API} to <{binder.GetPath()}>"
    return [Notice(str(binder.GetPath()), None, message)]


def _unskinned(prim: Usd.Prim) -> list[Notice]:
    """A notice of joint influences not used by UsdSkel, with the remedy."""
    binding = UsdSkel.BindingAPI(prim)
    if not any(
        attribute.HasAuthoredValue() for attribute in (binding.GetJointIndicesAttr(), binding.GetJointWeightsAttr())
    ):
        return []
    return [Notice(str(prim.GetPath()), None, f"has joint influences but is not skinned: {_why_unskinned(prim)}")]


def _why_unskinned(prim: Usd.Prim) -> str:
    """Why UsdSkel does not skin a mesh with joint influences, and the remedy."""
    root, binder = skel_root(prim), _binder(prim, _SKELETON, applied=False)
    if root is None:
        return "it has no SkelRoot above it; make a prim above mesh and Skeleton a SkelRoot"
    between = [
        ancestor for ancestor in with_ancestors(prim.GetParent()) if ancestor.GetPath().HasPrefix(root.GetPath())
    ]
    if folder := next((ancestor for ancestor in reversed(between) if not UsdGeom.Imageable(ancestor)), None):
        kind = f"is a {folder.GetTypeName()}" if folder.GetTypeName() else "has no type"
        return f"<{folder.GetPath()}> {kind}, and UsdSkel skins nothing below it; make it a Scope"
    if binder is None:
        return f"it is bound to no skeleton; author {_SKELETON} on it or above it"
    if bare := next((bound_prim for bound_prim in (binder, prim) if not bound_prim.HasAPI(_API)), None):
        return f"<{bare.GetPath()}> has no {_API}, without which UsdSkel ignores its binding; apply {_API} to it"
    target = _target(binder, _SKELETON) or Sdf.Path.emptyPath
    if not UsdSkel.Skeleton(prim.GetStage().GetPrimAtPath(target)):
        return f"{_SKELETON} of <{binder.GetPath()}> names <{target}>, which is no Skeleton; name its Skeleton"
    return "it has only one of jointIndices and jointWeights; author both"
