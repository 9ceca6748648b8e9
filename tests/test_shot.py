"""`refine_shot` end to end: options, reports, failures of single frames, and what is never written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom
from shots import CLOTH, TIMES, cloth_shot, faults, fine, only, refine, sample_times

from physgraph_usd.errors import UsageError
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.usd.check.validate import validate_layer

BEND = "physgraph:material:bendStiffness"


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "shot.usdc")


class TestDone:
    @pytest.mark.parametrize("mode", ["over", "sibling"])
    def test_layer_report_and_root(self, shot: Path, tmp_path: Path, mode: str):
        out, told, root = tmp_path / "fine.usdc", tmp_path / "fine.json", tmp_path / "fine.usda"
        report = refine(shot, out, report=told, root=root, mode=mode, velocities=True)
        assert (report.exit_code, report.out, report.failed) == (0, out, {})
        assert faults(out, shot) == []
        composed = Usd.Stage.Open(str(root))
        target = UsdGeom.Mesh(composed.GetPrimAtPath(CLOTH + ("_refined" if mode == "sibling" else "")))
        assert len(target.GetPointsAttr().Get(1.0)) == 13 * 9
        assert sample_times(out, str(target.GetPath())) == TIMES
        assert json.loads(told.read_text())["exit_code"] == 0

    @pytest.mark.parametrize("frames", [None, (2.0, 3.0)])
    def test_what_is_known_before_the_first_frame_is_what_inspect_says_of_the_whole_shot(
        self, shot: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, frames: tuple[float, float] | None
    ):
        caplog.set_level("INFO", "physgraph_usd")
        seen: list[list[str]] = []
        found = inspect_shot(shot, level=1)
        report = refine(shot, tmp_path / "fine.usdc", progress=lambda *_: seen.append(caplog.messages), frames=frames)
        (garment,), (refined,) = found["garments"], report.garments
        for name in ("wavelength_mm", "level_for_finest_wrinkles", "level_reason", "strained", "unfelt"):
            assert refined[name] == garment[name], name
        assert report.notes[: len(found["notes"])] == found["notes"]
        assert {*report.warnings, *found["notes"]} >= {*found["warnings"]} | {*found["notes"]}
        assert {*found["warnings"], *found["notes"]} <= {*seen[0]}
        assert {record.name for record in caplog.records} == {"physgraph_usd"}

    def test_a_range_that_leaves_out_samples_is_told_everywhere(self, shot: Path, tmp_path: Path):
        out = tmp_path / "fine.usdc"
        report = refine(shot, out, frames=(2.0, 3.0))
        assert sample_times(out) == (2.0, 3.0)
        said = "4 of 6 samples, 1 and 4 to 6"
        assert report.garments[0]["samples_left_out"] == 4
        assert said in report.left_out["samples"]
        assert not [warning for warning in report.warnings if said in warning]  # It was asked for.
        record = Sdf.Layer.FindOrOpen(str(out)).customLayerData["physgraph"]
        assert dict(record["left_out"]) == {CLOTH: said}
        (problem,) = validate_layer(out)
        assert (problem.severity, problem.path, problem.rule) == ("warning", CLOTH, "whole_range")
        assert said in problem.message

    def test_velocities_are_written_where_the_shot_has_them(self, shot: Path, tmp_path: Path):
        out = tmp_path / "fine.usdc"
        assert refine(shot, out, overwrite=True).garments[0]["velocities"] == "none"
        assert not Sdf.Layer.FindOrOpen(str(out)).GetAttributeAtPath(f"{CLOTH}.velocities")
        stage = Usd.Stage.Open(str(shot))
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH))
        for time in TIMES:
            count = len(mesh.GetPointsAttr().Get(time))
            mesh.CreateVelocitiesAttr().Set([(0, 0, 1)] * count, time)
            mesh.CreateAccelerationsAttr().Set([(0, 0, 1)] * count, time)
        stage.Save()
        report = refine(shot, out, overwrite=True)
        assert report.garments[0]["velocities"] == "written anew, as the shot has them"
        assert f"<{CLOTH}>: its velocities are written anew, from the refined points" in report.warnings
        assert any("accelerations are blocked" in warning for warning in report.warnings)
        assert tuple(Sdf.Layer.FindOrOpen(str(out)).ListTimeSamplesForPath(f"{CLOTH}.velocities")) == TIMES
        assert faults(out, shot) == []

    def test_pinned_points_keep_the_input_to_the_bit(self, tmp_path: Path):
        """S17 through the whole tool: the layer repeats the shot's own float32."""
        shot = cloth_shot(tmp_path / "shot.usdc", times=(1.0, 2.0))
        stage = Usd.Stage.Open(str(shot))
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH))
        count = len(mesh.GetPointsAttr().Get(1.0))
        UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("physgraph:pin", Sdf.ValueTypeNames.FloatArray, "vertex").Set(
            [1.0] * count
        )
        stage.Save()
        refine(shot, tmp_path / "fine.usdc")
        layer = Sdf.Layer.FindOrOpen(str(tmp_path / "fine.usdc"))
        for time in (1.0, 2.0):
            written = np.asarray(layer.QueryTimeSample(f"{CLOTH}.points", time))[:count]
            assert np.array_equal(written, np.asarray(mesh.GetPointsAttr().Get(time)))


