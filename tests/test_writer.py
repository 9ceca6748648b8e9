"""Written layers, opened over their shots."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from layers import COAT, TIMES, dress_up, fine_points, make_shot, open_over, refine_all, vec3, write_layer
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils

from physgraph_usd.errors import LayerError, UsageError
from physgraph_usd.usd.provenance import file_hashes, read_record, refined_layers, write_root
from physgraph_usd.usd.reader import open_shot
from physgraph_usd.usd.validate import validate_layer
from physgraph_usd.usd.writer import LayerWriter

ROOT = Path(__file__).resolve().parents[1]
MIRROR = Gf.Matrix4d().SetScale(Gf.Vec3d(-2, 1, 0.5)) * Gf.Matrix4d().SetTranslate(Gf.Vec3d(1e4, -3, 7))


def errors(out: Path, shot: Path | None = None) -> list[str]:
    return [str(problem) for problem in validate_layer(out, shot) if problem.severity == "error"]


def world_metres(stage: Usd.Stage, path: str, time: float | None) -> np.ndarray:
    code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    matrix = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(mesh.GetPrim()))
    points = np.asarray(mesh.GetPointsAttr().Get(code), np.float64)
    return (points @ matrix[:3, :3] + matrix[3, :3]) * UsdGeom.GetStageMetersPerUnit(stage)


@pytest.fixture
def dressed(tmp_path: Path) -> Path:
    path = tmp_path / "shot.usda"
    dress_up(make_shot(path, matrix=MIRROR))
    return path


@pytest.mark.parametrize("mode", ["over", "sibling"])
@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_points_come_back_in_world_metres(dressed: Path, tmp_path: Path, mode: str, suffix: str) -> None:
    before = dressed.read_bytes()
    out = write_layer(dressed, tmp_path / f"out{suffix}", mode=mode)
    assert errors(out) == []
    stage, path = open_over(dressed, out), COAT if mode == "over" else f"{COAT}_refined"
    shot = open_shot(str(dressed), level=1)
    for time in TIMES:
        expected = fine_points(shot, refine_all(shot), time)[0]
        np.testing.assert_allclose(world_metres(stage, path, time), expected, atol=1e-5)
    assert UsdGeom.Mesh(stage.GetPrimAtPath(path)).GetPointsAttr().GetTimeSamples() == list(TIMES)
    assert dressed.read_bytes() == before
    assert sorted(item.name for item in tmp_path.iterdir()) == sorted([out.name, "shot.usda"])


def test_all_that_depends_on_topology_is_there(dressed: Path, tmp_path: Path) -> None:
    out = write_layer(dressed, tmp_path / "out.usdc")
    stage = open_over(dressed, out)
    prim = stage.GetPrimAtPath(COAT)
    mesh, primvars = UsdGeom.Mesh(prim), UsdGeom.PrimvarsAPI(prim)
    faces, vertices = 48, len(mesh.GetPointsAttr().Get())
    assert len(mesh.GetFaceVertexCountsAttr().Get()) == faces
    assert vertices == 63
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert mesh.GetNormalsInterpolation() == "vertex"
    for name in ("cornerIndices", "cornerSharpnesses", "creaseIndices", "creaseLengths", "creaseSharpnesses"):
        assert len(prim.GetAttribute(name).Get()) == 0
    assert not mesh.GetVelocitiesAttr().HasAuthoredValue()
    assert not mesh.GetAccelerationsAttr().HasAuthoredValue()
    words = primvars.GetPrimvar("label").ComputeFlattened()
    assert list(words) == [f"f{face // 4}" for face in range(faces)]
    assert not primvars.GetPrimvar("tone").IsIndexed()
    assert len(primvars.GetPrimvar("pair").Get()) == 2 * vertices
    assert len(primvars.GetPrimvar("physgraph:pin").Get()) == vertices
    assert len(primvars.GetPrimvar("st").GetIndices()) == 4 * faces
    wave = primvars.GetPrimvar("wave")
    assert wave.GetTimeSamples() == list(TIMES)
    np.testing.assert_allclose(wave.Get(2.5), np.full(vertices, 2.5))
    assert list(primvars.GetPrimvar("tint").Get()) == [(0.5, 0.5, 0.5)]


@pytest.mark.parametrize("mode", ["over", "sibling"])
def test_bindings_and_partition_survive(dressed: Path, tmp_path: Path, mode: str) -> None:
    out = write_layer(dressed, tmp_path / "out.usdc", mode=mode)
    stage, path = open_over(dressed, out), COAT if mode == "over" else f"{COAT}_refined"
    prim = stage.GetPrimAtPath(path)
    api = UsdShade.MaterialBindingAPI
    assert api(prim).ComputeBoundMaterial()[0].GetPath() == "/World/Looks/red"
    subsets = api(prim).GetMaterialBindSubsets()
    assert [api(subset.GetPrim()).ComputeBoundMaterial()[0].GetPath() for subset in subsets] == ["/World/Looks/red"] * 2
    named = np.concatenate([np.asarray(subset.GetIndicesAttr().Get()) for subset in subsets])
    np.testing.assert_array_equal(np.sort(named), np.arange(48))


def test_a_sibling_renders_and_the_coarse_mesh_is_its_proxy(dressed: Path, tmp_path: Path) -> None:
    out = write_layer(dressed, tmp_path / "out.usdc", mode="sibling")
    stage = open_over(dressed, out)
    coarse, fine = (UsdGeom.Mesh(stage.GetPrimAtPath(path)) for path in (COAT, f"{COAT}_refined"))
    assert coarse.ComputePurpose() == "proxy"
    assert fine.ComputePurpose() == "render"
    assert len(coarse.GetPointsAttr().Get(1.0)) == 20
    assert len(fine.GetPointsAttr().Get(1.0)) == 63
    assert fine.ComputeProxyPrim()[0].GetPath() == COAT
    # Only the coarse mesh is a garment: the sibling must not be refined again.
    assert fine.GetPrim().GetPrimTypeInfo().GetAppliedAPISchemas().count("PhysGraphGarmentAPI") == 0
    assert coarse.GetPrim().GetPrimTypeInfo().GetAppliedAPISchemas().count("PhysGraphGarmentAPI") == 1


def test_a_material_bound_by_collection_reaches_the_sibling(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    stage = make_shot(path)
    material = UsdShade.Material.Define(stage, "/World/Looks/blue")
    world = stage.GetPrimAtPath("/World")
    collection = Usd.CollectionAPI.Apply(world, "cloth")
    collection.IncludePath(COAT)
    UsdShade.MaterialBindingAPI.Apply(world).Bind(collection, material, "cloth")
    stage.Save()
    out = write_layer(path, tmp_path / "out.usdc", mode="sibling")
    stage = open_over(path, out)
    fine = stage.GetPrimAtPath(f"{COAT}_refined")
    assert UsdShade.MaterialBindingAPI(fine).ComputeBoundMaterial()[0].GetPath() == "/World/Looks/blue"


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
@pytest.mark.parametrize("matrix", [Gf.Matrix4d(1.0), MIRROR])
def test_normals_point_to_the_authored_outside(tmp_path: Path, orientation: str, matrix: Gf.Matrix4d) -> None:
    path = tmp_path / "shot.usda"
    make_shot(path, orientation=orientation, matrix=matrix)
    out = write_layer(path, tmp_path / "out.usdc")
    stage = open_over(path, out)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    assert mesh.GetOrientationAttr().Get() == orientation
    assert np.asarray(mesh.GetNormalsAttr().Get(1.0))[:, 2].min() > 0.9
    assert errors(out) == []


def test_the_default_is_the_refined_default_pose(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    stage = make_shot(path)
    attribute = UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr()
    attribute.Set(vec3(np.asarray(attribute.Get()) * 0.5))
    stage.Save()
    out = write_layer(path, tmp_path / "out.usdc")
    stage = open_over(path, out)
    points = UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr()
    np.testing.assert_allclose(np.asarray(points.Get())[:, :2], np.asarray(points.Get(1.0))[:, :2] * 0.5, atol=1e-6)


def test_without_a_default_pose_the_first_frame_stands_in(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    make_shot(path, default=False)
    out = write_layer(path, tmp_path / "out.usdc")
    stage = open_over(path, out)
    points = UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr()
    np.testing.assert_array_equal(points.Get(), points.Get(1.0))
    assert errors(out) == []


def test_a_still_is_written_once(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    make_shot(path, times=())
    out = write_layer(path, tmp_path / "out.usdc")
    stage = open_over(path, out)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    assert mesh.GetPointsAttr().GetNumTimeSamples() == 0
    assert len(mesh.GetPointsAttr().Get()) == 63
    assert errors(out) == []


@pytest.mark.parametrize("changed", [None, (False,)])
def test_a_run_of_equal_frames_keeps_its_first_and_last(tmp_path: Path, changed: tuple[bool, ...] | None) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    make_shot(path, times=(1, 2, 3, 4, 5))
    shot = open_shot(str(path), level=1)
    steps = refine_all(shot)
    first, second = (fine_points(shot, steps, time) for time in (1.0, 5.0))
    with LayerWriter(shot, steps, out) as writer:
        writer.write(1.0, first)
        for time in (2.0, 3.0, 4.0):
            writer.write(time, first, changed=changed)
        writer.write(5.0, second)
    stage = open_over(path, out)
    points = UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr()
    assert points.GetTimeSamples() == [1.0, 4.0, 5.0]
    np.testing.assert_allclose(points.Get(3.0), points.Get(1.0), rtol=1e-6)
    assert errors(out) == []


def test_equal_world_points_under_a_moving_parent_are_not_held(tmp_path: Path) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    stage = make_shot(path)
    rig = UsdGeom.Xform(stage.GetPrimAtPath("/World/rig")).GetOrderedXformOps()[0]
    for index, time in enumerate(TIMES):
        rig.Set(Gf.Matrix4d().SetTranslate(Gf.Vec3d(index, 0, 0)), time)
    stage.Save()
    shot = open_shot(str(path), level=1)
    steps = refine_all(shot)
    points = fine_points(shot, steps, 1.0)
    with LayerWriter(shot, steps, out) as writer:
        for time in TIMES:
            writer.write(time, points, changed=(False,))
    for time in TIMES:
        np.testing.assert_allclose(world_metres(open_over(path, out), COAT, time), points[0], atol=1e-7)


def test_velocities_are_units_per_second(tmp_path: Path) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    make_shot(path, matrix=Gf.Matrix4d().SetScale(2.0))
    write_layer(path, out, velocities=True)
    stage = open_over(path, out)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    assert mesh.GetVelocitiesAttr().GetTimeSamples() == list(TIMES)
    # A quarter of a unit per 1.5 time codes at 30 a second.
    for time in TIMES:
        np.testing.assert_allclose(mesh.GetVelocitiesAttr().Get(time), np.tile([0, 0, 5.0], (63, 1)), atol=1e-4)
    assert errors(out) == []


def test_extents_hold_points_and_model_hints_hold_extents(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    stage = make_shot(path, matrix=Gf.Matrix4d().SetScale(3.0))
    for prim in ("/World", "/World/rig"):
        model = UsdGeom.ModelAPI.Apply(stage.GetPrimAtPath(prim))
        model.SetExtentsHint([(0, 0, 0), (0.1, 0.1, 0.1)])
    model.SetExtentsHint([(0, 0, 0), (0.1, 0.1, 0.1)], 1.0)
    stage.Save()
    out = write_layer(path, tmp_path / "out.usdc")
    fine = open_over(path, out)
    box = np.asarray(UsdGeom.Mesh(fine.GetPrimAtPath(COAT)).GetExtentAttr().Get(4.0))
    world = np.asarray(UsdGeom.ModelAPI(fine.GetPrimAtPath("/World")).GetExtentsHint())
    assert np.all(world[0] <= 3 * box[0])
    assert np.all(world[1] >= 3 * box[1] - 1e-5)
    rig = UsdGeom.ModelAPI(fine.GetPrimAtPath("/World/rig")).GetExtentsHintAttr()
    assert np.all(np.asarray(rig.Get(4.0))[1] >= box[1] - 1e-6)


@pytest.mark.parametrize("mode", ["over", "sibling"])
def test_a_garment_in_an_instance(tmp_path: Path, mode: str) -> None:
    dress_up(make_shot(tmp_path / "asset.usda"))
    path = tmp_path / "shot.usda"
    stage = Usd.Stage.CreateNew(str(path))
    stage.SetTimeCodesPerSecond(30.0)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    for name in ("one", "two"):
        prim = stage.DefinePrim(f"/Set/{name}")
        prim.GetReferences().AddReference("asset.usda")
        prim.SetInstanceable(True)
    stage.Save()
    shot = open_shot(str(path), level=1, garments=["/Set/one/rig/coat"])
    if not shot.sources[0].instance_roots:
        pytest.skip("the reader names no instance roots yet")
    steps = refine_all(shot)
    with LayerWriter(shot, steps, tmp_path / "out.usdc", mode=mode) as writer:
        for time in shot.scene.times:
            writer.write(time, fine_points(shot, steps, time))
    assert any("instanceable" in str(notice) for notice in writer.notices)
    composed = open_over(path, tmp_path / "out.usdc")
    name = "coat" if mode == "over" else "coat_refined"
    assert len(UsdGeom.Mesh(composed.GetPrimAtPath(f"/Set/one/rig/{name}")).GetPointsAttr().Get(1.0)) == 63
    assert composed.GetPrimAtPath("/Set/two").IsInstance()
    assert errors(tmp_path / "out.usdc") == []


def test_a_shot_with_a_layer_offset(tmp_path: Path) -> None:
    make_shot(tmp_path / "anim.usda")
    path = tmp_path / "shot.usda"
    root = Sdf.Layer.CreateNew(str(path))
    root.timeCodesPerSecond = 60.0
    root.subLayerPaths = ["./anim.usda"]
    root.subLayerOffsets[0] = Sdf.LayerOffset(100.0)
    root.pseudoRoot.SetInfo("metersPerUnit", 0.01)
    root.Save()
    out = write_layer(path, tmp_path / "out.usdc")
    stage = open_over(path, out)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    # 30 codes a second under 60, then 100 later.
    assert mesh.GetPointsAttr().GetTimeSamples() == [102.0, 105.0, 108.0]
    assert len(mesh.GetPointsAttr().Get(102.0)) == 63
    assert errors(out) == []


def test_a_usdz_shot_and_its_root(dressed: Path, tmp_path: Path) -> None:
    package = tmp_path / "shot.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(dressed), str(package))
    out = write_layer(package, tmp_path / "layers" / "out.usdc")
    root = write_root(tmp_path / "root.usda", layer=out, shot=package)
    stage = Usd.Stage.Open(str(root))
    assert len(UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr().Get(2.5)) == 63
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert list(stage.GetRootLayer().subLayerPaths) == ["./layers/out.usdc", "./shot.usdz"]
    assert errors(out) == []


def test_the_root_repeats_what_only_a_root_says(dressed: Path, tmp_path: Path) -> None:
    layer = Sdf.Layer.FindOrOpen(str(dressed))
    layer.expressionVariables = {"SHOW": "x"}
    layer.Save()
    out = write_layer(dressed, tmp_path / "out.usdc")
    stage = Usd.Stage.Open(str(write_root(tmp_path / "root.usda", layer=out, shot=dressed)))
    assert stage.GetTimeCodesPerSecond() == 30.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1.0, 4.0)
    assert dict(stage.GetRootLayer().expressionVariables) == {"SHOW": "x"}
    with pytest.raises(UsageError, match="exists"):
        write_root(tmp_path / "root.usda", layer=out, shot=dressed)


def test_the_record_says_where_it_comes_from(dressed: Path, tmp_path: Path) -> None:
    shot = open_shot(str(dressed), level=1)
    hashes = file_hashes(shot.stage, tmp_path)
    assert hashes == {"./shot.usda": hashlib.sha256(dressed.read_bytes()).hexdigest()}
    given = {"version": "1", "inputs": hashes, "numbers": (1, 2), "mixed": [1.5, 2], "none": None, "flag": True}
    steps = refine_all(shot)
    with LayerWriter(shot, steps, tmp_path / "out.usdc", provenance=given) as writer:
        writer.write(1.0, fine_points(shot, steps, 1.0))
    record = read_record(Sdf.Layer.FindOrOpen(str(tmp_path / "out.usdc")))
    assert record is not None
    assert record["shot"] == "./shot.usda"
    assert list(record["garments"]) == [COAT]
    assert dict(record["inputs"]) == hashes
    assert list(record["numbers"]) == [1, 2]
    assert "none" not in record
    stage = open_over(dressed, tmp_path / "out.usdc")
    found = refined_layers(stage)
    assert [Path(layer.realPath).name for layer in found] == ["out.usdc"]


def test_used_values_stay_on_the_prim(dressed: Path, tmp_path: Path) -> None:
    out = write_layer(dressed, tmp_path / "out.usdc")
    stage = open_over(dressed, out)
    prim = stage.GetPrimAtPath(COAT)
    frame = open_shot(str(dressed), level=1).frame(1.0).garments[0]
    assert prim.GetAttribute("physgraph:material:bendStiffness").Get() == pytest.approx(frame.fabric.bend)
    assert prim.GetAttribute("physgraph:refine:level").Get() == 1
    assert not prim.GetAttribute("physgraph:material:shearStiffness").HasAuthoredValue()


DIGEST = """
import hashlib, sys
sys.path.insert(0, "tests")
from pathlib import Path
from layers import write_layer
out = write_layer(Path(sys.argv[1]), Path(sys.argv[2]), overwrite=True, velocities=True)
sys.stdout.write(hashlib.sha256(out.read_bytes()).hexdigest())
"""


def test_the_same_calls_give_the_same_bytes(dressed: Path, tmp_path: Path) -> None:
    digests = set()
    for _ in range(3):
        command = [sys.executable, "-c", DIGEST, str(dressed), str(tmp_path / "out.usdc")]
        digests.add(subprocess.run(command, cwd=ROOT, capture_output=True, check=True, timeout=60).stdout)
    assert len(digests) == 1


def test_wrong_calls_leave_nothing(dressed: Path, tmp_path: Path) -> None:
    shot = open_shot(str(dressed), level=1)
    steps = refine_all(shot)
    points = fine_points(shot, steps, 1.0)
    broken = [points[0].copy()]
    broken[0][5] = np.nan
    cases = [
        (rf"<{COAT}> at time code 2\.5: point 5 is \[nan", [(1.0, points), (2.5, broken)]),
        (r"points have shape \(3, 3\); the fine mesh has 63", [(1.0, [np.zeros((3, 3))])]),
        (r"time code 1\.0 does not come after 1", [(1.0, points), (1.0, points)]),
        (r"0 arrays of points for 1 garments", [(1.0, [])]),
        (r"no time code was written", []),
    ]
    for message, calls in cases:
        with pytest.raises(LayerError, match=message):
            _write_calls(LayerWriter(shot, steps, tmp_path / "out.usdc"), calls)
        assert [item.name for item in tmp_path.iterdir()] == ["shot.usda"]
    with pytest.raises(UsageError, match="unknown mode 'under'; known modes: over, sibling"):
        LayerWriter(shot, steps, tmp_path / "out.usdc", mode="under")
    with pytest.raises(UsageError, match="part of the shot"):
        LayerWriter(shot, steps, dressed, overwrite=True)


def _write_calls(writer: LayerWriter, calls: list[tuple[float, list[np.ndarray]]]) -> None:
    with writer:
        for time, points in calls:
            writer.write(time, points)


def test_a_primvar_that_fits_no_mesh_is_hidden_and_named(dressed: Path, tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(dressed))
    UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(COAT)).GetPrimvar("heat").Set([1.0, 2.0])
    stage.Save()
    shot = open_shot(str(dressed), level=1)
    steps = refine_all(shot)
    with LayerWriter(shot, steps, tmp_path / "out.usdc") as writer:
        writer.write(1.0, fine_points(shot, steps, 1.0))
    assert any("primvars:heat has 2 elements; vertex needs 20" in str(notice) for notice in writer.notices)
    stage = open_over(dressed, tmp_path / "out.usdc")
    prim = stage.GetPrimAtPath(COAT)
    assert not UsdGeom.PrimvarsAPI(prim).GetPrimvar("heat").HasAuthoredValue()


PEAK = """
import resource, sys
sys.path.insert(0, "tests")
from pathlib import Path
from layers import fine_points, make_shot, refine_all
from pxr import Gf, UsdGeom
from physgraph_usd.usd.reader import open_shot
from physgraph_usd.usd.writer import LayerWriter
folder, frames = Path(sys.argv[1]), int(sys.argv[2])
stage = make_shot(folder / "shot.usda", size=(158, 158), times=(0.0,))
operation = UsdGeom.Xform(stage.GetPrimAtPath("/World/rig")).GetOrderedXformOps()[0]
for frame in range(frames):
    operation.Set(Gf.Matrix4d(1.0), float(frame))
