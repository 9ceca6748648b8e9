"""The sound shots that mutants are made from: small, and between them they use all that a shot may have."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt
from stages import (
    COLLIDER_API,
    add_sheet,
    add_skeleton,
    author,
    bind_skin,
    clip_shot,
    instanced_shot,
    loop_shot,
    new_stage,
    save,
    sheet_points,
    vec3,
)

from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.usd.mesh.shell import Shell

from .poses import write_limb

SIZE = (3, 2)
TIMES = (1.0, 2.0)
METRES = 0.05
CLOTH = "/World/cloth"


def _plain(folder: Path) -> None:
    stage = new_stage(folder / "shot.usda", metres=METRES)
    add_sheet(stage, CLOTH, times=TIMES, size=SIZE)
    save(stage)


def _still(folder: Path) -> None:
    stage = new_stage(folder / "shot.usda", metres=METRES, up="Z")
    add_sheet(stage, CLOTH, times=(), size=SIZE, kind="mixed")
    save(stage)


def _dressed(folder: Path) -> None:
    """Primvars of every interpolation, subsets, a material, painted values, animated parents and stale opinions."""
    stage = new_stage(folder / "shot.usda", metres=METRES)
    rig = UsdGeom.Xform.Define(stage, "/World/rig")
    for time in TIMES:
        UsdGeom.XformCommonAPI(rig).SetTranslate((time, 0.0, 0.0), time)
    mesh = add_sheet(stage, "/World/rig/cloth", times=TIMES, size=SIZE)
    prim, count, faces = mesh.GetPrim(), len(sheet_points(None, SIZE)), SIZE[0] * SIZE[1]
    make, types = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar, Sdf.ValueTypeNames
    uv = make("st", types.TexCoord2fArray, "faceVarying")
    uv.Set(Vt.Vec2fArray.FromNumpy(np.random.default_rng(0).random((4 * faces, 2), dtype=np.float32)))
    uv.SetIndices(Vt.IntArray.FromNumpy(np.arange(4 * faces, dtype=np.int32)))
    make("heat", types.FloatArray, "vertex").Set(Vt.FloatArray([0.5] * count))
    make("label", types.StringArray, "uniform").Set([f"f{face}" for face in range(faces)])
    make("rest", types.Point3fArray, "vertex").Set(vec3(sheet_points(None, SIZE)))
    for name in ("pin", "bendScale", "guideScale"):
        make(f"physgraph:{name}", types.FloatArray, "vertex").Set(Vt.FloatArray([0.25] * count))
    author(prim, "physgraph:material:bendStiffness", 1e-5)
    author(prim, "physgraph:guide:stiffness", 1500.0, time=1.0)
    author(prim, "physgraph:guide:stiffness", 2500.0, time=2.0)
    material = UsdShade.Material.Define(stage, "/World/Looks/red")
    author(material.GetPrim(), "physgraph:material:density", 0.2)
    binding = UsdShade.MaterialBindingAPI.Apply(prim)
    binding.Bind(material)
    for name, members in (("front", range(faces // 2)), ("back", range(faces // 2, faces))):
        binding.CreateMaterialBindSubset(name, list(members))
    mesh.CreateNormalsAttr([(0, 0, 1)] * count)
    mesh.CreateHoleIndicesAttr([1])
    mesh.CreateCreaseIndicesAttr([0, 1])
    mesh.CreateCreaseLengthsAttr([2])
    mesh.CreateCreaseSharpnessesAttr([2.0])
    author(prim.GetParent(), "extentsHint", Vt.Vec3fArray([(0, 0, 0), (1, 1, 1)]), kind="float3[]")
    save(stage)


def _bodies(folder: Path) -> None:
    """A sheet over one collider of each kind, one of them by UsdPhysics, and a physics scene."""
    stage = new_stage(folder / "shot.usda", metres=METRES)
    cloth = add_sheet(stage, CLOTH, times=TIMES, size=SIZE)
    scene = UsdPhysics.Scene.Define(stage, "/World/physics")
    scene.CreateGravityMagnitudeAttr(9.81 / METRES)
    scene.CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
    body = add_sheet(stage, "/World/floor", times=TIMES, size=SIZE, tagged=False, kind="triangles")
    UsdGeom.XformCommonAPI(body).SetTranslate((0.1, 0.1, -0.2))
    body.GetPrim().AddAppliedSchema(COLLIDER_API)
    for index, kind in enumerate(("Sphere", "Capsule", "Cube", "Plane", "Cylinder", "Cone")):
        prim = stage.DefinePrim(f"/World/{kind.lower()}", kind)
        UsdGeom.XformCommonAPI(prim).SetTranslate((0.7 * index, 1.0, -0.9))
        prim.AddAppliedSchema(COLLIDER_API)
        author(prim, "physgraph:collider:offset", 0.001)
    UsdPhysics.CollisionAPI.Apply(stage.GetPrimAtPath("/World/cube"))
    cloth.GetPrim().CreateRelationship("physgraph:colliders").SetTargets(
        [Sdf.Path(f"/World/{name}") for name in ("floor", "sphere", "capsule", "cube", "plane", "cylinder", "cone")]
    )
    save(stage)


def _instances(folder: Path) -> None:
    """A sheet over instanced rocks and two tapered shapes, with stones that hang on it."""
    stage = new_stage(folder / "shot.usda", metres=METRES)
    cloth = add_sheet(stage, CLOTH, times=TIMES, size=SIZE)
    for path, below, radius in (("/World/rocks", -0.8, 0.4), ("/World/stones", 0.02, 0.02)):
        made = UsdGeom.PointInstancer.Define(stage, path)
        UsdGeom.Sphere.Define(stage, f"{path}/protos/ball").CreateRadiusAttr(radius)
        made.CreatePrototypesRel().SetTargets([f"{path}/protos/ball"])
        made.CreateProtoIndicesAttr([0, 0, 0])
        for time in TIMES:
            points = sheet_points(time, SIZE)[[1, 5, 6]] + np.array([0.0, 0.0, below], np.float32)
            made.CreatePositionsAttr().Set(vec3(points), time)
        made.CreateOrientationsAttr([Gf.Quath(1, 0, 0, 0)] * 3)
        made.CreateScalesAttr([(1, 1, 1)] * 3)
    for name, kind in (("limb", "Capsule_1"), ("horn", "Cylinder_1")):
        prim = stage.DefinePrim(f"/World/{name}", kind)
        UsdGeom.XformCommonAPI(prim).SetTranslate((1.0, 1.0, -2.0))
        prim.GetAttribute("radiusTop").Set(0.3)
    names = ("rocks", "limb", "horn")
    cloth.GetPrim().CreateRelationship("physgraph:colliders").SetTargets([f"/World/{name}" for name in names])
    cloth.GetPrim().CreateRelationship("physgraph:bind:targets").SetTargets(["/World/stones"])
    save(stage)


def _skinned(folder: Path) -> None:
    stage = new_stage(folder / "shot.usda", metres=METRES)
    add_skeleton(stage, "/World/rig", TIMES, blend=True)
    mesh = add_sheet(stage, "/World/rig/cloth", times=(), size=SIZE)
    points = sheet_points(None, SIZE)
    bind_skin(mesh, "/World/rig", joints=[int(x > 1) for x in points[:, 0]], blend=np.full_like(points, 0.01))
    save(stage)


def _layered(folder: Path) -> None:
    """Geometry behind a payload, animation in a sublayer that an offset shifts."""
    asset = new_stage(folder / "asset.usda", metres=METRES)
    add_sheet(asset, CLOTH, times=(), size=SIZE)
    save(asset)
    animation = Sdf.Layer.CreateNew(str(folder / "animation.usda"))
    points = Sdf.AttributeSpec(
        Sdf.CreatePrimInLayer(animation, CLOTH), "points", Sdf.ValueTypeNames.Point3fArray, Sdf.VariabilityVarying
    )
    for time in TIMES:
        animation.SetTimeSample(points.path, time, vec3(sheet_points(time, SIZE)))
    animation.Save()
    stage = new_stage(folder / "shot.usda", metres=METRES)
    stage.GetPrimAtPath("/World").GetPayloads().AddPayload("./asset.usda")
    stage.GetRootLayer().subLayerPaths.append("./animation.usda")
    stage.GetRootLayer().subLayerOffsets[0] = Sdf.LayerOffset(100.0, 1.0)
    save(stage)


def _several(folder: Path) -> None:
    """Two garments whose samples lie at different times, one with a triangle membrane."""
    stage = new_stage(folder / "shot.usda", metres=METRES)
    add_sheet(stage, CLOTH, times=(1.0, 2.5), size=SIZE, kind="triangles")
    other = add_sheet(stage, "/World/other", times=(2.0,), size=SIZE, kind="ngons")
    UsdGeom.XformCommonAPI(other).SetTranslate((10.0, 0.0, 0.0))
    author(other.GetPrim(), "physgraph:material:shearStiffness", 9.0)
    save(stage)


def _instanced(folder: Path) -> None:
    instanced_shot(folder)


def _clips(folder: Path) -> None:
    clip_shot(folder, TIMES)


def _sparse(folder: Path) -> None:
    """A skeleton with two keys, and a body that another one turns."""
    stage = new_stage(folder / "shot.usda", metres=METRES)
    points = sheet_points(None, SIZE)
    for root, tagged in (("/World/rig", True), ("/World/other", False)):
        add_skeleton(stage, root, (1.0, 4.0) if tagged else (1.0, 2.5, 6.0))
        mesh = add_sheet(stage, f"{root}/cloth", times=(), size=SIZE, tagged=tagged)
        bind_skin(mesh, root, joints=[int(x > 1) for x in points[:, 0]])
    stage.GetPrimAtPath("/World/other/cloth").AddAppliedSchema(COLLIDER_API)
    UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/World/other")).SetTranslate((0.0, 0.0, -0.2))
    save(stage)


def _rounded(folder: Path) -> None:
    """Cloth at float seconds under transforms at whole frames, and a sphere that turns about the world."""
    stage = new_stage(folder / "shot.usda", metres=METRES)
    rig = UsdGeom.Xform.Define(stage, "/World/rig")
    for time in TIMES:
        UsdGeom.XformCommonAPI(rig).SetTranslate((time, 0.0, 0.0), time)
    add_sheet(stage, "/World/rig/cloth", times=(1.0 - 3e-5, 2.0 + 3e-5), size=SIZE)
    turn = UsdGeom.Xform.Define(stage, "/World/turn").AddRotateZOp()
    turn.Set(0.0, 1.0)
    turn.Set(90.0, 3.0)
    sphere = UsdGeom.Sphere.Define(stage, "/World/turn/sphere")
    sphere.CreateRadiusAttr(0.5)
    UsdGeom.XformCommonAPI(sphere).SetTranslate((3.0, 0.0, 0.0))
    sphere.GetPrim().AddAppliedSchema(COLLIDER_API)
    save(stage)


def _curtain(folder: Path) -> None:
    """Cloth that stands still, and a sphere that moves into it."""
    stage = new_stage(folder / "shot.usda", metres=METRES)
    add_sheet(stage, CLOTH, times=(), size=SIZE)
    sphere = UsdGeom.Sphere.Define(stage, "/World/sphere")
    sphere.GetPrim().AddAppliedSchema(COLLIDER_API)
    for time in (1.0, 2.0, 2.5):
        UsdGeom.XformCommonAPI(sphere).SetTranslate((1.5, 1.0, -2.5 + 0.5 * time), time)
    save(stage)


def _loops(folder: Path) -> None:
    loop_shot(folder, size=SIZE, metres=METRES)


def _thick(folder: Path) -> None:
    """A garment of two skins and a rim."""
    stage = new_stage(folder / "shot.usda", metres=METRES)
    mesh = add_sheet(stage, CLOTH, times=TIMES, size=SIZE)
    counts, indices = mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()
    points = sheet_points(None, SIZE)
    shell = Shell.of(PolygonMesh(np.array(counts.Get()), np.array(indices.Get()), len(points)), np.arange(len(points)))
    counts.Set(Vt.IntArray.FromNumpy(shell.mesh.counts.astype(np.int32)))
    indices.Set(Vt.IntArray.FromNumpy(shell.mesh.indices.astype(np.int32)))
    for time in TIMES:
        skins = shell.thickened(sheet_points(time, SIZE), np.eye(3)[[2] * len(points)], 0.05)
        mesh.GetPointsAttr().Set(vec3(skins), time)
    mesh.GetPointsAttr().ClearDefault()
    save(stage)


BASES: dict[str, Callable[[Path], None]] = {
    "plain": _plain,
    "still": _still,
    "dressed": _dressed,
    "bodies": _bodies,
    "instances": _instances,
    "skinned": _skinned,
    "layered": _layered,
    "several": _several,
    "instanced": _instanced,
    "clips": _clips,
    "sparse": _sparse,
    "rounded": _rounded,
    "curtain": _curtain,
    "loops": _loops,
    "thick": _thick,
    "limb": write_limb,
}
"""What writes each sound shot, ``shot.usda``, into a folder."""


def write_bases(folder: Path) -> None:
    for name, write in BASES.items():
        (folder / name).mkdir(parents=True)
        write(folder / name)


def garments_of(stage: Usd.Stage) -> list[Usd.Prim]:
    """The meshes of a sound shot that have the garment schema, where it can be edited."""
    return [prim for prim in stage.Traverse() if "PhysGraphGarmentAPI" in prim.GetPrimTypeInfo().GetAppliedAPISchemas()]
