"""Frames that the solver leaves unsettled, or stops at their time limit: each is told of, and counts with --strict."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from shots import CLOTH, cloth_shot, faults, refine, run, sample_times
from stages import add_mesh, new_stage, save, sheet_faces, sheet_points

import physgraph_usd
from physgraph_usd.shot.findings.table import FINDINGS, Facts, texts
from physgraph_usd.shot.findings.unsettled import in_words, unsettled
from physgraph_usd.shot.report import RefineReport
from physgraph_usd.solver import deadline


@pytest.fixture
def gentle(tmp_path: Path) -> Path:
    """One frame shrinks the sheet to half its size: far to go, but steps get there."""
    return cloth_shot(tmp_path / "gentle.usdc", broken={3.0: 0.5})


def test_a_note_names_prim_time_code_and_figure(gentle: Path, tmp_path: Path):
    report = refine(gentle, tmp_path / "fine.usdc", steps=0)
    assert {entry["path"] for entry in report.unsettled} == {CLOTH}
    (said,) = [each for each in report.notes if "did not settle" in each]
    worst = max(report.unsettled, key=lambda entry: entry["remaining_move"])
    assert f" frames did not settle, <{CLOTH}> at time code {worst['time']:g} the least: " in said
    assert f"{worst['remaining_move']:.2g} edges" in said
    assert not [each for each in report.warnings if "settle" in each]
    assert report.exit_code == 0


@pytest.mark.parametrize(("steps", "code"), [(0, 3), (96, 0)])
def test_strict_counts_in_the_exit_code(gentle: Path, tmp_path: Path, steps: int, code: int):
    out = tmp_path / "fine.usdc"
    done = run("refine", gentle, "-o", out, "--level", 1, "--steps", steps, "--strict")
    assert (done.exit_code, out.is_file()) == (code, True)
    assert ("did not settle" in done.stderr) == (code == 3)


def entry(side: str, before: int, after: int) -> dict[str, Any]:
    measured = {"before": {"crossings": before, "inside": 0}, "after": {"crossings": after, "inside": 0}}
    return {"contact": {"cloth": measured} if side == "cloth" else {"bodies": {side: measured}}}


def told(name: str, frames: list[dict[str, Any]], *paths: str) -> list[str]:
    """The texts of a finding about garments in some frames."""
    report = RefineReport("s", None, {}, garments=[{"path": path} for path in paths], frames=frames)
    return list(map(str, texts(name, Facts(report=report))))


def frames_of(*entries: dict[str, Any]) -> list[dict[str, Any]]:
    return [{"time": time, "garments": [entry]} for time, entry in enumerate(entries, start=1)]


def test_a_finding_without_a_test_is_reported_somewhere():
    sources = [file.read_text("utf-8") for file in Path(physgraph_usd.__file__).parent.rglob("*.py")]
    for name, finding in FINDINGS.items():
        assert bool(finding.before) + bool(finding.after) + any(f'FINDINGS["{name}"]' in text for text in sources) == 1


class TestContact:
    def test_what_is_left_in_bodies_is_told_of_as_in_cloth_with_what_there_was(self):
        remedy = FINDINGS["contact"].remedy
        frames = frames_of(entry("/Body", 10, 1), entry("/Body", 1196, 174), entry("/Body", 9, 0))
        assert told("contact", frames, "/A") == [
            f"</A> at time code 2: 174 crossings with </Body> (1,196 in the subdivided cage) are left; {remedy}; "
            "also at time code 1"
        ]
        assert told("contact", frames_of(entry("cloth", 3, 1)), "/A") == [
            f"</A> at time code 1: 1 crossing of cloth (3 in the subdivided cage) is left; {remedy}"
        ]

    def test_of_garments_that_are_counted_together_all_are_named(self):
        frames = frames_of(entry("cloth", 3, 2) | {"together": ["/A", "/B"]})
        (said,) = told("contact", frames, "/A")
        assert "2 crossings of cloth (3 in the subdivided cage) are left, counted together with </B>; " in said
        assert told("contact", frames, "/B") == []

    def test_more_crossings_than_in_the_subdivided_cage_are_told_with_the_first_frame(self):
        cloth, body = entry("cloth", 1015, 1421), entry("/Body", 5, 5)
        both = {"contact": cloth["contact"] | body["contact"]}
        frames = [
            {"time": 1.0, "garments": [entry("cloth", 9, 9), entry("/Body", 0, 1)]},
            {"time": 2.0, "garments": [both, entry("/Body", 2, 1)]},
            {"time": 3.0, "garments": [entry("cloth", 9, 10), {}]},
            {"time": 4.0, "error": "no sample"},
        ]
        left = "crossings and vertices inside bodies are left"
        more = "in the subdivided cage: more than by subdivision alone; look at these frames"
        assert told("more", frames, "/A", "/B") == [
            f"</A> at time code 2: 1,426 {left}, 1,020 {more}; also at time code 3",
            f"</B> at time code 1: 1 {left}, 0 {more}",
        ]
        assert told("more", frames[:1], "/A") == []

    def test_cloth_that_is_its_smoothly_subdivided_cage_has_no_more_crossings_than_that(self, tmp_path: Path):
        """A tangled sheet, all given up: smooth, it crosses once more than with straight sides."""
        stage, points = new_stage(tmp_path / "s.usda", metres=0.05), sheet_points()
        add_mesh(stage, "/World/cloth", np.roll(points, 1, axis=0), np.split(sheet_faces()[1], 12))
        report = refine(Path(save(stage)), tmp_path / "f.usdc")
        counts = report.frames[0]["garments"][0]["contact"]["cloth"]
        assert counts["before"]["crossings"] == counts["after"]["crossings"] > 0
        assert texts("more", Facts(report=report)) == []

    def test_cloth_that_came_out_of_a_body_may_cross_it_more_often(self):
        body = entry("/Body", 1015, 1421)
        body["contact"]["bodies"]["/Body"]["before"]["inside"] = 1926
        assert told("more", frames_of(body), "/A") == []

    def test_it_is_the_last_line_of_a_run(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        more = replace(FINDINGS["more"], after=lambda _: [{}], sentence="crossings", remedy="")
        monkeypatch.setitem(FINDINGS, "more", more)
        shot = cloth_shot(tmp_path / "s.usdc", broken={3.0: 0.5})
        done = run("refine", shot, "-o", tmp_path / "f.usdc", "--level", 1, "--steps", 0, "--strict")
        *before, last = done.stderr.splitlines()
        assert (last, [line for line in before if "did not settle" in line] != []) == ("warning: crossings", True)

    @pytest.mark.parametrize(("after", "code"), [(0, 0), (10, 0), (11, 3)])
    def test_a_strict_run_leaves_a_tenth_at_most(self, after: int, code: int):
        for side in ("cloth", "/Body"):
            frames = [
                {"time": 1.0, "garments": [entry(side, 60, 0)]},
                {"time": 2.0, "garments": [entry(side, 40, after)]},
            ]
            report = RefineReport("s", None, {}, garments=[{"path": "/A"}], frames=frames)
            assert report.exit_code == 0
            report.strict = True
            assert report.exit_code == code


def test_a_frame_above_its_input_is_told_of():
    """A guide of 1e6 moves with a cage that carried detail does not follow at once."""

    def energies(before: float, after: float) -> dict[str, Any]:
        return {"energy_joules": {"input": {"stretch": before}, "output": {"stretch": after}}}

    found = {1.0: energies(1e-3, 1e-3), 2.0: energies(1.9e-5, 3.2e-4), 3.0: energies(1e-3, 1.1e-3), 4.0: {}}
    frames = [{"time": time, "garments": [entry]} for time, entry in found.items()]
    (said,) = told("energy", frames, "/A")
    assert said.startswith("2 frames ended with more energy than the upsampled cage, </A> at time code 2: 0.00032 J")


@pytest.fixture
def ends_at_look(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Let the time be over from the n-th look at the clock on."""

    def end(looks: int) -> None:
        count = itertools.count()
        clock = SimpleNamespace(process_time=lambda: 1e9 * max(next(count) - looks, 0))
        monkeypatch.setattr(deadline, "time", clock)

    return end