stage.Save()
shot = open_shot(str(folder / "shot.usda"), level=1)
steps = refine_all(shot)
points = fine_points(shot, steps, 0.0)[0]
with LayerWriter(shot, steps, folder / "out.usdc", velocities=True, overwrite=True) as writer:
    for frame in range(frames):
        writer.write(float(frame), [points + 0.001 * frame])
assert len(points) > 100_000
sys.stdout.write(str(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_frames(tmp_path: Path) -> None:
    peaks = []
    for frames in (24, 120):
        folder = tmp_path / str(frames)
        folder.mkdir()
        command = [sys.executable, "-c", PEAK, str(folder), str(frames)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, check=True, timeout=120, text=True)
        peaks.append(int(done.stdout))
    assert peaks[1] < 1.1 * peaks[0], f"peak memory {peaks} KiB"


def make_skinned(path: Path, *, inherited: bool) -> None:
    """The coat on a skeleton of one joint that moves along X, bound on the mesh or on its parent."""
    stage = make_shot(path, times=())
    root = UsdSkel.Root.Define(stage, "/World")
    skeleton = UsdSkel.Skeleton.Define(stage, "/World/skeleton")
    skeleton.CreateJointsAttr(["joint"])
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1)])
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1)])
    animation = UsdSkel.Animation.Define(stage, "/World/animation")
    animation.CreateJointsAttr(["joint"])
    animation.CreateRotationsAttr([Gf.Quatf(1)])
    animation.CreateScalesAttr([Gf.Vec3h(1, 1, 1)])
    for time in TIMES:
        animation.CreateTranslationsAttr().Set([Gf.Vec3f(time, 0, 0)], time)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    mesh = stage.GetPrimAtPath(COAT)
    UsdSkel.BindingAPI.Apply(mesh)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetParent() if inherited else mesh)
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(inherited, 1).Set([0] if inherited else [0] * 20)
    binding.CreateJointWeightsPrimvar(inherited, 1).Set([1.0] if inherited else [1.0] * 20)
    stage.SetStartTimeCode(TIMES[0])
    stage.SetEndTimeCode(TIMES[-1])
    assert root
    stage.Save()


