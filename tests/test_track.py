"""Points, vertex normals, extents and velocities over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from layers import (
    COAT,
    MIRROR,
    TIMES,
    errors,
    fine_points,
    make_shot,
    open_over,
    refine_all,
    vec3,
    world_metres,
    write_layer,
)
from pxr import Gf, UsdGeom

from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.write.normals import VertexNormals
from physgraph_usd.usd.write.writer import LayerWriter


@pytest.mark.parametrize(("orientation", "matrix"), [("rightHanded", MIRROR), ("leftHanded", Gf.Matrix4d(1.0))])
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


def test_no_area_takes_the_neighbours_and_stays_unit() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [9, 9, 9]], float)
    mesh = PolygonMesh(np.array([3, 3], np.int32), np.array([0, 1, 2, 0, 1, 3], np.int32), 5)
    normals = VertexNormals(mesh)(points)
    np.testing.assert_allclose(normals[:4], np.tile([0, 0, 1], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
