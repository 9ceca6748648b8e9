"""Written layers, opened over their shots: points, normals, extents and velocities, primvars and subsets."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from layers import (
    COAT,
    MIRROR,
    TIMES,
    errors,
    fine_points,
    grid,
    make_shot,
    open_over,
    refine_all,
    result_of,
    vec3,
    world_metres,
    write_layer,
    write_shot,
)
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, UsdUtils, Vt

from physgraph_usd.solver.mesh.subdivide import subdivide_times
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.write.normals import VertexNormals
from physgraph_usd.usd.write.primvars import FineMap
from physgraph_usd.usd.write.writer import LayerWriter


@pytest.mark.parametrize(("mode", "suffix"), [("over", ".usdc"), ("sibling", ".usda")])
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
    assert mesh.GetSubdivisionSchemeAttr().Get() == "catmullClark"
    assert not mesh.GetNormalsAttr().HasAuthoredValue()
    assert {len(mesh.GetVelocitiesAttr().Get(time)) for time in TIMES} == {vertices}
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


def test_used_values_stay_on_the_prim(dressed: Path, tmp_path: Path) -> None:
    out = write_layer(dressed, tmp_path / "out.usdc")
    stage = open_over(dressed, out)
    prim = stage.GetPrimAtPath(COAT)
    frame = open_shot(str(dressed), level=1).frame(1.0).garments[0]
    assert prim.GetAttribute("physgraph:material:bendStiffness").Get() == pytest.approx(frame.fabric.bend)
    assert prim.GetAttribute("physgraph:refine:level").Get() == 1
    assert not prim.GetAttribute("physgraph:material:shearStiffness").HasAuthoredValue()


def test_a_primvar_that_fits_no_mesh_is_hidden_and_named(dressed: Path, tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(dressed))
    UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(COAT)).GetPrimvar("heat").Set([1.0, 2.0])
    stage.Save()
    writer = write_shot(open_shot(str(dressed), level=1), tmp_path / "out.usdc", times=(1.0,))
    assert any("primvars:heat has 2 elements; vertex needs 20" in str(notice) for notice in writer.notices)
    stage = open_over(dressed, tmp_path / "out.usdc")
    prim = stage.GetPrimAtPath(COAT)
    assert not UsdGeom.PrimvarsAPI(prim).GetPrimvar("heat").HasAuthoredValue()


def test_a_layer_that_is_open_elsewhere_is_seen_anew(tmp_path: Path) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    make_shot(path)
    write_layer(path, out, level=0)
    stage = open_over(path, out)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    assert len(mesh.GetPointsAttr().Get(1.0)) == 20
    write_layer(path, out, level=1, overwrite=True)
    assert len(mesh.GetPointsAttr().Get(1.0)) == 63


POINTS, COUNTS, INDICES = grid(3, 2)


def fine_map(levels: int = 2, *, dropped: int | None = None) -> FineMap:
    """A map of the grid, perhaps with one face left out as a hole."""
    kept = np.array([face for face in range(len(COUNTS)) if face != dropped])
    indices = INDICES.reshape(-1, 4)[kept].reshape(-1)
    cage = PolygonMesh(COUNTS[kept], indices, len(POINTS))
    return FineMap(cage, subdivide_times(cage, levels), COUNTS, kept, indices=INDICES)


@pytest.mark.parametrize(("dropped", "indexed"), [(None, True), (2, False)])
def test_texture_coordinates_follow_the_points(dropped: int | None, indexed: bool) -> None:
    fine = fine_map(dropped=dropped)
    coordinates = POINTS[:, :2]
    values, indices = (
        fine.primvar("faceVarying", coordinates, indices=INDICES)
        if indexed
        else fine.primvar("faceVarying", coordinates[INDICES])
    )
    assert values is not None
    flat = values if indices is None else values[indices]
    assert (indices is not None) == indexed
    np.testing.assert_allclose(flat, fine.interpolate(POINTS)[fine.fine.indices][:, :2], atol=1e-12)


@pytest.mark.parametrize(("orientation", "matrix"), [("rightHanded", MIRROR), ("leftHanded", Gf.Matrix4d(1.0))])
def test_normals_point_to_the_authored_outside(tmp_path: Path, orientation: str, matrix: Gf.Matrix4d) -> None:
    path = tmp_path / "shot.usda"
    make_shot(path, orientation=orientation, matrix=matrix)
    out = write_layer(path, tmp_path / "out.usdc", scheme="none")
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


@pytest.mark.parametrize("reused", [False, True])
def test_a_run_of_equal_frames_keeps_its_first_and_last(tmp_path: Path, reused: bool) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    make_shot(path, times=(1, 2, 3, 4, 5))
    shot = open_shot(str(path), level=1)
    steps = refine_all(shot)
    first, second = (fine_points(shot, steps, time) for time in (1.0, 5.0))
    with LayerWriter(shot, steps, out) as writer:
        writer.write(result_of(1.0, first))
        for time in (2.0, 3.0, 4.0):
            writer.write(result_of(time, first, reused=reused))
        writer.write(result_of(5.0, second))
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
            writer.write(result_of(time, points, reused=True))
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


def speeds(stage: Usd.Stage, times: Sequence[float]) -> list[float]:
    """Speed of the coat along Z at each time code [units/s]."""
    velocities = UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetVelocitiesAttr()
    return [float(np.asarray(velocities.Get(time))[0, 2]) for time in times]


def drawn_at(stage: Usd.Stage, time: float) -> np.ndarray:
    """Points of the coat half a time code later, by the velocities at a time code."""
    return np.array(UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).ComputePointsAtTime(time + 0.5, time))


@pytest.mark.parametrize("part", ["frames", "times"])
def test_cloth_that_is_held_outside_the_frames_has_no_velocity(tmp_path: Path, part: str) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    make_shot(path, times=range(1, 11))
    shot = open_shot(str(path), level=1, frames=(4.0, 6.0) if part == "frames" else None)
    times = (4.0, 5.0, 6.0)
    refinements = refine_all(shot)
    with LayerWriter(shot, refinements, out, velocities=True, times=times if part == "times" else None) as writer:
        for time in times:
            writer.write(result_of(time, fine_points(shot, refinements, time)))
    stage = open_over(path, out)
    assert speeds(stage, range(1, 11)) == pytest.approx([0.0] * 3 + [7.5] * 3 + [0.0] * 4)
    points = UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr()
    for time in (1.0, 2.5, 3.0, 7.0, 8.5, 10.0):
        np.testing.assert_allclose(drawn_at(stage, time), points.Get(4.0 if time < 4.0 else 6.0), atol=1e-6)
    np.testing.assert_allclose(drawn_at(stage, 5.0), np.add(points.Get(5.0), (0.0, 0.0, 0.125)), atol=1e-6)
    assert errors(out) == []


def test_velocities_where_motion_begins_and_ends_are_those_of_the_motion(tmp_path: Path) -> None:
    path, out = tmp_path / "shot.usda", tmp_path / "out.usdc"
    stage = make_shot(path, times=range(1, 9))
    attribute = UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr()
    for held, moved in ((2.0, 1.0), (3.0, 1.0), (7.0, 6.0), (8.0, 6.0)):
        attribute.Set(attribute.Get(moved), held)
    stage.Save()
    write_layer(path, out, velocities=True)
    found = speeds(open_over(path, out), range(1, 9))
    assert found == pytest.approx([0.0, 0.0, 22.5, 15.0, 7.5, 7.5, 0.0, 0.0])


def test_layers_of_ranges_name_their_frames_and_join_as_value_clips(tmp_path: Path) -> None:
    path, ranges = tmp_path / "shot.usda", ((1.0, 3.0), (4.0, 6.0))
    make_shot(path, times=range(1, 7)).SetEndTimeCode(20.0)
    layers = []
    for first, last in ranges:
        out = tmp_path / f"{first:g}.usdc"
        write_shot(open_shot(str(path), level=1, frames=(first, last)), out, velocities=True)
        layers.append(Sdf.Layer.FindOrOpen(str(out)))
        assert (layers[-1].startTimeCode, layers[-1].endTimeCode) == (first, last)
        assert errors(out) == []
    joined = Sdf.Layer.CreateNew(str(tmp_path / "joined.usda"))
    assert UsdUtils.StitchClips(joined, [layer.identifier for layer in layers], COAT)
    joined.timeCodesPerSecond = layers[0].timeCodesPerSecond
    stage = Usd.Stage.Open(joined)
    for layer, time in ((layers[0], 3.0), (layers[1], 4.0), (layers[1], 6.0)):
        found = UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr().Get(time)
        assert found == layer.QueryTimeSample(f"{COAT}.points", time)


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


@pytest.mark.parametrize("part", [False, True])
def test_extents_of_skel_roots_above_hold_the_cloth_at_every_time(tmp_path: Path, part: bool) -> None:
    """The root's extent is the coarse cloth's, with more samples than the cloth, outside a range of frames too."""
    path = tmp_path / "shot.usda"
    stage = make_shot(path, times=(1.0, 3.0, 5.0))
    root = UsdSkel.Root.Define(stage, "/World/rig")
    for time in (1.0, 2.0, 3.0, 4.0, 5.0):
        root.CreateExtentAttr().Set([(0, 0, 0), (1, time, 0.1)], time)
    stage.Save()
    shot = open_shot(str(path), level=1, frames=(3.0, 5.0) if part else None)
    write_shot(shot, tmp_path / "out.usdc")
    fine = open_over(path, tmp_path / "out.usdc")
    assert fine.GetPrimAtPath("/World/rig").GetAttribute("extent").GetTimeSamples() == [1.0, 2.0, 3.0, 4.0, 5.0]
    for time in (1.0, 1.5, 2.0, 3.0, 4.0, 5.0):
        box = UsdGeom.BBoxCache(time, ["default"]).ComputeWorldBound(fine.GetPrimAtPath("/World/rig")).GetRange()
        points = np.array(UsdGeom.Mesh(fine.GetPrimAtPath(COAT)).GetPointsAttr().Get(time))
        held = np.concatenate([points, [[0.0, time, 0.0]]])
        assert np.all(np.array(box.GetMin()) <= held.min(axis=0) + 1e-6)
        assert np.all(np.array(box.GetMax()) >= held.max(axis=0) - 1e-6)


def test_the_extent_of_an_instancer_holds_the_cloth_at_its_instances(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    stage = make_shot(path)
    crowd = UsdGeom.PointInstancer.Define(stage, "/World")
    crowd.CreatePrototypesRel().SetTargets(["/World/rig"])
    crowd.CreateProtoIndicesAttr([0, 0])
    crowd.CreatePositionsAttr([(0, 0, 0), (50, 0, 0)])
    crowd.CreateExtentAttr([(0, 0, 0), (1, 1, 0)])
    stage.Save()
    fine = open_over(path, write_layer(path, tmp_path / "out.usdc"))
    low, high = np.array(UsdGeom.PointInstancer(fine.GetPrimAtPath("/World")).GetExtentAttr().Get())
    boxes = [np.array(UsdGeom.Mesh(fine.GetPrimAtPath(COAT)).GetExtentAttr().Get(time)) for time in TIMES]
    np.testing.assert_allclose(low, np.minimum(0.0, np.min(boxes, axis=0)[0]), atol=1e-5)
    np.testing.assert_allclose(high, np.max(boxes, axis=0)[1] + [50.0, 0.0, 0.0], atol=1e-5)


def test_a_primvar_with_unsigned_indices_follows(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    stage = make_shot(path)
    prim = stage.GetPrimAtPath(COAT)
    for interpolation, count in (("vertex", 20), ("uniform", 12), ("faceVarying", 48)):
        made = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(interpolation, Sdf.ValueTypeNames.FloatArray, interpolation)
        made.Set([1.0, 3.0])
        indices = prim.CreateAttribute(f"primvars:{interpolation}:indices", Sdf.ValueTypeNames.UIntArray)
        indices.Set(Vt.UIntArray.FromNumpy(np.arange(count, dtype=np.uint32) % 2))
    stage.Save()
    out = write_layer(path, tmp_path / "out.usdc")
    stage = open_over(path, out)
    api = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(COAT))
    names = ("vertex", "uniform", "faceVarying")
    vertex, uniform, corners = (api.GetPrimvar(name).ComputeFlattened() for name in names)
    assert (len(vertex), len(corners)) == (63, 192)
    assert list(uniform) == ([1.0] * 4 + [3.0] * 4) * 6
    assert errors(out) == []


def test_a_primvar_that_no_integers_index_is_hidden_and_named(tmp_path: Path) -> None:
    path = tmp_path / "shot.usda"
    stage = make_shot(path)
    prim = stage.GetPrimAtPath(COAT)
    UsdGeom.PrimvarsAPI(prim).CreatePrimvar("odd", Sdf.ValueTypeNames.FloatArray, "vertex").Set([1.0, 3.0])
    prim.CreateAttribute("primvars:odd:indices", Sdf.ValueTypeNames.FloatArray).Set([0.0] * 20)
    stage.Save()
    writer = write_shot(open_shot(str(path), level=1), tmp_path / "out.usdc")
    assert any("primvars:odd is indexed by no array of integers; hidden" in str(notice) for notice in writer.notices)
    stage = open_over(path, tmp_path / "out.usdc")
    assert not UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(COAT)).GetPrimvar("odd").HasAuthoredValue()


def test_no_area_takes_the_neighbours_and_stays_unit() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [9, 9, 9]], float)
    mesh = PolygonMesh(np.array([3, 3], np.int32), np.array([0, 1, 2, 0, 1, 3], np.int32), 5)
    normals = VertexNormals(mesh)(points)
    np.testing.assert_allclose(normals[:4], np.tile([0, 0, 1], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("level", [0, 1])
def test_corners_given_twice_leave_no_faces_without_area(tmp_path: Path, level: int) -> None:
    """Triangles given as quads: the layer is that of the triangles, values at corners too."""
    stages = []
    for name, last in (("twice", [0, 1, 6, 6, 0, 6, 5, 5]), ("clean", [0, 1, 6, 0, 6, 5])):
        path = tmp_path / f"{name}.usda"
        stage = make_shot(path)
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
        corners = 4 if name == "twice" else 3
        indices = [*last, *mesh.GetFaceVertexIndicesAttr().Get()[4:]]
        mesh.GetFaceVertexCountsAttr().Set([corners, corners, *[4] * 11])
        mesh.GetFaceVertexIndicesAttr().Set(indices)
        uv = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
        uv.Set([(float(p[0]), float(p[1])) for p in np.asarray(mesh.GetPointsAttr().Get())[indices]])
        stage.Save()
        stages.append(open_over(path, write_layer(path, tmp_path / f"{name}.usdc", level=level)))
        assert errors(tmp_path / f"{name}.usdc") == []
    for name in ("points", "faceVertexCounts", "faceVertexIndices", "primvars:st"):
        found, expected = (np.asarray(each.GetPrimAtPath(COAT).GetAttribute(name).Get(1.0)) for each in stages)
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("value", [8e5, float("nan")])
def test_a_point_in_no_face_does_not_count(tmp_path: Path, value: float) -> None:
    path = tmp_path / "shot.usda"
    stage = make_shot(path)
    attribute = UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr()
    plain = open_shot(str(path), level=1)
    for code in (Usd.TimeCode.Default(), *map(Usd.TimeCode, TIMES)):
        attribute.Set(vec3(np.concatenate([attribute.Get(code), [[value] * 3] * 2])), code)
    stage.Save()
    shot = open_shot(str(path), level=1)
    assert [*map(str, shot.warnings)] == [*map(str, plain.warnings)]
    writer = write_shot(shot, tmp_path / "out.usdc")
    assert shot.warnings == plain.warnings
    over = open_over(path, tmp_path / "out.usdc")
    fine = UsdGeom.Mesh(over.GetPrimAtPath(str(writer.targets[0])))
    assert np.abs(fine.GetExtentAttr().Get(1.0)).max() < 10.0
    assert errors(tmp_path / "out.usdc") == []