def test_set_changes_the_cloth_and_is_recorded(shot: Path, tmp_path: Path):
    plain, stiff = tmp_path / "plain.usdc", tmp_path / "stiff.usdc"
    refine(shot, plain)
    report = refine(shot, stiff, overrides=[f"{BEND}=1e-3"])
    assert report.garments[0]["fabric"]["bend"] == pytest.approx(1e-3)
    assert np.abs(fine(shot, plain, 3.0) - fine(shot, stiff, 3.0)).max() > 1e-4
    assert any("--set" in str(source) for source in report.garments[0]["sources"].values())


class TestOptions:
    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("integrator", "strech"),
            ("temporal", "sometimes"),
            ("mode", "under"),
            ("device", "tpu"),
            ("workers", 0),
            ("steps", -1),
            ("tolerance", float("nan")),
            ("frame_limit", 0.0),
            ("level", 99),
            ("frames", (5.0, 1.0)),
            ("rest_frame", float("inf")),
        ],
    )
    def test_every_option_is_checked_before_anything_is_written(
        self, shot: Path, tmp_path: Path, name: str, value: object
    ):
        for dry_run in (False, True):
            with pytest.raises(UsageError) as error:
                refine(shot, tmp_path / "fine.usdc", **{name: value}, dry_run=dry_run)
            assert str(error.value)
        assert only(tmp_path, "shot.usdc")

    def test_cuda_without_a_device(self, shot: Path, tmp_path: Path):
        import torch

        if torch.cuda.is_available():
            pytest.skip("there is a CUDA device")
        with pytest.raises(UsageError, match="--device auto or cpu"):
            refine(shot, tmp_path / "fine.usdc", device="cuda")
        assert only(tmp_path, "shot.usdc")

    def test_an_existing_layer_is_kept_unless_told(self, shot: Path, tmp_path: Path):
        out = tmp_path / "fine.usdc"
        out.write_bytes(b"mine")
        with pytest.raises(UsageError, match="exists"):
            refine(shot, out)
        assert out.read_bytes() == b"mine"
        assert refine(shot, out, overwrite=True).exit_code == 0

    def test_dry_run_writes_nothing_and_knows_everything(self, shot: Path, tmp_path: Path):
        report = refine(
            shot, tmp_path / "fine.usdc", dry_run=True, report=tmp_path / "a.json", root=tmp_path / "a.usda"
        )
        assert only(tmp_path, "shot.usdc")
        assert (report.out, report.frames) == (None, [])
        assert report.garments[0]["level"] == 1
