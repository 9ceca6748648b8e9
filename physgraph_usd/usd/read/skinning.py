"""Bakes UsdSkel skinning and blend shapes into an anonymous layer of the session.

Nothing is written to disk and the stage's own layers are not touched. After baking, a skinned mesh has ordinary point
samples, in its own local space.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ...errors import GarmentError
from ..lookup import with_ancestors
from ..stage import TRAVERSAL, Notice, timecode
from ..times import Motion, merge, motion_alone, motion_by, motion_of
from .find import instance_roots

_ANIMATED = ("rotations", "translations", "scales", "blendShapeWeights")
"""Attributes of an animation. Translations alone, and weights of shapes without in-betweens, move points straight."""


@dataclass(frozen=True, eq=False)
class Skinned:
    """A mesh deformed by UsdSkel.

    Attributes:
        motion: Motion of the mesh by the skeleton's animation, and by the transforms of skeleton and mesh.
        query: UsdSkel's query of the binding.
    """

    path: Sdf.Path
    root: Sdf.Path
    motion: Motion
    query: UsdSkel.SkinningQuery
    skeleton: Sdf.Path
    animation: Sdf.Path | None


class Bake:
    """The anonymous layer of baked points, on top of the stage.

    Attributes:
        skinned: The baked meshes, by prim path.
        layer: The anonymous layer; keep the layer alive as long as the stage.
    """

    def __init__(self, stage: Usd.Stage) -> None:
        """Put an empty anonymous layer on the stage's session layer."""
        self._stage = stage
        self.skinned: dict[Sdf.Path, Skinned] = {}
        self.layer = Sdf.Layer.CreateAnonymous("physgraph-skinning.usda")
        # A layer without authored rate has 24 time codes per second, and USD would rescale the baked samples.
        self.layer.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
        stage.GetSessionLayer().subLayerPaths.insert(0, self.layer.identifier)

    def bind(self, paths: Sequence[Sdf.Path]) -> list[Notice]:
        """Find the skinned among mesh prims, to be baked; notices of prims with unused joint influences.

        Prims inside instances become editable in the anonymous layer.
        """
        bound = [path for path in paths if skel_root(self._stage.GetPrimAtPath(path))]
        for path in bound:
            while roots := instance_roots(self._stage.GetPrimAtPath(path)):
                Sdf.CreatePrimInLayer(self.layer, roots[0]).instanceable = False
        self.skinned.update({path: skinned for path in bound if (skinned := _find_skinning(self._stage, path))})
        bare = [path for path in paths if path not in self.skinned]
        return [notice for path in bare for notice in _unskinned(self._stage.GetPrimAtPath(path))]

    def motion(self, prim: Usd.Prim) -> Motion:
        """Motion of a prim as by `motion_of`; a skinned prim's own points do not count."""
        return motion_of(prim, skinned={path: each.motion for path, each in self.skinned.items()})

    def bake(self, times: Sequence[float]) -> None:
        """Bake the skinned prims at the samples of their animation, and at the time codes given.

        Raises:
            GarmentError: When UsdSkel bakes nothing for a skinned mesh.
        """
        if self.skinned:
            _bake(self._stage, self.layer, [*self.skinned.values()], times)
        for skinned in self.skinned.values():
            _check(self._stage, self.layer, skinned)

    def prims(self) -> list[Sdf.Path]:
        """Paths of the skeletons and animations of the baked meshes."""
        found = [path for skinned in self.skinned.values() for path in (skinned.skeleton, skinned.animation)]
        return [path for path in dict.fromkeys(found) if path is not None]

    def rest_transform(self, path: Sdf.Path, time: float | None) -> Gf.Matrix4d:
        """Matrix (row vectors) from a skinned mesh's rest points to world: geomBindTransform, then the skeleton's."""
        skinned = self.skinned[path]
        code = timecode(time)
        skeleton = self._stage.GetPrimAtPath(skinned.skeleton)
        return skinned.query.GetGeomBindTransform(code) * UsdGeom.XformCache(code).GetLocalToWorldTransform(skeleton)


def skel_root(prim: Usd.Prim) -> Usd.Prim | None:
    """The skel root above a prim; None if UsdSkel does not affect the prim."""
    return next((each for each in with_ancestors(prim) if UsdSkel.Root(each)), None)


def _find_skinning(stage: Usd.Stage, path: Sdf.Path) -> Skinned | None:
    """The skinning of a mesh by UsdSkel, or None."""
    prim = stage.GetPrimAtPath(path)
    root = skel_root(prim)
    if root is None:
        return None
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(root), TRAVERSAL)
    for binding in cache.ComputeSkelBindings(UsdSkel.Root(root), TRAVERSAL):
        for query in binding.GetSkinningTargets():
            if query.GetPrim() == prim and (query.HasJointInfluences() or query.HasBlendShapes()):
                skeleton = cache.GetSkelQuery(binding.GetSkeleton())
                query_of_animation, bones = skeleton.GetAnimQuery(), skeleton.GetPrim()
                animation = query_of_animation.GetPrim() if query_of_animation else None
                values = [animation.GetAttribute(name) for name in _ANIMATED] if animation else []
                bent = {"rotations", "scales"} | ({"blendShapeWeights"} if _has_inbetweens(prim) else set())
                by = [motion_by(each, turns=each.GetName() in bent) for each in values if each]
                motion = Motion.joined([*by, motion_alone(bones), motion_alone(prim, shape=False)])
                moved_by = animation.GetPath() if animation else None
                return Skinned(path, root.GetPath(), motion, query, bones.GetPath(), moved_by)
    return None


