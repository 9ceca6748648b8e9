"""Broken points are repaired from the stage alone, and only they change."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import UsdGeom
from stages import add_sheet, new_stage, save, sheet_points, sheet_shot, vec3

from physgraph_usd.errors import GarmentError
from physgraph_usd.usd.read.cage import repair
from physgraph_usd.usd.read.reader import open_shot

LINE = np.array([[0, 1], [1, 2], [2, 3]])


def test_a_point_moves_as_its_neighbours_did() -> None:
    before = np.array([[0.0, 0, 0], [1, 5, 0], [2, 0, 0], [3, 0, 0]])
    now = before + np.array([0.0, 0.0, 2.0])
    now[1] = np.nan
    out = repair(now, LINE, before)
    np.testing.assert_allclose(out[1], [1, 5, 2])
    np.testing.assert_array_equal(out[[0, 2, 3]], now[[0, 2, 3]])


def test_repair_grows_inwards_ring_by_ring() -> None:
    before = np.arange(12.0).reshape(4, 3)
    now = before + 1.0
    now[1:] = np.inf
    np.testing.assert_allclose(repair(now, LINE, before), before + 1.0)


def test_a_point_without_neighbours_is_held_and_without_samples_takes_their_mean() -> None:
    before = np.ones((3, 3))
    now = np.array([[0.0, 0, 0], [np.nan, 0, 0], [2, 2, 2]])
    none = np.zeros((0, 2), np.int64)
    np.testing.assert_array_equal(repair(now, none, before)[1], [1, 1, 1])
    np.testing.assert_array_equal(repair(now, np.array([[0, 1], [1, 2]]), None)[1], [1, 1, 1])
    assert np.isnan(repair(now, none, None)[1, 0])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("when", [1.0, 2.0, 3.0])
def test_s5_one_broken_point_is_told_and_leaves_other_frames_alone(tmp_path: Path, value: float, when: float) -> None:
    (tmp_path / "bad").mkdir()
    stage = new_stage(tmp_path / "bad" / "s.usda")
    points = sheet_points(when)
    points[7, 2] = value
    add_sheet(stage).GetPointsAttr().Set(vec3(points), when)
    bad, good = open_shot(save(stage)), open_shot(sheet_shot(tmp_path / "good.usda"))
    for time in (1.0, 2.0, 3.0):
        ours, theirs = (shot.frame(time).garments[0].points for shot in (bad, good))
        same = np.ones(len(ours), bool)
        same[7] = time != when
        np.testing.assert_array_equal(ours[same], theirs[same])
        assert np.linalg.norm(ours[7] - theirs[7]) < 0.5
    told = [notice for notice in bad.warnings if notice.time == when]
    assert len(told) == 1
    assert "points[7] NaN or infinite: 1 repaired" in told[0].message
    np.testing.assert_array_equal(bad.scene.garments[0].rest, good.scene.garments[0].rest)


def test_too_many_broken_points_are_refused_with_prim_and_time(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda")
    points = sheet_points(2.0)
    points[:3] = np.nan
    add_sheet(stage).GetPointsAttr().Set(vec3(points), 2.0)
    shot = open_shot(save(stage))
    with pytest.raises(GarmentError, match=r"</World/cloth> at time code 2: 3 of 20 points are NaN.*--frames"):
        shot.frame(2.0)


@pytest.mark.parametrize("when", [None, 1.0])
def test_a_single_sample_is_repaired_from_its_neighbours(tmp_path: Path, when: float | None) -> None:
    stage = new_stage(tmp_path / "s.usda")
    points = sheet_points(when)
    points[7] = np.nan
    mesh = add_sheet(stage, times=() if when is None else (when,), default=False)
    mesh.CreatePointsAttr().Set(vec3(points), *(() if when is None else (when,)))
    shot = open_shot(save(stage))
    neighbours = sheet_points(when)[[2, 6, 8, 12]].mean(axis=0)
    np.testing.assert_allclose(shot.frame(when).garments[0].points[7], neighbours, atol=1e-6)


def test_a_mesh_without_points_is_refused(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda")
    add_sheet(stage, times=(), default=False)
    with pytest.raises(GarmentError, match="</World/cloth>: has no points; "):
        open_shot(save(stage))
    UsdGeom.Mesh.Get(stage, "/World/cloth").CreatePointsAttr([])
    with pytest.raises(GarmentError, match="the mesh is empty: 0 points"):
        open_shot(save(stage))
