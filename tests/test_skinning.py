"""UsdSkel skinning, baked without touching the stage: against closed forms and USD's own baselines."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdSkel
from stages import add_sheet, add_skeleton, affine, bind_skin, new_stage, save, set_matrix, sheet_points, skinned_points

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
