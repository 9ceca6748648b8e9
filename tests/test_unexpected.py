"""Exceptions that nobody foresaw: one line on stderr, a report, finished frames kept, in whatever process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from frame_solvers import as_named
from pxr import Usd
from shots import CLOTH, cloth_shot, fine, refine, run
from test_report_format import checked

from physgraph_usd import refine_stage
from physgraph_usd.errors import At, Place, UnexpectedError
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.report import RefineReport
from physgraph_usd.shot.workers import result_of, separate_processes

BROKEN = 4.0
"""Time code at which the solver has a fault."""
COMMAND = f"""
import physgraph_usd.solver.frame.scene_frame as scene_frame
from physgraph_usd import cli

solve = scene_frame.solve_soundly

def broken(problem):
    if problem.at == {BROKEN}:
        raise ValueError("a bug\\n of two lines")
    return solve(problem)

scene_frame.solve_soundly = broken  # In worker processes too, which run this file as well.
if __name__ == "__main__":
    cli.main(prog_name="physgraph-usd")
"""
SAID = f"<{CLOTH}> at time code 4: unexpected ValueError: a bug of two lines (solver/frame/scene_frame.py, line "


def broken(folder: Path, *args: object) -> subprocess.CompletedProcess[str]:
    """The command with a fault in its solver."""
    (folder / "broken.py").write_text(COMMAND, encoding="utf-8")
    line = [sys.executable, "broken.py", "refine", *map(str, args), "--level", "0", "--steps", "2"]
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=300, cwd=folder)


def report_of(file: Path) -> dict[str, Any]:
    """A report that follows its schema."""
    return checked(json.loads(file.read_text(encoding="utf-8")))


def place_in(report: dict[str, Any]) -> tuple[str, list[str], float]:
    """What a report says of the failure, but for the line in the code."""
    assert report["failure"]["code"].startswith("solver/frame/scene_frame.py, line ")
    return report["failure"]["kind"], report["failure"]["prims"], report["failure"]["time"]


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_one_ends_with_a_line_and_a_report_and_keeps_what_is_finished(tmp_path: Path, workers: int):
    """Two workers have three frames each, so that the fault is in the first frame of the second one.

    Resumed with the mended solver, frames are the same bytes as at once.
    """
    shot = cloth_shot(tmp_path / "shot.usda")
    also = ("--report", "report.json", "--summary", "summary.json", "--log-file", "log.txt")
    done = broken(tmp_path, "shot.usda", "-o", "fine.usdc", "--workers", workers, *also)
    *before, last = done.stderr.splitlines()
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert last.startswith(f"error: {SAID}")
    assert "--frames or --garment can leave out where it happens" in last
    assert any("3 of 6 frames are kept in fine.usdc.frames; --resume goes on" in line for line in before)
    report = report_of(tmp_path / "report.json")
    assert (f"error: {report['error']}", report["exit_code"]) == (last, 1)
    assert place_in(report) == ("ValueError", [CLOTH], BROKEN)
    (row,) = json.loads((tmp_path / "summary.json").read_text())["shots"]
    assert (row["state"], row["error"]) == ("failed", report["error"])
    assert report["error"] in (tmp_path / "log.txt").read_text()
    assert not (tmp_path / "fine.usdc").exists()
    line = ("--level", 0, "--steps", 2, "--report", tmp_path / "report.json", "--overwrite")
    for out, more in (("fine.usdc", ["--resume"]), ("whole.usdc", [])):  # By the mended solver.
        assert run("refine", shot, "-o", tmp_path / out, *line, *more).exit_code == 0
    for time in (3.0, 4.0):
        assert (fine(shot, tmp_path / "fine.usdc", time) == fine(shot, tmp_path / "whole.usdc", time)).all()


@pytest.mark.slow
def test_one_of_several_shots_leaves_the_others(tmp_path: Path):
    for name, time in (("one", BROKEN), ("two", 1.0)):
        cloth_shot(tmp_path / f"{name}.usda", times=(time,))
    done = broken(tmp_path, "one.usda", "two.usda", "-o", "out", "--report", "reports", "--debug")
    assert done.returncode == 3, done.stderr
    assert f"error: one.usda: {SAID}" in done.stderr
    assert done.stderr.count("Traceback (most recent call last)") == 1
    assert 'raise ValueError("a bug' in done.stderr
    reports = [report_of(tmp_path / "reports" / name / "report.json") for name in ("one", "two")]
    assert place_in(reports[0]) == ("ValueError", [CLOTH], BROKEN)
    assert (reports[1]["error"], reports[1]["failure"]) == ("", None)


@pytest.fixture
def _broken(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ValueError("a bug")

    monkeypatch.setattr("physgraph_usd.solver.frame.scene_frame.solve_soundly", fail)


@pytest.mark.usefixtures("_broken")
class TestFromPython:
    """The exception itself goes on, once the report is written."""

    def test_a_file(self, tmp_path: Path):
        file = tmp_path / "report.json"
        with pytest.raises(ValueError, match=r"^a bug$"):
            refine(cloth_shot(tmp_path / "shot.usda"), tmp_path / "fine.usdc", report=file)
        report = report_of(file)
        assert place_in(report) == ("ValueError", [CLOTH], 1.0)
        assert report["error"].startswith(f"<{CLOTH}> at time code 1: unexpected ValueError: a bug (")
        assert sorted(path.name for path in tmp_path.iterdir()) == ["report.json", "shot.usda"]

    def test_an_open_stage(self, tmp_path: Path):
        stage, told = Usd.Stage.Open(str(cloth_shot(tmp_path / "shot.usda"))), list[RefineReport]()
        options = RefineOptions(level=0, steps=2, report=tmp_path / "report.json")
        with pytest.raises(ValueError, match=r"^a bug$"):
            refine_stage(stage, options, on_report=told.append)
        assert place_in(report_of(tmp_path / "report.json")) == ("ValueError", [CLOTH], 1.0)
        assert told[0].failure is not None


def test_a_prim_that_is_not_there_is_reported_too(tmp_path: Path):
    shot, file = cloth_shot(tmp_path / "shot.usda"), tmp_path / "report.json"
    done = run("refine", shot, "-o", tmp_path / "fine.usdc", "--garment", "/World/coat", "--report", file)
    report = report_of(file)
    assert (done.exit_code, report["exit_code"], report["failure"]["kind"]) == (2, 2, "AbsentError")
    assert done.stderr == f"error: {report['error']}\n"


@pytest.mark.parametrize("debug", [True, False])
@pytest.mark.parametrize("command", ["inspect", "validate"])
def test_every_command_ends_with_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, debug: bool):
    def fail(*_: object, **__: object) -> None:
        raise KeyError("a bug")

    monkeypatch.setattr("physgraph_usd.shot.refine.inspect_shot", fail)
    monkeypatch.setattr("physgraph_usd.usd.check.validate.validate_layer", fail)
    done = run(command, cloth_shot(tmp_path / "shot.usda"), *["--debug"] * debug)
    assert (done.exit_code, done.stdout) == (1, "")
    assert done.stderr.splitlines()[-1].startswith("error: unexpected KeyError: 'a bug' (cli/commands.py, line ")
    assert ("Traceback" in done.stderr, len(done.stderr.splitlines()) > 1) == (debug, debug)


class CannotTravel(Exception):
    """An exception that is pickled, and that no other process can load."""

    def __init__(self, one: str, other: str) -> None:
        super().__init__(f"{one} {other}")


def raises_what_cannot_travel() -> None:
    with At(prims=("/World/coat",), time=3.0):
        raise CannotTravel("a", "bug")


def test_an_exception_that_cannot_travel_reaches_the_parent():
    with separate_processes(1) as start:
        with pytest.raises(UnexpectedError, match=r"^</World/coat> at time code 3: unexpected CannotTravel: a bug "):
            result_of(start(raises_what_cannot_travel))
        with pytest.raises(UnexpectedError) as error:
            result_of(start(as_named, "raises"))
    assert 'raise ValueError("a bug")' in error.value.trace


class TestPlace:
    def test_prims_without_number_and_long_texts_stay_one_line(self):
        place = Place(tuple(f"/World/coat{k}" for k in range(500)))
        text = str(UnexpectedError("ValueError", "wrong\n" * 1000, place=place))
        assert text.startswith("</World/coat0>, </World/coat1>, </World/coat2> and 497 more: unexpected")
        assert (len(text) < 700, "\n" in text) == (True, False)
