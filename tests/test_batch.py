"""Several shots at once: what is left, what goes on, what fails, and one summary of it all."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from jsonschema import Draft202012Validator
from pxr import Usd, UsdGeom
from shots import CLOTH, cloth_shot, command, faults, sample_times

from physgraph_usd import cli
from physgraph_usd.errors import UsageError
from physgraph_usd.shot import summary
from physgraph_usd.shot.frames import frames_folder
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot, refine_shots

SMALL = ("--level", "0")


def run(*args: object) -> Result:
    return CliRunner().invoke(cli.main, [str(arg) for arg in args], catch_exceptions=False)


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


def interrupted(shot: Path, out: Path) -> list[str]:
    """Begin a shot, interrupt it after a few frames; returns the frames that it finished."""
    line = [sys.executable, "-m", "physgraph_usd", "refine", shot, "-o", out, "--progress", "--level", "0"]
    with subprocess.Popen(list(map(str, line)), stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        next(each for each in process.stderr if "2 of" in each)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    return sorted(file.name for file in frames_folder(out).glob("*.npz"))


@pytest.mark.slow
def test_twenty_shots_three_broken_one_there_one_interrupted(tmp_path: Path) -> None:
    """17 layers, one summary, exit code 3, and nothing is done twice."""
    out, log = tmp_path / "out", tmp_path / "log"
    out.mkdir()
    times = [float(each) for each in range(1, 13)]
    shots = [cloth_shot(tmp_path / f"s{number:02}.usda", times=(1.0, 2.0)) for number in range(15)]
    broken = [torn(tmp_path / f"torn{number}.usda") for number in range(3)]
    there = cloth_shot(tmp_path / "there.usda", times=(1.0, 2.0))
    stopped = cloth_shot(tmp_path / "stopped.usda", times=times, size=(60, 60))
    assert run("refine", there, "-o", out / "there.refined.usdc", *SMALL).exit_code == 0
    before = (out / "there.refined.usdc").stat()
    finished = interrupted(stopped, out / "stopped.refined.usdc")
    assert 2 <= len(finished) < len(times)

    line = ("refine", *broken, *shots, there, stopped, "-o", out, "--workers", "2", *SMALL)
    more = ("--skip-existing", "--resume", "--summary", tmp_path / "summary.json", "--log-file", log)
    done = command(*line, *more)

    assert done.returncode == 3, done.stderr
    layers = sorted(out.iterdir())
    assert len(layers) == 17
    assert all(layer.name.endswith(".refined.usdc") for layer in layers)
    assert (out / "there.refined.usdc").stat().st_mtime_ns == before.st_mtime_ns
    assert sample_times(out / "stopped.refined.usdc") == tuple(times)
    assert faults(out / "stopped.refined.usdc", stopped) == []
    rows = rows_of(tmp_path / "summary.json")
    states = {name: row["state"] for name, row in rows.items()}
    assert states == dict.fromkeys(rows, "done") | {f"torn{n}": "failed" for n in range(3)} | {"there": "skipped"}
    assert [rows["torn0"]["exit_code"], rows["there"]["exit_code"], rows["stopped"]["frames"]] == [1, 0, 12]
    assert any(f"{len(finished)} of 12 frames are those of a run" in each for each in rows["stopped"]["warnings"])
    assert len(re.findall(r"there.refined.usdc is there", log.read_text())) == 1
    assert done.stderr.count("shots failed") == 1
    assert "3 of 20 shots failed" in done.stderr

    again = command(*line, *more)
    assert again.returncode == 3
    assert {row["state"] for row in rows_of(tmp_path / "summary.json").values()} == {"skipped", "failed"}


class TestSummary:
    def test_a_row_says_what_became_of_a_shot(self, tmp_path: Path) -> None:
        good = cloth_shot(tmp_path / "good.usda", times=(1.0, 2.0))
        part = cloth_shot(tmp_path / "part.usda", times=(1.0, 2.0), broken={2.0: float("nan")})
        file = tmp_path / "summary.json"
        done = run("refine", good, part, torn(tmp_path / "torn.usda"), "-o", tmp_path, "--summary", file, *SMALL)
        rows = rows_of(file)
        assert done.exit_code == json.loads(file.read_text())["exit_code"] == 3
        assert [rows[name]["state"] for name in ("good", "part", "torn")] == ["done", "in part", "failed"]
        assert [rows[name]["exit_code"] for name in ("good", "part", "torn")] == [0, 3, 1]
        assert (rows["good"]["frames"], rows["good"]["failed_frames"], rows["good"]["crossings"]) == (2, [], 0)
        assert rows["good"]["seconds_a_frame"] > 0
        assert rows["part"]["failed_frames"] == ["2"]
        assert CLOTH in rows["torn"]["error"]
        table = done.stderr[done.stderr.index("shot ") :].splitlines()
        assert table[0].split()[:3] == ["shot", "state", "frames"]
        assert table[2].split()[:4] == ["part.usda", "in", "part", "1"]

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

    def test_an_interrupted_batch_says_what_was_not_begun(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def interrupted(*_: object, **__: object):
            raise KeyboardInterrupt

        monkeypatch.setattr("physgraph_usd.shot.refine.refine_shots", interrupted)
        shots = [cloth_shot(tmp_path / f"{name}.usda", times=(1.0,)) for name in "ab"]
        run("refine", *shots, "-o", tmp_path, "--summary", tmp_path / "summary.json", *SMALL)
        assert {row["state"] for row in rows_of(tmp_path / "summary.json").values()} == {"not done"}

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

    def test_no_process_is_started_for_it(self, tmp_path: Path) -> None:
        (tmp_path / "o.usdc").write_text("mine")
        jobs = [(tmp_path / "gone.usda", tmp_path / "o.usdc", RefineOptions(skip_existing=True))]
        began = time.perf_counter()
        (report,) = refine_shots(jobs, workers=1)
        assert getattr(report, "skipped", False)
        assert time.perf_counter() - began < 1.0

    def test_it_does_not_go_with_overwrite(self, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="choose one"):
            refine_shot("s.usda", tmp_path / "o.usdc", RefineOptions(skip_existing=True, overwrite=True))


class TestImports:
    """What is finished is passed over without the solver's libraries, whose import takes seconds."""

    def passed_over(self, *args: object) -> str:
        """Run the command in a process of its own; what it says last is the solver's libraries that it imported."""
        program = "import sys; from physgraph_usd.cli import main; main(sys.argv[1:], standalone_mode=False)"
        program = f"try: exec({program!r})\nexcept SystemExit as end: assert not end.code, end.code\n"
        program += "import sys; print({'torch', 'warp', 'scipy'} & sys.modules.keys() or 'none')"
        line = [sys.executable, "-c", program, "refine", *map(str, args)]
        return subprocess.run(line, capture_output=True, text=True, check=True).stdout.splitlines()[-1]

    def test_of_a_batch_and_of_one(self, tmp_path: Path) -> None:
        shots = [cloth_shot(tmp_path / f"{name}.usda", times=(1.0,)) for name in "ab"]
        for shot in shots:
            assert run("refine", shot, "-o", tmp_path / f"{shot.stem}.refined.usdc", *SMALL).exit_code == 0
        for option in ("--skip-existing", "--resume"):
            assert self.passed_over(*shots, "-o", tmp_path, option, *SMALL) == "none"
            assert self.passed_over(shots[0], "-o", tmp_path / "a.refined.usdc", option, *SMALL) == "none"


