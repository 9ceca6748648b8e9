"""A ceiling on a frame's time: the frame stops where it stands, valid and named."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from shots import CLOTH, cloth_shot, faults, refine, sample_times

from physgraph_usd.solver import deadline


@pytest.fixture
def ends_at_look(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Let the time be over from the n-th look at the clock on."""

    def end(looks: int) -> None:
        count = itertools.count()
        clock = SimpleNamespace(perf_counter=lambda: 1e9 * max(next(count) - looks, 0))
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
    said = "was not solved to its end: it reached its limit of time; see --frame-limit; also at time code 2"
    assert [warning for warning in report.warnings if said in warning]
    assert report.exit_code == 3
    assert [frame["garments"][0]["time_limit"] for frame in report.frames] == [1e-6, 1e-6]


def test_nothing_newly_crosses_wherever_a_frame_is_stopped(
    sample: Callable[[str], Path], tmp_path: Path, ends_at_look: Callable[[int], None]
):
    """Three layers that touch, stopped at looks spread over two frames; without a stop there are 40 to 50 looks."""
    shot = sample("layers")
    for looks in (3, 20, 40):
        ends_at_look(looks)
        report = refine(shot, tmp_path / f"{looks}.usdc", level=0, frames=(1.0, 2.0))
        assert [each["stopped"] for each in report.unsettled if each["time"] == 2.0] == ["time limit"] * 3
        for frame in report.frames:
            cloth = frame["garments"][0]["contact"]["cloth"]
            assert cloth["after"]["crossings"] <= cloth["before"]["crossings"]


def test_no_frame_is_stopped_without_being_asked(tmp_path: Path):
    report = refine(cloth_shot(tmp_path / "s.usda"), tmp_path / "fine.usdc")
    assert not [entry for frame in report.frames for entry in frame["garments"] if "time_limit" in entry]
