"""Small parametric stages for tests: one sheet of cloth that waves, under every convention that shots come in."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from meshes import quads_of
from numpy.typing import ArrayLike
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt

from physgraph_usd.usd.read.reader import Shot
from physgraph_usd.usd.stage import quiet
from physgraph_usd.usd.write.plain import PlainStage

GARMENT_API = "PhysGraphGarmentAPI"
COLLIDER_API = "PhysGraphColliderAPI"
SIZE = (4, 3)
KINDS = ("quads", "triangles", "ngons", "mixed")


@cache
def built(sample: str) -> PlainStage:
    """A sample's record, made once in a process; do not change it."""
    module, _, variant = sample.partition("_")
    return import_module(f"physgraph_usd.lab.samples.{module}").build(*filter(None, [variant]))


def new_stage(path: Path, *, metres: float | None = 1.0, up: str = "Y", rate: float = 24.0) -> Usd.Stage:
    """A stage with a root transform ``/World``; ``metres=None`` leaves metersPerUnit unauthored."""
    stage = Usd.Stage.CreateNew(str(path))
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    UsdGeom.SetStageUpAxis(stage, up)
    if metres is not None:
        UsdGeom.SetStageMetersPerUnit(stage, metres)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    return stage


def sheet_points(time: float | None = None, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Points of the sheet, a grid of unit squares in the plane of x and y that waves in z as time goes, float32."""
    x, y = np.meshgrid(np.arange(size[0] + 1.0), np.arange(size[1] + 1.0))
    phase = 0.0 if time is None else float(time)
    points = np.stack([x, y, 0.3 * np.sin(x + 0.5 * y + 0.7 * phase)], axis=-1)
    return points.reshape(-1, 3).astype(np.float32)


def sheet_faces(kind: str = "quads", size: tuple[int, int] = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Counts and indices that cover the sheet with one of ``KINDS``; faces turn counterclockwise about +z."""
    quads = quads_of(size[0] + 1, size[1] + 1).tolist()
    if kind == "triangles":
        faces = [part for a, b, c, d in quads for part in ([a, b, c], [a, c, d])]
    elif kind == "mixed":
        faces = [
            part for i, (a, b, c, d) in enumerate(quads) for part in ([[a, b, c], [a, c, d]], [[a, b, c, d]])[i % 2]
        ]
    elif kind == "ngons":
        rows = [quads[i : i + size[0]] for i in range(0, len(quads), size[0])]
        faces = [[*(q[0] for q in row), row[-1][1], row[-1][2], *(q[3] for q in reversed(row))] for row in rows]
    else:
        faces = quads
    return np.array([len(face) for face in faces], np.int32), np.array([i for face in faces for i in face], np.int32)


def vec3(points: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32))


def add_sheet(
    stage: Usd.Stage,
    path: str = "/World/cloth",
    *,
    kind: str = "quads",
    times: Sequence[float] = (1.0, 2.0, 3.0),
    default: bool = True,
    tagged: bool = True,
    size: tuple[int, int] = SIZE,
) -> UsdGeom.Mesh:
    """A sheet with point samples at the given times; ``tagged`` makes it a garment."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    counts, indices = sheet_faces(kind, size)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(indices))
    if default:
        mesh.CreatePointsAttr(vec3(sheet_points(None, size)))
    for time in times:
        mesh.CreatePointsAttr().Set(vec3(sheet_points(time, size)), time)
    if tagged:
        mesh.GetPrim().AddAppliedSchema(GARMENT_API)
    return mesh


def add_mesh(
    stage: Usd.Stage,
    path: str,
    points: ArrayLike,
    faces: Iterable[Iterable[int]],
    *,
    schema: str | None = GARMENT_API,
    scheme: str | None = None,
) -> UsdGeom.Mesh:
    """A mesh of faces, by their corners, with default points; a garment unless it gets another schema, or none."""
    mesh, corners = UsdGeom.Mesh.Define(stage, path), [list(map(int, face)) for face in faces]
    mesh.CreateFaceVertexCountsAttr([len(face) for face in corners])
    mesh.CreateFaceVertexIndicesAttr([corner for face in corners for corner in face])
    mesh.CreatePointsAttr(vec3(np.asarray(points)))
    if schema is not None:
        mesh.GetPrim().AddAppliedSchema(schema)
    if scheme is not None:
        mesh.CreateSubdivisionSchemeAttr(scheme)
    return mesh


def add_subset(stage: Usd.Stage, name: str, faces: np.ndarray, **values: float) -> None:
    """A subset of the cloth's faces with a material and our schema's values, or UsdPhysics' (physics_...)."""
    indices = Vt.IntArray.FromNumpy(faces.astype(np.int32))
    subset = UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/World/cloth")).CreateMaterialBindSubset(
        name, indices
    )
    material = UsdShade.Material.Define(stage, f"/World/looks/{name}")
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    for short, value in values.items():
        full = short.replace("physics_", "physics:") if "physics_" in short else f"physgraph:material:{short}"
        author(material.GetPrim(), full, value)


