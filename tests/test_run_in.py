"""What comes before the first frame of a part of a shot: it is announced, followed and recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from shots import command

from physgraph_usd.errors import NOTICE
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot import run_in
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.shot.run_in import RunIn

TIMES = tuple(float(time) for time in range(1, 11))
FRAME: Any = object()


class Clock:
    """A clock that stands still between the steps of a test."""

    def __init__(self) -> None:
        self.now = 100.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(run_in, "clock", found)
    return found


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == NOTICE]


def test_what_is_left_falls_as_the_search_and_the_walk_go_on(clock: Clock, caplog: pytest.LogCaptureFixture):
    """Frame 10: nothing comes clean, so the search tries 10, 9, 8, 6, 2 and 1, and the walk goes from 2 to 10."""
    caplog.set_level(NOTICE, logger="physgraph_usd")
    reader = RunIn(lambda time: FRAME, TIMES, "shot")
    assert reader(10.0) is FRAME
    assert (told(caplog), reader.seconds) == ([], 0.0)
    most, left = list[int](), list[float]()
    for time in (10.0, 9.0, 8.0, 6.0, 2.0, 1.0, *TIMES[1:]):
        reader(time)
        most.append(sum(reader.most))
        left.append(reader.left)
        clock.now += 4.0 if len(most) <= 6 else 1.0
    assert most == list(range(15, 0, -1))
    assert left[1] == pytest.approx(5 * 4.0 + 9 * run_in.OF_COLD * 4.0)
    assert left[7:] == pytest.approx([float(cages) for cages in range(8, 0, -1)])
    assert reader.seconds == pytest.approx(6 * 4.0 + 9 * 1.0)
    first, *later = told(caplog)
    assert first.startswith("time code 10 needs a run-in, for its cage crosses itself: ")
    assert first.endswith("at most 15 times")
    assert [text.partition(",")[0] for text in later] == [
        "run-in: 3 of at most 15 cages solved",
        "run-in: 6 of at most 15 cages solved",
    ]


def test_a_cage_that_comes_clean_ends_the_search(clock: Clock):
    reader = RunIn(lambda time: FRAME, TIMES, "shot")
    for time in (10.0, 10.0, 9.0, 8.0, 9.0, 10.0):
        reader(time)
    assert reader.most == (0, 1)


def test_the_report_and_the_command_say_what_the_run_in_took(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    shot = write_sample("skirt", tmp_path)
    caplog.set_level(NOTICE, logger="physgraph_usd")
    options = RefineOptions(frames=(36.0, 37.0), level=0, steps=2)
    first, second = refine_shot(shot, tmp_path / "a.usdc", options).frames
    assert first["run_in_ms"] > 0
    assert "run_in_ms" not in second
    assert [text for text in told(caplog) if text.startswith("time code 36 needs a run-in")]
    assert "run_in_ms" not in refine_shot(shot, tmp_path / "b.usdc", RefineOptions(frames=(1, 1), level=0)).frames[0]


def test_a_chunk_says_that_its_pre_roll_comes_first(tmp_path: Path):
    shot = write_sample("swatch", tmp_path)
    done = command("refine", shot, "-o", tmp_path / "chunk", "--frames", "5:6", "--preroll", 3, "--level", 0)
    assert done.returncode == 0, done.stderr
    assert "before time code 5 the pre-roll is solved: 3 frames" in done.stderr
    again = command("refine", shot, "-o", tmp_path / "first", "--frames", "1:2", "--preroll", 3, "--level", 0)
    assert "pre-roll" not in again.stderr
