"""The report's JSON: its format, its schema, and entries of one shape."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from shots import cloth_shot, refine, run

from physgraph_usd import __version__
from physgraph_usd.errors import PhysGraphError
from physgraph_usd.shot import summary
from physgraph_usd.shot.report import FORMAT, SCHEMA

VALIDATOR = Draft202012Validator(json.loads(SCHEMA.read_text(encoding="utf-8")))


def checked(report: dict[str, Any]) -> dict[str, Any]:
    VALIDATOR.validate(report)
    assert (report["format"], report["version"]) == (FORMAT, __version__)
    return report


@pytest.mark.parametrize(("name", "file"), [("report", SCHEMA), ("summary", summary.SCHEMA)])
def test_the_command_prints_the_schemas_which_are_schemas(name: str, file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    assert run("report-schema", name).stdout == text
    Draft202012Validator.check_schema(json.loads(text))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        pytest.param("torus", {"level": 0, "frames": (1.0, 4.0)}, marks=pytest.mark.slow),
        ("layers", {"level": 0, "frames": (1.0, 3.0)}),
        ("frozen", {}),
    ],
)
def test_reports_of_samples_follow_it(
    sample: Callable[[str], Path], tmp_path: Path, name: str, options: dict[str, Any]
) -> None:
    """Bodies, garments that touch, frames that are taken over."""
    file = tmp_path / "report.json"
    refine(sample(name), tmp_path / "fine.usdc", report=file, steps=2, **{"frames": (1.0, 3.0)} | options)
    checked(json.loads(file.read_text(encoding="utf-8")))


def test_frames_that_fail_have_the_shape_of_the_others(tmp_path: Path) -> None:
    shot = cloth_shot(tmp_path / "s.usda", broken={3.0: float("nan"), 4.0: 1e-4})
    report = checked(json.loads(refine(shot, tmp_path / "fine.usdc").to_json()))
    assert len({tuple(sorted(frame)) for frame in report["frames"]}) == 1
    entries = [entry for frame in report["frames"] for entry in frame["garments"]]
    assert len({tuple(sorted(entry)) for entry in entries}) == 1
    assert [bool(frame["error"]) for frame in report["frames"]] == [False, False, True, False, False, False]


def test_a_dry_run_follows_it(tmp_path: Path) -> None:
    shot = cloth_shot(tmp_path / "s.usda")
    assert checked(json.loads(refine(shot, tmp_path / "fine.usdc", dry_run=True).to_json()))["out"] is None


def test_a_run_that_fails_writes_one(tmp_path: Path) -> None:
    """Without its only frame."""
    shot, file = cloth_shot(tmp_path / "s.usda", broken={2.0: float("nan")}), tmp_path / "report.json"
    with pytest.raises(PhysGraphError) as error:
        refine(shot, tmp_path / "fine.usdc", report=file, frames=(2.0, 2.0))
    report = checked(json.loads(file.read_text(encoding="utf-8")))
    assert (report["error"], report["exit_code"], report["out"]) == (str(error.value), 1, None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.json", "s.usda"]
    refine(shot, tmp_path / "fine.usdc", report=file, frames=(1.0, 1.0))
    assert json.loads(file.read_text(encoding="utf-8"))["error"] == ""


def test_a_report_of_a_run_that_ended_well_is_kept(tmp_path: Path) -> None:
    shot, file = cloth_shot(tmp_path / "s.usda", times=(1.0,)), tmp_path / "report.json"
    refine(shot, tmp_path / "fine.usdc", report=file)
    before = file.read_bytes()
    for resume, said in ((False, "exists"), (True, "gone")):
        with pytest.raises(PhysGraphError, match=said):
            refine(shot, tmp_path / "other.usdc", report=file, garments=["/World/gone"], resume=resume)
        assert file.read_bytes() == before
