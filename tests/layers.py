"""Small shots for the tests of written layers, and a refinement of them that needs no solver."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt
from stages import new_stage, sheet_faces, vec3

from physgraph_usd.solver.mesh.subdivide import Refinement, subdivide_times
from physgraph_usd.solver.scene import GarmentResult, Result
from physgraph_usd.usd.check.validate import validate_layer
from physgraph_usd.usd.mesh.attributes import vertex_values
from physgraph_usd.usd.read.reader import Shot, open_shot
from physgraph_usd.usd.view import root_over
from physgraph_usd.usd.write.writer import LayerWriter

COAT = "/World/rig/coat"
TIMES = (1.0, 2.5, 4.0)
MIRROR = Gf.Matrix4d().SetScale(Gf.Vec3d(-2, 1, 0.5)) * Gf.Matrix4d().SetTranslate(Gf.Vec3d(1e4, -3, 7))
"""A parent that mirrors, scales unevenly and lies far from the origin."""


def grid(columns: int = 4, rows: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points in the plane, counts and indices of a sheet that faces +Z."""
    x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    points = np.stack([x, y, 0.1 * np.sin(x)], axis=-1).reshape(-1, 3)
    return points, *sheet_faces("quads", (columns, rows))


def make_shot(
    path: Path, *, times: Sequence[float] = TIMES, matrix: Gf.Matrix4d | None = None, orientation: str = "rightHanded"
) -> Usd.Stage:
    """A coat under a moving rig, in memory of a new layer; saved, and returned for more edits."""
    stage = new_stage(path, metres=0.01, up="Z", rate=30.0)
    UsdGeom.Xform.Define(stage, "/World/rig").AddTransformOp().Set(matrix or Gf.Matrix4d(1.0))
    points, counts, indices = grid()
    if orientation == "leftHanded":
        indices = indices.reshape(-1, 4)[:, ::-1].reshape(-1).copy()
    mesh = UsdGeom.Mesh.Define(stage, COAT)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(indices))
    mesh.CreateOrientationAttr(orientation)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreatePointsAttr(vec3(points))
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(vec3(points)))
    for index, time in enumerate(times):
        moved = points + np.array([0.0, 0.0, 0.25 * index])
        mesh.CreatePointsAttr().Set(vec3(moved), time)
        mesh.CreateExtentAttr().Set(UsdGeom.PointBased.ComputeExtent(vec3(moved)), time)
    if times:
        stage.SetStartTimeCode(times[0])
        stage.SetEndTimeCode(times[-1])
    mesh.GetPrim().AddAppliedSchema("PhysGraphGarmentAPI")
    stage.Save()
    return stage


