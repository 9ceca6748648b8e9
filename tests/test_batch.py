"""Several shots at once: what is left, what goes on, what fails, and one summary of it all."""

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from jsonschema import Draft202012Validator
from pxr import Usd, UsdGeom
from shots import CLOTH, cloth_shot, run

from physgraph_usd.errors import UsageError
from physgraph_usd.shot import summary
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot

SMALL = ("--level", "0")


def torn(shot: Path) -> Path:
    """A shot whose garment names a point that is not there."""
    stage = Usd.Stage.Open(str(cloth_shot(shot, times=(1.0,))))
    UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetFaceVertexIndicesAttr().Set([0, 1, 999])
    stage.Save()
    return shot


def rows_of(file: Path) -> dict[str, dict[str, Any]]:
    """A summary that follows its schema, by the shots' names."""
    plain = json.loads(file.read_text(encoding="utf-8"))
    Draft202012Validator(json.loads(summary.SCHEMA.read_text(encoding="utf-8"))).validate(plain)
    return {Path(row["shot"]).stem: row for row in plain["shots"]}


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    """A shot that is done, one in part, and three that fail: torn, with a layer that is there, with no report."""
    folder = tmp_path_factory.mktemp("batch")
    good, there, told = (cloth_shot(folder / f"{name}.usda", times=(1.0, 2.0)) for name in ("good", "there", "told"))
    part = cloth_shot(folder / "part.usda", times=(1.0, 2.0), broken={2.0: float("nan")})
    for kept in (folder / "out" / "there.refined.usdc", folder / "reports" / "told"):
        kept.parent.mkdir()
        kept.write_text("mine")
    line = ("refine", good, part, torn(folder / "torn.usda"), there, told, "-o", folder / "out", "--workers", "2")
    more = ("--report", folder / "reports", "--summary", folder / "summary.json", "--log-file", folder / "log")
    return run(*line, *more, *SMALL), folder


class TestSummary:
    def test_a_row_says_what_became_of_a_shot(self, batch: tuple[Result, Path]) -> None:
        done, folder = batch
        rows = rows_of(folder / "summary.json")
        assert done.exit_code == json.loads((folder / "summary.json").read_text())["exit_code"] == 3
        assert [rows[name]["state"] for name in ("good", "part", "torn")] == ["done", "in part", "failed"]
        assert [rows[name]["exit_code"] for name in ("good", "part", "torn")] == [0, 3, 1]
        assert (rows["good"]["frames"], rows["good"]["failed_frames"], rows["good"]["crossings"]) == (2, [], 0)
        assert rows["good"]["seconds_a_frame"] > 0
        assert rows["part"]["failed_frames"] == ["2"]
        assert CLOTH in rows["torn"]["error"]
        table = done.stderr[done.stderr.index("shot ") :].splitlines()
        assert table[0].split()[:3] == ["shot", "state", "frames"]
        assert table[2].split()[:4] == ["part.usda", "in", "part", "1"]

    def test_those_that_fail_leave_the_others(self, batch: tuple[Result, Path]) -> None:
        done, folder = batch
        layers = sorted(file.name for file in (folder / "out").iterdir())
        assert layers == ["good.refined.usdc", "part.refined.usdc", "there.refined.usdc"]
        assert "3 of 5 shots failed" in done.stderr.splitlines()
        for name, why in {"torn": CLOTH, "there": "exists", "told": "cannot write"}.items():
            assert any(f"{name}.usda: " in line and why in line for line in done.stderr.splitlines())
        assert (
            (folder / "out" / "there.refined.usdc").read_text() == (folder / "reports" / "told").read_text() == "mine"
        )

    def test_one_shot_has_one_too_when_it_fails(self, tmp_path: Path) -> None:
        file = tmp_path / "summary.json"
        done = run("refine", torn(tmp_path / "torn.usda"), "-o", tmp_path / "o.usdc", "--summary", file, *SMALL)
        assert (done.exit_code, rows_of(file)["torn"]["state"]) == (1, "failed")
        assert done.stderr.count("error: ") == 1

    def test_it_replaces_a_summary_and_nothing_else(self, tmp_path: Path) -> None:
        shot, file = cloth_shot(tmp_path / "s.usda", times=(1.0,)), tmp_path / "summary.json"
        line = ("refine", shot, "-o", tmp_path / "o.usdc", "--summary", file, *SMALL)
        file.write_text('{"mine": 1}')
        assert (run(*line).exit_code, file.read_text()) == (2, '{"mine": 1}')
        file.unlink()
        assert run(*line).exit_code == 0
        assert run(*line, "--skip-existing").exit_code == 0
        assert rows_of(file)["s"]["state"] == "skipped"
        assert run(*line[:-4], "--summary", shot, "--overwrite").exit_code == 2

    def test_crossings_of_garments_solved_together_count_once(self) -> None:
        from physgraph_usd.shot.report import RefineReport

        def entry(*together: str) -> dict[str, Any]:
            sides = {when: {"crossings": 3, "between_garments": 0} for when in ("before", "after")}
            return {"contact": {"cloth": {"near": True, **sides}}} | ({"together": list(together)} if together else {})

        garments = [{"path": "/a"}, {"path": "/b"}]
        frames = [{"time": 1.0, "garments": [entry("/a", "/b")] * 2}, {"time": 2.0, "garments": [entry(), entry()]}]
        assert RefineReport("s", None, {}, garments=garments, frames=frames).crossings == 9
        assert RefineReport("s", None, {}, garments=garments).crossings is None


