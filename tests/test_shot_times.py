"""Time codes of a shot: exactly the authored ones, in composed stage time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, UsdGeom
from stages import add_sheet, new_stage, said, save, set_matrix, sheet_points, sheet_shot

from physgraph_usd.errors import StageError, UsageError
from physgraph_usd.usd.read.reader import Shot, open_shot
from physgraph_usd.usd.times import merge, snap, within


def world(shot: Shot, time: float | None, index: int = 0) -> np.ndarray:
    return shot.frame(time).garments[index].points


def test_s31_times_are_the_union_of_authored_samples_and_nothing_else(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda")
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(8)
    rig = UsdGeom.Xform.Define(stage, "/World/rig").GetPrim()
    for time in (1.0, 1.25, 8.0):
        set_matrix(rig, np.eye(4), time)
    add_sheet(stage, "/World/rig/cloth", times=(1.0, 2.0, 7.0, 8.0))
    add_sheet(stage, "/World/still", times=())
    add_sheet(stage, "/World/prop", times=(3.0, 4.0), tagged=False)
    path = save(stage)
    shot = open_shot(path)
    assert shot.scene.times == (1.0, 1.25, 2.0, 7.0, 8.0)
    assert shot.sources[1].times == ()
    assert open_shot(path, frames=(2.0, 7.5)).scene.times == (2.0, 7.0)


def test_a_transform_on_a_spline_has_its_knots_and_whole_time_codes(tmp_path: Path) -> None:
    ts = pytest.importorskip("pxr.Ts", reason="splines came with a later USD")
    stage = new_stage(tmp_path / "s.usda")
    add_sheet(stage, times=())
    xform = UsdGeom.Xformable(stage.GetPrimAtPath("/World"))
    add_translate_x = getattr(xform, "AddTranslateXOp", None)
    if add_translate_x is None:
        pytest.skip("this USD has no scalar transform ops")
    attribute = add_translate_x().GetAttr()
    spline = ts.Spline("double")
    for time, value in ((1.5, 0.0), (4.0, 2.0)):
        knot = ts.Knot("double")
        knot.SetTime(time)
        knot.SetValue(value)
        knot.SetNextInterpolation(ts.InterpLinear)
        spline.SetKnot(knot)
    attribute.SetSpline(spline)
    shot = open_shot(save(stage))
    assert shot.scene.times == (1.5, 2.0, 3.0, 4.0)
    np.testing.assert_allclose(world(shot, 4.0), sheet_points() + np.array([2.0, 0, 0]), atol=1e-9)


def test_a_shot_without_samples_has_one_default_frame(tmp_path: Path) -> None:
    shot = open_shot(sheet_shot(tmp_path / "s.usda", times=()))
    assert shot.scene.times == ()
    np.testing.assert_array_equal(world(shot, None), sheet_points())


@pytest.mark.parametrize(("offset", "scale"), [(10.0, 1.0), (0.0, 25 / 24), (-3.5, 2.0)])
def test_s32_layer_offsets_are_composed(tmp_path: Path, offset: float, scale: float) -> None:
    sheet_shot(tmp_path / "anim.usda")
    root = Sdf.Layer.CreateNew(str(tmp_path / "shot.usda"))
    root.timeCodesPerSecond = 24.0
    root.pseudoRoot.SetInfo("metersPerUnit", 1.0)
    root.subLayerPaths.append("./anim.usda")
    root.subLayerOffsets[0] = Sdf.LayerOffset(offset, scale)
    root.Save()
    shot = open_shot(root.realPath)
    np.testing.assert_allclose(shot.scene.times, offset + scale * np.array([1.0, 2.0, 3.0]), atol=1e-9)
    np.testing.assert_allclose(world(shot, shot.scene.times[1]), sheet_points(2.0), atol=1e-6)


def test_garments_outside_the_frame_range_are_left_out(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda")
    add_sheet(stage, "/World/early")
    add_sheet(stage, "/World/late", times=(10.0, 11.0))
    path = save(stage)
    shot = open_shot(path, frames=(9.0, 20.0))
    assert [garment.path for garment in shot.scene.garments] == ["/World/late"]
    assert "authored time codes run from 1 to 3" in said(shot)
    with pytest.raises(StageError, match="no sample of the shot lies in frames 4:5; its 5 samples run from 1 to 11"):
        open_shot(path, frames=(4.0, 5.0))


@pytest.mark.parametrize("frames", [(5.0, 1.0), (float("nan"), 2.0), (1.0, float("inf"))])
def test_a_range_that_is_none_is_refused(tmp_path: Path, frames: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match="no range"):
        open_shot(sheet_shot(tmp_path / "s.usda"), frames=frames)


def test_times_that_differ_by_rounding_are_one_and_the_first_given_stays() -> None:
    assert merge([2.0, 1.0, 1.0 + 1e-9, 2.0 - 1e-9, 3.0]) == (1.0, 2.0, 3.0)
    assert merge([1.0 + 1e-9, 1.0]) == (1.0 + 1e-9,)
    assert merge([]) == ()


def test_snapped_times_are_the_merged_ones_to_the_bit() -> None:
    merged = merge([1.0, 2.0, 2.0 + 1e-9, 5.0])
    assert snap((1.0, 2.0 + 1e-9), merged) == (1.0, 2.0)
    assert snap((), ()) == ()


def test_sub_frames_stay_apart() -> None:
    assert merge([1.0, 1.001, 1.25]) == (1.0, 1.001, 1.25)


@pytest.mark.parametrize(
    ("frames", "expected"), [(None, (1.0, 2.0, 3.5)), ((2.0, 3.0), (2.0,)), ((2.0 + 1e-9, 3.5 - 1e-9), (2.0, 3.5))]
)
def test_ranges_are_closed_up_to_rounding(frames: tuple[float, float] | None, expected: tuple[float, ...]) -> None:
    assert within((1.0, 2.0, 3.5), frames) == expected
