"""UsdSkel skinning, baked without touching the stage: against closed forms and USD's own baselines."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from stages import (
    COLLIDER_API,
    add_sheet,
    add_skeleton,
    affine,
    bind_skin,
    new_stage,
    said,
    save,
    set_matrix,
    set_spline,
    sheet_points,
    skinned_points,
)

from physgraph_usd.usd.read.meshes import DrawnStage
from physgraph_usd.usd.read.reader import Shot, open_shot

ROOT = "/World/rig"
JOINTS = [int(x > 2) for x in sheet_points()[:, 0]]


def skinned_stage(path: Path, times: tuple[float, ...] = (1.0, 2.0, 3.0), **options) -> Usd.Stage:
    stage = new_stage(path, metres=0.01, rate=options.pop("rate", 24.0))
    offsets = options.pop("blend", None)
    add_skeleton(stage, ROOT, times, blend=offsets is not None)
    bind_skin(add_sheet(stage, f"{ROOT}/cloth", times=()), ROOT, joints=JOINTS, blend=offsets)
    return stage


def points(shot: Shot, time: float, index: int = 0) -> np.ndarray:
    return shot.frame(time).garments[index].points


@pytest.mark.parametrize("rate", [24.0, 30.0, 12.0])
def test_skinned_points_are_the_closed_form_at_own_times_and_whole_frames(tmp_path: Path, rate: float) -> None:
    shot = open_shot(save(skinned_stage(tmp_path / "s.usda", (1.0, 2.5, 7.0), rate=rate)))
    assert shot.sources[0].skinned
    assert shot.scene.times == (1.0, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0)
    for time in shot.scene.times:
        np.testing.assert_allclose(points(shot, time), 0.01 * skinned_points(sheet_points(), JOINTS, time), atol=1e-7)
    np.testing.assert_allclose(shot.scene.garments[0].rest, 0.01 * sheet_points(), atol=1e-9)


def test_blend_shapes_come_with_it(tmp_path: Path) -> None:
    offsets = np.zeros_like(sheet_points())
    offsets[3] = [0.0, 0.5, 0.25]
    shot = open_shot(save(skinned_stage(tmp_path / "s.usda", blend=offsets)))
    for time in shot.scene.times:
        expected = skinned_points(sheet_points() + time * offsets, JOINTS, time)
        np.testing.assert_allclose(points(shot, time), 0.01 * expected, atol=1e-6)


def test_transforms_between_animation_samples_are_skinned_exactly_there(tmp_path: Path) -> None:
    stage = skinned_stage(tmp_path / "s.usda", (1.0, 9.0))
    for time in (1.0, 3.5, 6.0):
        set_matrix(stage.GetPrimAtPath("/World"), affine(np.eye(3), (time, 0, 0)), time)
    shot = open_shot(save(stage))
    assert shot.scene.times == (1.0, 2.0, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    for time in (3.5, 6.0):
        expected = skinned_points(sheet_points(), JOINTS, time) + np.array([time, 0, 0])
        np.testing.assert_allclose(points(shot, time), 0.01 * expected, atol=1e-6)


def test_a_rigid_mesh_keeps_its_own_transform_and_moves_by_its_points(tmp_path: Path) -> None:
    stage = skinned_stage(tmp_path / "s.usda")
    mesh = UsdGeom.Mesh.Get(stage, f"{ROOT}/cloth")
    set_matrix(mesh.GetPrim(), affine(np.eye(3), (0, 0, 4)))
    binding = UsdSkel.BindingAPI(mesh)
    binding.CreateJointIndicesPrimvar(True, 1).Set([1])
    binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    shot = open_shot(save(stage))
    np.testing.assert_allclose(shot.to_metres(0, 2.0)[:3, 3], [0, 0, 0.04])
    frames = [points(shot, time) for time in (1.0, 3.0)]
    for time, found in zip((1.0, 3.0), frames, strict=True):
        turned = skinned_points(sheet_points(), [1] * 20, time)
        offset = found - 0.01 * turned
        np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1e-7)


@pytest.mark.parametrize("name", ["lbs", "dqs", "blendshapes", "blendshapesWithNormals"])
def test_skinning_equals_usd_s_own_baselines(real_data: Path, name: str) -> None:
    folder = real_data / "stages" / "usdskel"
    baseline = Usd.Stage.Open(str(folder / "baseline" / f"{name}.baked.usda"))
    with contextlib.closing(open_shot(str(folder / f"{name}.usda"), garments=["*"])) as shot:
        compared = 0
        for index, source in enumerate(shot.sources):
            mesh = UsdGeom.Mesh.Get(baseline, source.path)
            for time in source.times:
                expected = np.asarray(mesh.GetPointsAttr().Get(time), float)
                matrix = shot.to_metres(index, time)
                found = source.weld.split(points(shot, time, index))
                np.testing.assert_allclose(found, expected @ matrix[:3, :3].T + matrix[:3, 3], atol=2e-7)
                compared += 1
        assert compared >= 9


MASTER, CARRIER = f"{ROOT}/master", f"{ROOT}/carrier"
SKELETON, CLOTH, BODY = f"{MASTER}/skel", f"{CARRIER}/cloth", f"{ROOT}/body"
UNMOVED = [0] * len(JOINTS)


def still_pose(path: Path) -> Usd.Stage:
    """A skinned sheet and body with a pose of one sample; transforms above skeleton and sheet can move."""
    stage = new_stage(path, metres=1.0)
    add_skeleton(stage, MASTER, ())
    UsdSkel.Root.Define(stage, ROOT)
    UsdGeom.Xform.Define(stage, MASTER)
    UsdGeom.Xform.Define(stage, CARRIER)
    UsdSkel.Animation.Get(stage, f"{SKELETON}/anim").CreateRotationsAttr(Vt.QuatfArray([Gf.Quatf(1.0)] * 2))
    bind_skin(add_sheet(stage, CLOTH, times=()), MASTER, joints=JOINTS)
    body = add_sheet(stage, BODY, times=(), tagged=False)
    body.GetPrim().AddAppliedSchema(COLLIDER_API)
    bind_skin(body, MASTER, joints=JOINTS)
    return stage


def slide(stage: Usd.Stage, path: str) -> None:
    """Move a prim by a tenth of a unit along x in each frame from 1 to 9."""
    for time in (1.0, 9.0):
        set_matrix(stage.GetPrimAtPath(path), affine(np.eye(3), (0.1 * time, 0, 0)), time)


def turn_on_spline(stage: Usd.Stage, path: str) -> None:
    """Turn a prim about z by a tenth of a degree in each frame from 1 to 9."""
    turn = UsdGeom.Xformable(stage.GetPrimAtPath(path)).AddRotateZOp(UsdGeom.XformOp.PrecisionDouble)
    set_spline(turn.GetAttr(), {1.0: 0.1, 9.0: 0.9})


@pytest.mark.parametrize("moved", ["/World", ROOT, MASTER, SKELETON])
@pytest.mark.parametrize("moves", [slide, turn_on_spline])
def test_a_still_pose_moves_with_every_transform_above_its_skeleton(tmp_path: Path, moved: str, moves) -> None:
    stage = still_pose(tmp_path / "s.usda")
    moves(stage, moved)
    shot = open_shot(save(stage))
    assert {1.0, 9.0} <= {*shot.scene.times}
    for time in (1.0, 9.0):
        x, y, z = sheet_points().T.astype(np.float64)
        angle = np.radians(0.1 * time)
        turned = [np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z]
        expected = np.stack([x + 0.1 * time, y, z] if moves is slide else turned, axis=1)
        np.testing.assert_allclose(points(shot, time), expected, atol=1e-6)
        pose = shot.frame(time).colliders[0]
        assert pose is not None
        np.testing.assert_allclose(pose.points.mean(axis=0)[:2], expected.mean(axis=0)[:2], atol=1e-5)


def test_a_transform_above_a_skinned_mesh_does_not_move_it(tmp_path: Path) -> None:
    stage = still_pose(tmp_path / "s.usda")
    slide(stage, CARRIER)
    shot = open_shot(save(stage))
    for time in (1.0, 9.0):
        np.testing.assert_allclose(points(shot, time), sheet_points(), atol=1e-6)


def test_a_skeleton_that_turns_is_solved_at_whole_frames_without_start_and_end(tmp_path: Path) -> None:
    stage = still_pose(tmp_path / "s.usda")
    turn = UsdGeom.Xformable(stage.GetPrimAtPath(SKELETON)).AddRotateZOp()
    for time, angle in ((1.0, 0.0), (9.0, 180.0)):
        turn.Set(angle, time)
    shot = open_shot(save(stage))
    assert shot.scene.times == tuple(map(float, range(1, 10)))
    x, y, z = sheet_points().T
    np.testing.assert_allclose(points(shot, 5.0), np.stack([-y, x, z], axis=1), atol=1e-6)


def test_an_animation_with_sparse_keys_in_an_instance_is_skinned_at_whole_frames(tmp_path: Path) -> None:
    stage = still_pose(tmp_path / "s.usda")
    clip = UsdSkel.Animation.Define(stage, "/Motion/clip")
    clip.CreateJointsAttr(["hip", "hip/knee"])
    clip.CreateTranslationsAttr(Vt.Vec3fArray([(0, 0, 0), (2, 0, 0)]))
    clip.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1, 1, 1)] * 2))
    for time in (1.0, 9.0):
        knee = Gf.Quatf(float(np.cos(0.05 * time)), 0.0, 0.0, float(np.sin(0.05 * time)))
        clip.CreateRotationsAttr().Set(Vt.QuatfArray([Gf.Quatf(1.0), knee]), time)
    pose = stage.DefinePrim(f"{ROOT}/pose")
    pose.GetReferences().AddInternalReference("/Motion")
    pose.SetInstanceable(True)
    UsdSkel.BindingAPI(stage.GetPrimAtPath(SKELETON)).GetAnimationSourceRel().SetTargets([f"{ROOT}/pose/clip"])
    shot = open_shot(save(stage))
    assert shot.scene.times == tuple(map(float, range(1, 10)))
    np.testing.assert_allclose(points(shot, 4.0), skinned_points(sheet_points(), JOINTS, 4.0), atol=1e-6)
    assert not any("Prototype" in each for each in (said(shot), *shot.selections))


def test_a_picture_shows_the_pose_that_is_refined(tmp_path: Path) -> None:
    stage = still_pose(tmp_path / "s.usda")
    slide(stage, MASTER)
    drawn = DrawnStage(Path(save(stage)))
    drawn.bake((9.0,))
    shown = {mesh.path: mesh.points for mesh in drawn.meshes(9.0)}
    for path in (CLOTH, BODY):
        np.testing.assert_allclose(shown[path].mean(axis=0)[0], sheet_points().mean(axis=0)[0] + 0.9, atol=1e-5)


def _misfit(stage: Usd.Stage, path: str) -> None:
    binding = UsdSkel.BindingAPI(stage.GetPrimAtPath(path))
    binding.GetJointIndicesPrimvar().GetAttr().Set(Vt.IntArray([0, 1] * len(JOINTS)))
    binding.GetJointWeightsPrimvar().GetAttr().Set(Vt.FloatArray([0.0, 1.0] * len(JOINTS)))


def _short_animation(stage: Usd.Stage, path: str) -> None:
    UsdSkel.Animation.Get(stage, f"{SKELETON}/anim").GetRotationsAttr().Set(Vt.QuatfArray([Gf.Quatf(1.0)]))


def _without_api(stage: Usd.Stage, path: str) -> None:
    stage.GetPrimAtPath(path).RemoveAPI("SkelBindingAPI")


def _without_api_on_skeleton(stage: Usd.Stage, path: str) -> None:
    _without_api(stage, SKELETON)


def _no_bind_pose(stage: Usd.Stage, path: str) -> None:
    UsdSkel.Skeleton.Get(stage, SKELETON).GetBindTransformsAttr().Clear()


def _unknown_skeleton(stage: Usd.Stage, path: str) -> None:
    UsdSkel.BindingAPI(stage.GetPrimAtPath(path)).GetSkeletonRel().SetTargets([Sdf.Path("/World/none")])


@pytest.mark.parametrize(
    ("spoil", "words", "skinned"),
    [
        (_misfit, "set elementSize of its joint influences to 2", False),
        (_short_animation, f"<{SKELETON}/anim>: UsdSkel rejects a part of it", True),
        (_without_api, "apply SkelBindingAPI to it", False),
        (_without_api_on_skeleton, f"apply SkelBindingAPI to <{SKELETON}>", True),
        (_no_bind_pose, "author one bindTransform for each of its joints", False),
        (_unknown_skeleton, "names </World/none>, which is no Skeleton", False),
    ],
)
@pytest.mark.parametrize("path", [CLOTH, BODY])
def test_skinning_that_usd_rejects_is_named(tmp_path: Path, spoil, words: str, skinned: bool, path: str) -> None:
    stage = still_pose(tmp_path / "s.usda")
    slide(stage, SKELETON)
    assert said(open_shot(save(stage))) == ""
    spoil(stage, path)
    shot = open_shot(save(stage))
    assert words in said(shot)
    assert skinned or f"<{path}>" in said(shot)
    assert shot.sources[0].skinned == (skinned or (path == BODY and spoil is not _no_bind_pose))


def test_a_folder_without_a_type_above_a_skinned_mesh_is_named_with_its_remedy(tmp_path: Path) -> None:
    stage = still_pose(tmp_path / "s.usda")
    slide(stage, SKELETON)
    stage.GetPrimAtPath(CARRIER).SetTypeName("")
    words = said(open_shot(save(stage)))
    assert f"<{CARRIER}> has no type" in words
    stage.GetPrimAtPath(CARRIER).SetTypeName("Scope")
    assert said(open_shot(save(stage))) == ""