class TestSkipExisting:
    def test_the_layer_is_left_and_its_shot_not_even_opened(self, tmp_path: Path) -> None:
        (tmp_path / "o.usdc").write_text("mine")
        report = refine_shot(tmp_path / "gone.usda", tmp_path / "o.usdc", RefineOptions(skip_existing=True))
        assert (report.skipped, report.exit_code, report.out) == (True, 0, tmp_path / "o.usdc")
        assert (tmp_path / "o.usdc").read_text() == "mine"

    def test_it_does_not_go_with_overwrite(self, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="choose one"):
            refine_shot("s.usda", tmp_path / "o.usdc", RefineOptions(skip_existing=True, overwrite=True))


class TestLogging:
    def test_the_file_has_frames_and_errors_and_stderr_has_them_once(self, batch: tuple[Result, Path]) -> None:
        done, folder = batch
        lines = (folder / "log").read_text(encoding="utf-8").splitlines()
        assert [sum(f"INFO {folder / 'good.usda'}: frame {n} of 2" in line for line in lines) for n in (1, 2)] == [1, 1]
        for name in ("torn", "there", "told"):
            assert sum(f"ERROR {folder / name}.usda: " in line for line in lines) == 1
        assert done.stderr.count("error: ") == 3
        assert "frame 1 of 2" not in done.stderr

    def test_it_is_never_appended_to_the_shot(self, tmp_path: Path) -> None:
        shot = cloth_shot(tmp_path / "good.usda", times=(1.0,))
        before = shot.read_bytes()
        done = run("refine", shot, "-o", tmp_path / "o.usdc", "--log-file", shot, *SMALL)
        assert (done.exit_code, "the log" in done.stderr, shot.read_bytes()) == (2, True, before)

    def test_it_is_appended_to_logs_alone(self, tmp_path: Path) -> None:
        shot, log, other = cloth_shot(tmp_path / "good.usda", times=(1.0,)), tmp_path / "log", tmp_path / "notes.txt"
        other.write_text("buy milk\n")
        for count in (1, 2):
            done = run("refine", shot, "-o", tmp_path / "o.usdc", "--log-file", log, "--overwrite", *SMALL)
            assert (done.exit_code, log.read_text().count("frame 1 of 1")) == (0, count)
        done = run("refine", shot, "-o", tmp_path / "o.usdc", "--log-file", other, "--overwrite", *SMALL)
        assert (done.exit_code, f"{other} exists and is no log" in done.stderr) == (2, True)
        assert other.read_text() == "buy milk\n"

    def test_more_is_said_when_asked(self, tmp_path: Path) -> None:
        shot = cloth_shot(tmp_path / "good.usda", times=(1.0, 2.0))
        said = run("refine", shot, "-o", tmp_path / "o.usdc", "-v", *SMALL).stderr
        assert [line for line in said.splitlines() if line.startswith("frame")][1] == "frame 2 of 2: time code 2"
        assert "energy_joules" in run("refine", shot, "-o", tmp_path / "p.usdc", "-vv", *SMALL).stderr