def dress_up(stage: Usd.Stage) -> None:
    """Give the coat everything that depends on topology: primvars of all kinds, subsets, stale opinions."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    counts, vertices = len(mesh.GetFaceVertexCountsAttr().Get()), len(mesh.GetPointsAttr().Get())
    corners = len(mesh.GetFaceVertexIndicesAttr().Get())
    make, types = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar, Sdf.ValueTypeNames
    make("heat", types.FloatArray, "vertex").Set(Vt.FloatArray.FromNumpy(np.arange(vertices, dtype=np.float32)))
    indexed = make("tone", types.Color3fArray, "vertex")
    indexed.Set(Vt.Vec3fArray([(1, 0, 0), (0, 0, 1)]))
    indexed.SetIndices(Vt.IntArray.FromNumpy((np.arange(vertices) % 2).astype(np.int32)))
    make("label", types.StringArray, "uniform").Set([f"f{face}" for face in range(counts)])
    make("zone", types.IntArray, "varying").Set(Vt.IntArray.FromNumpy(np.arange(vertices, dtype=np.int32)))
    make("pair", types.HalfArray, "vertex", 2).Set(Vt.HalfArray.FromNumpy(np.arange(2 * vertices, dtype=np.float16)))
    make("tint", types.Color3fArray, "constant").Set([(0.5, 0.5, 0.5)])
    uv = make("st", types.TexCoord2fArray, "faceVarying")
    uv.Set(Vt.Vec2fArray.FromNumpy(np.random.default_rng(0).random((corners, 2), dtype=np.float32)))
    uv.SetIndices(Vt.IntArray.FromNumpy(np.arange(corners, dtype=np.int32)))
    make("physgraph:pin", types.FloatArray, "vertex").Set([0.0] * vertices)
    wave = make("wave", types.FloatArray, "vertex")
    for time in TIMES:
        wave.Set(Vt.FloatArray.FromNumpy(np.full(vertices, time, np.float32)), time)
    material = UsdShade.Material.Define(stage, "/World/Looks/red")
    binding = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
    binding.Bind(material)
    for name, faces in (("front", range(counts // 2)), ("back", range(counts // 2, counts))):
        subset = binding.CreateMaterialBindSubset(name, list(faces))
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    binding.SetMaterialBindSubsetsFamilyType(UsdGeom.Tokens.partition)
    mesh.CreateNormalsAttr([(0, 0, 1)] * vertices)
    mesh.CreateVelocitiesAttr([(0, 0, 1)] * vertices)
    mesh.CreateAccelerationsAttr([(0, 0, 1)] * vertices)
    mesh.CreateCornerIndicesAttr([0])
    mesh.CreateCornerSharpnessesAttr([10.0])
    mesh.CreateCreaseIndicesAttr([0, 1])
    mesh.CreateCreaseLengthsAttr([2])
    mesh.CreateCreaseSharpnessesAttr([2.0])
    stage.Save()


def refine_all(shot: Shot) -> list[tuple[Refinement, ...]]:
    return [subdivide_times(garment.mesh, garment.level) for garment in shot.scene.garments]


def fine_points(shot: Shot, refinements: Sequence[Sequence[Refinement]], time: float | None) -> list[np.ndarray]:
    """Coarse points refined linearly, world metres."""
    garments = shot.frame(time).garments
    return [vertex_values(steps, garment.points) for steps, garment in zip(refinements, garments, strict=True)]


def result_of(time: float | None, points: Sequence[np.ndarray | None], **values: Any) -> Result:
    """A result of fine points, world metres, with further values alike for all garments."""
    return Result(time, tuple(GarmentResult(array, **values) for array in points))


def write_layer(path: Path, out: Path, *, level: int = 1, **options: object) -> Path:
    """Refine a shot linearly into a layer."""
    write_shot(open_shot(str(path), level=level), out, **options)  # type: ignore[arg-type]
    return out


def write_shot(shot: Shot, out: Path, *, times: Sequence[float | None] = (), **options: object) -> LayerWriter:
    """Refine an open shot linearly into a layer, at all its times or some."""
    refinements = refine_all(shot)
    with LayerWriter(shot, refinements, out, **options) as writer:  # type: ignore[arg-type]
        for time in times or shot.scene.times or (None,):
            writer.write(result_of(time, fine_points(shot, refinements, time)))
    return writer


def open_over(path: Path, out: Path) -> Usd.Stage:
    """The layer composed over its shot."""
    shot = Sdf.Layer.FindOrOpen(str(path))
    return Usd.Stage.Open(root_over(shot, [str(out), str(path)]))


def errors(out: Path, shot: Path | None = None) -> list[str]:
    return [str(problem) for problem in validate_layer(out, shot) if problem.severity == "error"]


def world_metres(stage: Usd.Stage, path: str, time: float | None) -> np.ndarray:
    code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    matrix = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(mesh.GetPrim()))
    points = np.asarray(mesh.GetPointsAttr().Get(code), np.float64)
    return (points @ matrix[:3, :3] + matrix[3, :3]) * UsdGeom.GetStageMetersPerUnit(stage)