def test_a_frame_over_its_limit_is_written_and_named(tmp_path: Path):
    shot, out = cloth_shot(tmp_path / "s.usda", times=(1.0, 2.0)), tmp_path / "fine.usdc"
    report = refine(shot, out, frame_limit=1e-6, strict=True)
    assert sample_times(out) == (1.0, 2.0)
    assert faults(out, shot) == []
    assert [(each["path"], each["time"], each["stopped"]) for each in report.unsettled] == [
        (CLOTH, 1.0, "time limit"),
        (CLOTH, 2.0, "time limit"),
    ]
    sets = "--frame-limit sets it, in processor time, on cuda in wall time"
    said = f"was not solved to its end: it reached its limit of time; {sets}; also at time code 2"
    assert [warning for warning in report.warnings if said in warning]
    assert report.exit_code == 3
    assert [frame["garments"][0]["time_limit"] for frame in report.frames] == [1e-6, 1e-6]


def test_held_cloth_is_solved_on_after_a_frame_that_was_stopped(tmp_path: Path):
    shot = cloth_shot(tmp_path / "s.usda", times=(1.0, 2.0, 3.0), frozen=True)
    for limit, reused in ((1e-6, [False, False]), (None, [True, True])):
        report = refine(shot, tmp_path / f"{limit}.usdc", frame_limit=limit)
        starts = [str(frame["garments"][0]["start"]) for frame in report.frames[1:]]
        assert ["reused" in start for start in starts] == reused


def test_a_limit_counts_what_the_processor_does_and_on_a_card_what_passes():
    for device, waited in (("cpu", False), ("cuda", True), ("cuda:1", True)):
        with deadline.ends_after(0.05, deadline.clock_of(device)):
            time.sleep(0.06)
            assert deadline.is_over() == waited
            began = time.process_time()
            while time.process_time() < began + 0.06:
                pass
            assert deadline.is_over()
    assert not deadline.is_over()


def test_nothing_newly_crosses_wherever_a_frame_is_stopped(
    sample: Callable[[str], Path], tmp_path: Path, ends_at_look: Callable[[int], None]
):
    """Three layers that touch, stopped at looks spread over two frames; without a stop there are 24 to 29 looks."""
    shot = sample("layers")
    for looks in (3, 20):
        ends_at_look(looks)
        report = refine(shot, tmp_path / f"{looks}.usdc", level=0, frames=(1.0, 2.0))
        assert [each["stopped"] for each in report.unsettled if each["time"] == 2.0] == ["time limit"] * 3
        for frame in report.frames:
            cloth = frame["garments"][0]["contact"]["cloth"]
            assert cloth["after"]["crossings"] <= cloth["before"]["crossings"]


def test_a_frame_that_reached_its_limit_before_any_level_is_said_in_words():
    entry = {"start": "given up", "levels": [], "time_limit": 0.01}
    state = unsettled(entry, 2e-3)
    assert state
    assert in_words(state) == "no level was solved (stopped by time limit)"