@pytest.mark.parametrize("mode", ["over", "sibling"])
@pytest.mark.parametrize("inherited", [False, True])
def test_a_skinned_garment_is_not_skinned_twice(tmp_path: Path, mode: str, inherited: bool) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    make_skinned(path, inherited=inherited)
    shot = open_shot(str(path), level=1)
    if not shot.sources[0].skinned:
        pytest.skip("the reader bakes no skinning yet")
    steps = refine_all(shot)
    with LayerWriter(shot, steps, out, mode=mode) as writer:
        for time in shot.scene.times:
            writer.write(time, fine_points(shot, steps, time))
    stage = open_over(path, out)
    root, cache = UsdSkel.Root(stage.GetPrimAtPath("/World")), UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    bindings = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    skinned = [str(query.GetPrim().GetPath()) for binding in bindings for query in binding.GetSkinningTargets()]
    assert [cloth for cloth in skinned if cache.GetSkinningQuery(stage.GetPrimAtPath(cloth)).HasJointInfluences()] == (
        [] if mode == "over" else [COAT]
    )
    if mode == "over":
        # A rigid bake moves the coarse mesh by its transform, which a sibling shares.
        stage.SetEditTarget(stage.GetSessionLayer())
        UsdSkel.BakeSkinning(root, Gf.Interval(*TIMES[::2]))
    for time in TIMES:
        found = world_metres(stage, str(writer.targets[0]), time)
        np.testing.assert_allclose(found, fine_points(shot, steps, time)[0], atol=1e-6)
        assert found[0, 0] == pytest.approx(0.01 * time)
    assert errors(out) == []
