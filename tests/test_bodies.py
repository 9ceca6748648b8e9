"""Colliders read from stages: every kind of prim, unit, transform and animation, and which garment feels which."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
from bodies import box
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, Vt
from stages import (
    COLLIDER_API,
    add_mesh,
    add_sheet,
    add_skeleton,
    author,
    bind_skin,
    new_stage,
    save,
    set_matrix,
    skinned_points,
    vec3,
)

from physgraph_usd.solver.colliders.pose import Pose
from physgraph_usd.solver.scene import Frame, Scene
from physgraph_usd.usd.read.reader import open_shot

BODY = "/World/body"


def add_box(stage: Usd.Stage, path: str = BODY, *, times: tuple[float, ...] = ()) -> UsdGeom.Mesh:
    """A box of triangles tagged as a collider; it moves along x by its time."""
    points, triangles = box((1.0, 2.0, 3.0))
    mesh = add_mesh(stage, path, points, triangles, schema=COLLIDER_API, scheme="none")
    for time in times:
        mesh.GetPointsAttr().Set(vec3(points + np.array([time, 0.0, 0.0])), time)
    return mesh


def read(shot: str, time: float | None = 1.0, **options: object) -> tuple[Scene, Frame, list[str]]:
    with contextlib.closing(open_shot(shot, **options)) as opened:  # type: ignore[arg-type]
        frame = opened.frame(time)
        return opened.scene, frame, [str(notice) for notice in opened.warnings]


def mesh_of(frame: Frame, index: int = 0) -> Pose:
    pose = frame.colliders[index]
    assert pose is not None
    return pose


def shot_with(path: Path, *, metres: float = 0.01) -> Usd.Stage:
    stage = new_stage(path, metres=metres)
    add_sheet(stage)
    return stage


class TestMeshes:
    def test_points_are_world_metres(self, tmp_path: Path):
        stage = shot_with(tmp_path / "a.usda")
        set_matrix(add_box(stage).GetPrim(), np.diag([2.0, 2.0, 2.0, 1.0]))
        scene, frame, _ = read(save(stage))
        assert (scene.colliders[0].path, scene.colliders[0].kind, scene.garments[0].colliders) == (BODY, "mesh", (0,))
        np.testing.assert_allclose(np.ptp(mesh_of(frame).points, axis=0), [0.02, 0.04, 0.06])

    @pytest.mark.parametrize("frames", [None, (3.0, 5.0)])
    def test_skinned_bodies_turn_between_the_skeletons_samples(self, tmp_path: Path, frames: tuple | None):
        """The skeleton has samples at 1 and 21, 115 degrees apart; the cloth has whole time codes between them."""
        stage = new_stage(tmp_path / "a.usda", metres=1.0)
        add_sheet(stage, times=(3.0, 4.0, 5.0, 12.5))
        add_skeleton(stage, "/World/root", (1.0, 21.0))
        mesh = add_box(stage, "/World/root/body")
        bind_skin(mesh, "/World/root", joints=[1] * 8)
        shot = save(stage)
        for time in (3.0, 5.0) if frames else (3.0, 12.5):
            expected = skinned_points(box((1.0, 2.0, 3.0))[0], [1] * 8, time)
            np.testing.assert_allclose(mesh_of(read(shot, time, frames=frames)[1]).points, expected, atol=1e-5)

    def test_quads_are_cut_as_renderers_cut_them(self, tmp_path: Path):
        """A coat (shot 21) held off a body cut along shorter diagonals crossed the drawn body 309 times; so, never."""
        stage = shot_with(tmp_path / "a.usda")
        points = [[0, 0, 0], [1, 0, 0.2], [3, 3, 0], [0, 1, 0.2]]
        add_mesh(stage, BODY, points, [[0, 1, 2, 3]], schema=COLLIDER_API, scheme="none")
        assert mesh_of(read(save(stage))[1]).triangles.tolist() == [[0, 1, 2], [0, 2, 3]]

    def test_samples_between_the_cloths_are_met_at_the_cloths_times(self, tmp_path: Path):
        """Points at 1.25 and 2.75, a turning parent at 0.5 and 2.5: at the cloth's time both are in between."""
        stage = shot_with(tmp_path / "a.usda", metres=1.0)
        turning = UsdGeom.Xform.Define(stage, "/World/rig").AddRotateZOp()
        for time, degrees in ((0.5, 0.0), (2.5, 80.0)):
            turning.Set(degrees, time)
        add_box(stage, "/World/rig/body", times=(1.25, 2.75))
        angle = np.radians(80.0 * (2.0 - 0.5) / 2.0)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        expected = box((1.0, 2.0, 3.0))[0] + np.array([2.0, 0.0, 0.0])
        expected[:, :2] = expected[:, :2] @ turn.T
        np.testing.assert_allclose(mesh_of(read(save(stage), 2.0)[1]).points, expected, atol=1e-5)

    def test_a_body_in_an_offset_layer_is_posed_in_the_shots_time(self, tmp_path: Path):
        asset = new_stage(tmp_path / "body.usda", metres=1.0)
        add_box(asset, "/World/body", times=(101.0, 105.0))
        asset.Save()
        stage = shot_with(tmp_path / "a.usda", metres=1.0)
        prim = stage.DefinePrim("/World/copy")
        prim.GetReferences().AddReference("body.usda", "/World/body", Sdf.LayerOffset(-50.0, 0.5))
        mean = mesh_of(read(save(stage), 2.0)[1]).points[:, 0].mean()
        assert mean == pytest.approx(104.0)

    def test_between_two_topologies_the_earlier_one_holds(self, tmp_path: Path):
        stage = new_stage(tmp_path / "a.usda", metres=1.0)
        add_sheet(stage, times=(1.0, 1.9, 2.0))
        mesh = add_box(stage)
        points, triangles = box()
        for time, count, more in ((1.0, 12, 0), (2.0, 6, 3)):
            mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.full(count, 3, np.int32)), time)
            mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(triangles[:count].ravel()), time)
            mesh.GetPointsAttr().Set(vec3(np.concatenate([time * points, np.zeros((more, 3))])), time)
        shot = save(stage)
        pose = mesh_of(read(shot, 1.9)[1])
        assert (len(pose.triangles), len(pose.points)) == (12, 8)
        np.testing.assert_allclose(pose.points, points, atol=1e-6)


