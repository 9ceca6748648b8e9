"""Skinned cloth reaches its first frame from the bind pose (`--pose-in`)."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="shots are read with usd-core")

from fuzz.poses import ROOT, write_limb
from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt
from shots import cloth_shot

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.usd.read.reader import open_shot

BEND = 100.0
"""Angle between upper and lower limb [degrees]."""


@pytest.fixture
def limb(tmp_path: Path) -> Path:
    """An arm with sleeves that is bent in both of its frames."""
    write_limb(tmp_path)
    path = tmp_path / "shot.usda"
    stage = Usd.Stage.Open(str(path))
    animation = UsdSkel.Animation(stage.GetPrimAtPath(f"{ROOT}/skel/anim"))
    half = np.deg2rad(BEND) / 2.0
    turn = Gf.Quatf(float(np.cos(half)), 0.0, float(np.sin(half)), 0.0)
    root = Gf.Quatf(float(np.cos(0.4)), float(np.sin(0.4)), 0.0, 0.0)
    for time in (1.0, 2.0):
        animation.GetRotationsAttr().Set(Vt.QuatfArray([root, turn, Gf.Quatf(1.0)]), time)
    stage.GetRootLayer().Save()
    return path


def cage_at(shot: Path, part: float | None) -> np.ndarray:
    """The first frame's cage [m], or part of the way from the bind pose to it."""
    with closing(open_shot(str(shot))) as opened:
        frame = opened.frame(1.0) if part is None else opened.posed_frame(1.0, part)
        again = opened.frame(1.0).garments[0].points
        assert np.array_equal(again, cage_at(shot, None)) if part is not None else True
        return frame.garments[0].points


def test_poses_lead_from_the_bind_pose_to_the_first_frame(limb: Path):
    stage = Usd.Stage.Open(str(limb))
    modelled = np.array(UsdGeom.Mesh(stage.GetPrimAtPath(f"{ROOT}/cloth")).GetPointsAttr().Get(), dtype=np.float64)
    # The root joint is as in the frame: the bind pose, turned with it.
    c, s = np.cos(0.8), np.sin(0.8)
    turned = modelled @ np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
    np.testing.assert_allclose(cage_at(limb, 0.0), turned, atol=1e-6)
    np.testing.assert_allclose(cage_at(limb, 1.0), cage_at(limb, None), atol=1e-6)


def test_halfway_the_limb_is_bent_by_half(limb: Path):
    def bend(cage: np.ndarray) -> float:
        """Angle between the directions of the sleeve's ends [degrees]."""
        rings = cage[:144].reshape(12, 12, 3).mean(axis=1)  # Of the inner sleeve.
        upper, lower = rings[1] - rings[0], rings[8] - rings[7]
        cosine = upper @ lower / (np.linalg.norm(upper) * np.linalg.norm(lower))
        return float(np.rad2deg(np.arccos(cosine)))

    assert bend(cage_at(limb, None)) == pytest.approx(BEND, abs=1.0)
    assert bend(cage_at(limb, 0.5)) == pytest.approx(BEND / 2.0, abs=1.0)


def test_cloth_that_crosses_itself_in_the_bent_first_frame_comes_out_clean(limb: Path, tmp_path: Path):
    options = RefineOptions(level=1, frames=(1.0, 1.0))
    posed = RefineOptions(level=1, frames=(1.0, 1.0), pose_in=8)
    reports = [refine_shot(limb, tmp_path / f"{k}.usdc", each) for k, each in enumerate((options, posed))]
    left = [report.frames[0]["garments"][0]["contact"]["cloth"]["after"]["crossings"] for report in reports]
    assert left[1] == 0 < left[0]
    assert [any("--pose-in 12" in note for note in report.notes) for report in reports] == [True, False]
    assert reports[1].frames[0]["run_in_ms"] > 0
    assert reports[1].modelled["pose in"] == "8 poses between the bind pose and the first frame"


def test_without_a_skeleton_it_is_said_that_it_has_no_effect(tmp_path: Path):
    shot = cloth_shot(tmp_path / "sheet.usda", times=(1.0, 2.0))
    report = refine_shot(shot, tmp_path / "out.usdc", RefineOptions(level=0, steps=1, pose_in=3))
    assert [text for text in report.warnings if "--pose-in" in text] == [
        "--pose-in has no effect: no garment is skinned; leave it out"
    ]