def said(shot: Shot) -> str:
    """Warnings of an open shot, one a line."""
    return "\n".join(map(str, shot.warnings))


def save(stage: Usd.Stage) -> str:
    """Save a stage and give its file; the stage may be dropped."""
    stage.Save()
    return str(stage.GetRootLayer().realPath)


def sheet_shot(path: Path, **options) -> str:
    """A saved shot with one sheet, ``options`` as for ``add_sheet``."""
    stage = new_stage(path)
    add_sheet(stage, **options)
    return save(stage)


def author(
    prim: Usd.Prim, name: str, value: object, *, kind: str = "float", time: float | None = None
) -> Usd.Attribute:
    """Author an attribute of an Sdf type given by name."""
    attribute = prim.CreateAttribute(name, value_type(kind))
    attribute.Set(value, Usd.TimeCode.Default() if time is None else time)
    return attribute


def value_type(kind: str) -> Sdf.ValueTypeName:
    """The Sdf type of a name such as ``float[]``."""
    return Sdf.ValueTypeNames.Find(kind)  # pyright: ignore[reportCallIssue]  the stubs know no argument


def add_skeleton(stage: Usd.Stage, root: str, times: Sequence[float], *, blend: bool = False) -> None:
    """A skel root with two joints along x; the second turns about z by a tenth of the time in radians."""
    UsdSkel.Root.Define(stage, root)
    skeleton = UsdSkel.Skeleton.Define(stage, f"{root}/skel")
    joints = ["hip", "hip/knee"]
    bind = [Gf.Matrix4d(1.0), Gf.Matrix4d().SetTranslate((2.0, 0.0, 0.0))]
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray(bind))
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray(bind))
    animation = UsdSkel.Animation.Define(stage, f"{root}/skel/anim")
    animation.CreateJointsAttr(joints)
    animation.CreateTranslationsAttr(Vt.Vec3fArray([(0, 0, 0), (2, 0, 0)]))
    animation.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1, 1, 1)] * 2))
    for time in times:
        half = 0.05 * time
        turned = Gf.Quatf(float(np.cos(half)), 0.0, 0.0, float(np.sin(half)))
        animation.CreateRotationsAttr().Set(Vt.QuatfArray([Gf.Quatf(1.0), turned]), time)
        if blend:
            animation.CreateBlendShapeWeightsAttr().Set([float(time)], time)
    if blend:
        animation.CreateBlendShapesAttr(["bulge"])
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])


def bind_skin(mesh: UsdGeom.Mesh, root: str, *, joints: Sequence[int], blend: np.ndarray | None = None) -> None:
    """Bind every vertex of a mesh to one joint each, and give it a blend shape of the given offsets."""
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([f"{root}/skel"])
    binding.CreateJointIndicesPrimvar(False, 1).Set(Vt.IntArray([int(joint) for joint in joints]))
    binding.CreateJointWeightsPrimvar(False, 1).Set(Vt.FloatArray([1.0] * len(joints)))
    if blend is not None:
        shape = UsdSkel.BlendShape.Define(mesh.GetPrim().GetStage(), mesh.GetPath().AppendChild("bulge"))
        shape.CreateOffsetsAttr(vec3(blend))
        binding.CreateBlendShapesAttr(["bulge"])
        binding.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])


def skinned_points(points: np.ndarray, joints: Sequence[int], time: float) -> np.ndarray:
    """What skinning by ``add_skeleton`` makes of points: those of joint 1 turn about (2, 0, 0)."""
    cos, sin = np.cos(0.1 * time), np.sin(0.1 * time)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    pivot = np.array([2.0, 0.0, 0.0])
    turned = (points.astype(np.float64) - pivot) @ turn.T + pivot
    return np.where(np.asarray(joints)[:, None] == 1, turned, points)


def set_matrix(prim: Usd.Prim, matrix: np.ndarray, time: float | None = None) -> None:
    """Place a prim by one transform op; ``matrix`` acts on column vectors, shape (4, 4)."""
    xform = UsdGeom.Xformable(prim)
    ops = xform.GetOrderedXformOps()
    op = ops[0] if ops else xform.AddTransformOp()
    op.Set(Gf.Matrix4d(np.asarray(matrix, float).T.tolist()), Usd.TimeCode.Default() if time is None else time)