def _has_inbetweens(prim: Usd.Prim) -> bool:
    """Whether a mesh has a blend shape with in-between shapes."""
    targets = UsdSkel.BindingAPI(prim).GetBlendShapeTargetsRel().GetTargets()
    shapes = (UsdSkel.BlendShape(prim.GetStage().GetPrimAtPath(path)) for path in targets)
    return any(shape and shape.GetInbetweens() for shape in shapes)


def _bake(stage: Usd.Stage, layer: Sdf.Layer, wanted: Sequence[Skinned], times: Sequence[float]) -> None:
    """Bake each skel root once, with unwanted skinned prims deactivated meanwhile."""
    keep = [skinned.path for skinned in wanted]
    roots = list(dict.fromkeys(skinned.root for skinned in wanted))
    mask = Sdf.Layer.CreateAnonymous("physgraph-mask.usda")
    mask.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
    for path in _others(stage, roots, keep):
        Sdf.CreatePrimInLayer(mask, path).active = False
    session = stage.GetSessionLayer()
    session.subLayerPaths.insert(0, mask.identifier)
    try:
        for skinned in wanted:
            _sample_animation(stage, mask, skinned, times)
        with Usd.EditContext(stage, layer):
            for root in roots:
                UsdSkel.BakeSkinning(UsdSkel.Root.Get(stage, root), Gf.Interval.GetFullInterval())
    finally:
        session.subLayerPaths.remove(mask.identifier)


def _sample_animation(stage: Usd.Stage, layer: Sdf.Layer, skinned: Skinned, times: Sequence[float]) -> None:
    """In a temporary layer, sample the animation at the time codes of transforms and of the shot too.

    UsdSkel bakes at the animation's samples; in between, baked points would move along a chord.
    """
    animation = stage.GetPrimAtPath(skinned.animation) if skinned.animation else None
    if animation is None or animation.IsInstanceProxy():
        return
    attributes = [animation.GetAttribute(name) for name in _ANIMATED]
    attribute = next((each for each in attributes if each and each.GetNumTimeSamples()), None)
    if attribute is None:
        return
    samples = attribute.GetTimeSamples()
    every = {*samples, *merge(samples, skinned.motion.times, times)}
    if len(every) == len(samples):
        return
    values = {time: attribute.Get(time) for time in every}
    with Usd.EditContext(stage, layer):
        for time, value in values.items():
            attribute.Set(value, time)


def _others(stage: Usd.Stage, roots: Iterable[Sdf.Path], keep: Sequence[Sdf.Path]) -> list[Sdf.Path]:
    """Skinnable prims below the roots, except wanted prims and their ancestors."""
    below = [prim for root in roots for prim in Usd.PrimRange(stage.GetPrimAtPath(root))]
    skinnable = [prim.GetPath() for prim in below if UsdSkel.IsSkinnablePrim(prim)]
    return [path for path in skinnable if not any(each.HasPrefix(path) for each in keep)]


def _check(stage: Usd.Stage, layer: Sdf.Layer, skinned: Skinned) -> None:
    """Convert a rigid mesh's baked transform to points; GarmentError if baking produced neither."""
    if layer.GetAttributeAtPath(skinned.path.AppendProperty("points")) is not None:
        return
    if layer.GetAttributeAtPath(skinned.path.AppendProperty(UsdGeom.Tokens.xformOpOrder)) is not None:
        _rigid_points(stage, layer, skinned.path)
        return
    remedy = "check skel:skeleton, skel:animationSource and the joint influences"
    raise GarmentError(str(skinned.path), "is skinned, but UsdSkel baked no points for it", remedy=remedy)


def _rigid_points(stage: Usd.Stage, layer: Sdf.Layer, path: Sdf.Path) -> None:
    """Move a baked transform into the points, so the prim keeps the transform of its layers."""
    mesh = UsdGeom.Mesh.Get(stage, path)
    times = mesh.GetTimeSamples() or [None]
    codes = [timecode(time) for time in times]
    baked = [UsdGeom.XformCache(code).GetLocalToWorldTransform(mesh.GetPrim()) for code in codes]
    spec = layer.GetPrimAtPath(path)
    for each in [each for each in spec.properties if each.name.startswith("xformOp")]:
        spec.RemoveProperty(each)
    with Usd.EditContext(stage, layer):
        for code, matrix in zip(codes, baked, strict=True):
            unbaked = UsdGeom.XformCache(code).GetLocalToWorldTransform(mesh.GetPrim())
            change = np.array(matrix * unbaked.GetInverse())
            local = np.asarray(mesh.GetPointsAttr().Get(Usd.TimeCode.Default()), dtype=np.float64)
            moved = local @ change[:3, :3] + change[3, :3]
            mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(moved, dtype=np.float32)), code)


def _unskinned(prim: Usd.Prim) -> list[Notice]:
    """A notice of joint influences not used by UsdSkel."""
    binding = UsdSkel.BindingAPI(prim)
    if not binding.GetJointIndicesAttr().HasAuthoredValue():
        return []
    reason = "it has no SkelRoot above it" if skel_root(prim) is None else "it is bound to no skeleton"
    return [Notice(str(prim.GetPath()), None, f"has joint influences but is not skinned: {reason}")]