def define(stage: Usd.Stage, kind: str, **values: object) -> Usd.Prim:
    """A primitive with the collision schema of UsdPhysics."""
    prim = stage.DefinePrim(BODY, kind)
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)
    UsdPhysics.CollisionAPI.Apply(prim)
    return prim


class TestShapes:
    @pytest.mark.parametrize(
        ("kind", "values", "size"),
        [
            ("Sphere", {"radius": 2.0}, (2, 2, 2)),
            ("Capsule", {"radius": 2.0, "height": 6.0, "axis": "X"}, (5, 2, 2)),
            ("Cylinder", {"radius": 2.0, "height": 6.0, "axis": "Y"}, (2, 3, 2)),
            ("Cube", {"size": 4.0}, (2, 2, 2)),
            ("Plane", {"axis": "Y"}, None),
        ],
    )
    def test_each_has_its_size_in_metres(self, tmp_path: Path, kind: str, values: dict, size: tuple | None):
        stage = shot_with(tmp_path / "a.usda")
        set_matrix(define(stage, kind, **values), np.diag([0.5, 0.5, 0.5, 1.0]))
        pose = mesh_of(read(save(stage))[1])
        if size is None:
            a, b, c = pose.corners()[pose.triangles[0]]
            np.testing.assert_allclose(np.cross(b - a, c - a) / 4.0, [0.0, 1.0, 0.0], atol=1e-9)
            np.testing.assert_allclose(pose.points[:, 1], 0.0, atol=1e-9)
        else:
            half = 0.5 * 0.01 * np.array(size, float)
            np.testing.assert_allclose([pose.points.min(axis=0), pose.points.max(axis=0)], [-half, half], rtol=1e-6)


class TestWhoFeelsWhat:
    def test_a_relationship_leaves_the_others_out(self, tmp_path: Path):
        stage = shot_with(tmp_path / "a.usda")
        add_sheet(stage, "/World/other")
        for name in ("a", "b"):
            add_box(stage, f"/World/{name}")
        garment = stage.GetPrimAtPath("/World/other")
        garment.CreateRelationship("physgraph:colliders").SetTargets(["/World/b"])
        scene, _, _ = read(save(stage))
        assert [collider.path for collider in scene.colliders] == ["/World/a", "/World/b"]
        assert [garment.colliders for garment in scene.garments] == [(0, 1), (1,)]

    def test_offsets_are_read(self, tmp_path: Path):
        stage = shot_with(tmp_path / "a.usda")
        author(add_box(stage).GetPrim(), "physgraph:collider:offset", 0.003)
        author(stage.GetPrimAtPath("/World/cloth"), "physgraph:contact:offset", 0.001)
        scene, frame, _ = read(save(stage))
        assert scene.colliders[0].offset == pytest.approx(0.003)
        assert frame.garments[0].offset == pytest.approx(0.001)
        assert read(str(tmp_path / "a.usda"), overrides=("contact:offset=0.005",))[1].garments[0].offset == 0.005