def set_spline(
    attribute: Usd.Attribute,
    knots: Mapping[float, float],
    *,
    post: str = "Held",
    gaps: Collection[float] = (),
    loops: int = 0,
) -> None:
    """Give a double attribute a spline of straight segments; skips the test with a USD older than splines.

    Args:
        attribute: An attribute of type double.
        knots: Values by time code.
        post: USD's name of the extrapolation after the last knot.
        gaps: Time codes of the knots after which the attribute has no value.
        loops: How often the knots repeat after the last one, by an inner loop.
    """
    if not hasattr(Usd.Attribute, "SetSpline"):
        pytest.skip("splines came with a later USD")
    ts: Any = import_module("pxr.Ts")
    spline = ts.Spline("double")
    for time, value in knots.items():
        knot = ts.Knot("double")
        knot.SetTime(time)
        knot.SetValue(value)
        knot.SetNextInterpolation(ts.InterpValueBlock if time in gaps else ts.InterpLinear)
        spline.SetKnot(knot)
    spline.SetPostExtrapolation(ts.Extrapolation(getattr(ts, f"Extrap{post}")))
    with quiet():  # USD 26 calls inner loops deprecated.
        if loops:
            params = spline.GetInnerLoopParams()
            params.protoStart, params.protoEnd, params.numPostLoops = min(knots), max(knots), loops
            spline.SetInnerLoopParams(params)
    splined: Any = attribute
    splined.SetSpline(spline)


def affine(linear: ArrayLike, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """A (4, 4) matrix for column vectors."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, offset
    return matrix


def instanced_shot(folder: Path, *, skinned: bool = False) -> str:
    """Two instances of one asset, ``/World/one`` and ``/World/two`` (ten to the right), each with a sheet ``cloth``."""
    asset = Usd.Stage.CreateNew(str(folder / "asset.usda"))
    asset.SetTimeCodesPerSecond(24.0)
    asset.SetDefaultPrim(UsdGeom.Xform.Define(asset, "/Asset").GetPrim())
    if skinned:
        add_skeleton(asset, "/Asset/rig", (1.0, 2.0, 3.0))
        mesh = add_sheet(asset, "/Asset/rig/cloth", times=())
        bind_skin(mesh, "/Asset/rig", joints=[int(x > 2) for x in sheet_points()[:, 0]])
    else:
        add_sheet(asset, "/Asset/cloth")
    asset.Save()
    stage = new_stage(folder / "shot.usda")
    for index, name in enumerate(("one", "two")):
        prim = UsdGeom.Xform.Define(stage, f"/World/{name}").GetPrim()
        prim.GetReferences().AddReference("./asset.usda")
        prim.SetInstanceable(True)
        UsdGeom.XformCommonAPI(prim).SetTranslate((10.0 * index, 0.0, 0.0))
    return save(stage)


def loop_shot(folder: Path, *, size: tuple[int, int] = SIZE, step: float = 1.0, metres: float = 1.0) -> str:
    """A shot whose clip of a sheet that moves along x, by a step a frame, starts again at 3 and at 6."""
    clip = Usd.Stage.CreateNew(str(folder / "walk.usda"))
    points = UsdGeom.Mesh(clip.OverridePrim("/World/cloth")).CreatePointsAttr()
    for time in range(4):
        points.Set(vec3(sheet_points(time, size) + np.array([step * time, 0.0, 0.0])), time)
    clip.Save()
    manifest = Usd.Stage.CreateNew(str(folder / "manifest.usda"))
    UsdGeom.Mesh(manifest.OverridePrim("/World/cloth")).CreatePointsAttr()
    manifest.Save()
    stage = new_stage(folder / "shot.usda", metres=metres)
    clips = Usd.ClipsAPI(add_sheet(stage, times=(), default=False, size=size).GetPrim())
    clips.SetClipAssetPaths([Sdf.AssetPath("./walk.usda")])
    clips.SetClipManifestAssetPath(Sdf.AssetPath("./manifest.usda"))
    clips.SetClipPrimPath("/World/cloth")
    clips.SetClipActive([Gf.Vec2d(0.0, 0.0)])
    clips.SetClipTimes([Gf.Vec2d(*pair) for pair in ((0, 0), (3, 3), (3, 0), (6, 3), (6, 0), (8, 2))])
    return save(stage)


def clip_shot(folder: Path, times: Sequence[float] = (1.0, 2.0, 3.0)) -> str:
    """A shot whose points come from one value clip per time code."""
    for number, time in enumerate(times):
        clip = Usd.Stage.CreateNew(str(folder / f"clip.{number}.usda"))
        points = UsdGeom.Mesh(clip.OverridePrim("/World/cloth")).CreatePointsAttr()
        points.Set(vec3(sheet_points(time)), time)
        clip.Save()
    manifest = Usd.Stage.CreateNew(str(folder / "manifest.usda"))
    UsdGeom.Mesh(manifest.OverridePrim("/World/cloth")).CreatePointsAttr()
    manifest.Save()
    stage = new_stage(folder / "shot.usda")
    # A default in the layer that has the clips would be stronger than they are.
    prim = add_sheet(stage, times=(), default=False).GetPrim()
    clips = Usd.ClipsAPI(prim)
    clips.SetClipAssetPaths([Sdf.AssetPath(f"./clip.{number}.usda") for number in range(len(times))])
    clips.SetClipManifestAssetPath(Sdf.AssetPath("./manifest.usda"))
    clips.SetClipPrimPath("/World/cloth")
    clips.SetClipActive([Gf.Vec2d(time, number) for number, time in enumerate(times)])
    clips.SetClipTimes([Gf.Vec2d(time, time) for time in times])
    return save(stage)
