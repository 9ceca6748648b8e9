"""Skinned cloth reaches its first frame from the bind pose, if it would cross itself there or `--pose-in` asks."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="shots are read with usd-core")

from fuzz.poses import ROOT, write_limb
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from shots import cloth_shot

from physgraph_usd.errors import SolveError
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.shot.report import RefineReport
from physgraph_usd.shot.run_in import MOST_POSES
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.scene import Frame, Result
from physgraph_usd.usd.read.reader import Shot, open_shot

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


def crossings(report: RefineReport) -> int:
    """Crossings of cloth in the first frame."""
    return report.frames[0]["garments"][0]["contact"]["cloth"]["after"]["crossings"]


def test_cloth_that_crosses_itself_in_the_bent_first_frame_continues_from_the_bind_pose(limb: Path, tmp_path: Path):
    options = RefineOptions(level=1, frames=(1.0, 1.0))
    never, automatic, requested = (
        refine_shot(limb, tmp_path / f"{poses}.usdc", replace(options, pose_in=poses)) for poses in (0, None, 8)
    )
    assert crossings(automatic) == crossings(requested) == 0 < crossings(never)
    assert [report.frames[0].get("poses") for report in (never, automatic, requested)] == [None, MOST_POSES, 8]
    assert [any("bind pose" in note for note in report.notes) for report in (never, automatic)] == [False, True]
    assert automatic.frames[0]["run_in_ms"] > 0
    assert requested.modelled["pose in"] == "8 poses between the bind pose and the first frame"


def test_the_first_result_stays_where_a_pose_crosses_itself(
    limb: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Poses that are solved from no frame to no frame, each from its cage, cross themselves on the way."""
    options = RefineOptions(level=1, frames=(1.0, 2.0))
    never = refine_shot(limb, tmp_path / "never.usdc", replace(options, pose_in=0))
    posed_frame = Shot.posed_frame
    monkeypatch.setattr(Shot, "posed_frame", lambda shot, time, part: posed_frame(shot, time, 1.0))
    vain = refine_shot(limb, tmp_path / "vain.usdc", options)
    assert crossings(vain) == crossings(never)
    assert "poses" not in vain.frames[0]
    layers = [Sdf.Layer.FindOrOpen(str(tmp_path / f"{name}.usdc")) for name in ("never", "vain")]
    for time in (1.0, 2.0):
        first, second = (np.array(layer.QueryTimeSample(f"{ROOT}/cloth.points", time)) for layer in layers)
        assert np.array_equal(first, second)


def test_a_frame_that_fails_after_the_poses_keeps_its_first_result(
    limb: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    fork = Refiner.fork

    def broken(refiner: Refiner, settings: SolveSettings) -> Refiner:
        forked = fork(refiner, settings)

        def solve_poses_only(frame: Frame, wanted: Sequence[bool] | None = None) -> Result:
            if frame.time == 1.0:
                raise SolveError("not finite")
            return type(forked).solve(forked, frame, wanted)

        monkeypatch.setattr(forked, "solve", solve_poses_only)
        return forked

    monkeypatch.setattr(Refiner, "fork", broken)
    report = refine_shot(limb, tmp_path / "out.usdc", RefineOptions(level=1, frames=(1.0, 1.0)))
    assert report.failed == {}
    assert crossings(report) > 0
    assert report.frames[0]["run_in_ms"] > 0


def test_a_frame_that_reached_its_limit_of_time_gets_no_poses(limb: Path, tmp_path: Path):
    options = RefineOptions(level=1, frames=(1.0, 1.0), frame_limit=0.01)
    report = refine_shot(limb, tmp_path / "out.usdc", options)
    assert crossings(report) > 0
    assert "run_in_ms" not in report.frames[0]


def test_without_a_skeleton_it_is_said_that_it_has_no_effect(tmp_path: Path):
    shot = cloth_shot(tmp_path / "sheet.usda", times=(1.0, 2.0))
    report = refine_shot(shot, tmp_path / "out.usdc", RefineOptions(level=0, steps=1, pose_in=3))
    assert [text for text in report.warnings if "--pose-in" in text] == [
        "--pose-in has no effect: no garment is skinned; leave it out"
    ]