class TestLogging:
    def test_the_file_has_frames_and_errors_and_stderr_has_them_once(self, tmp_path: Path) -> None:
        shots = [cloth_shot(tmp_path / "good.usda", times=(1.0, 2.0)), torn(tmp_path / "torn.usda")]
        done = run("refine", *shots, "-o", tmp_path, "--log-file", tmp_path / "log", *SMALL)
        lines = (tmp_path / "log").read_text(encoding="utf-8").splitlines()
        assert [sum(f"INFO {shots[0]}: frame {n} of 2" in line for line in lines) for n in (1, 2)] == [1, 1]
        assert sum(f"ERROR {shots[1]}: " in line for line in lines) == done.stderr.count("error: ") == 1
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

    def test_a_warning_is_said_once(self, tmp_path: Path) -> None:
        shot = cloth_shot(tmp_path / "part.usda", times=(1.0, 2.0), broken={2.0: float("nan")})
        done = command("refine", shot, "-o", tmp_path / "o.usdc", *SMALL)
        said = done.stderr.splitlines()
        assert done.returncode == 3
        assert len(said) == len(set(said))
        assert sum("no sample is written at time code 2" in line for line in said) == 1


def test_an_error_is_said_once(tmp_path: Path):
    """In a process of its own: here pytest listens to what is logged."""
    given = [str(tmp_path / "none.usda"), "-o", str(tmp_path / "a.usdc")]
    line = [sys.executable, "-m", "physgraph_usd", "refine", *given]
    said = subprocess.run(line, capture_output=True, text=True, check=False).stderr
    assert said.count("no such file") == 1, said
