"""What refining costs is said before it begins, what cannot fit is refused, and memory does not grow with frames."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from cloth import sheet
from sheets import garment_of
from shots import cloth_shot, command, fine, refine, run

from physgraph_usd.errors import GarmentError
from physgraph_usd.shot.estimate import Forecast, cannot_fit, estimate
from physgraph_usd.shot.refine import inspect_shot


@pytest.mark.parametrize("kind", ["quads", "triangles", "ngons", "mixed"])
def test_the_number_of_fine_vertices_is_exact(tmp_path: Path, kind: str):
    shot = cloth_shot(tmp_path / "shot.usda", times=(1.0,), kind=kind)
    report = refine(shot, tmp_path / "out.usdc", level=2)
    assert report.estimate["fine_vertices"] == len(fine(shot, tmp_path / "out.usdc", 1.0))


def test_dry_runs_and_inspect_say_what_it_costs(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usda")
    dry = refine(shot, tmp_path / "out.usdc", level=3, dry_run=True)
    assert inspect_shot(shot, level=3)["estimate"] == dry.estimate
    assert list(dry.estimate) == ["fine_vertices", "memory_mb", "layer_mb"]
    done = run("refine", shot, "-o", tmp_path / "out.usdc", "--level", 1, "--dry-run")
    assert json.loads(done.stdout)["estimate"]["fine_vertices"] == 117


@pytest.mark.slow
def test_the_estimate_is_within_a_factor_of_two_of_what_a_run_takes(tmp_path: Path):
    """In a process of its own, whose memory is counted."""
    shot = cloth_shot(tmp_path / "shot.usda", size=(60, 40), times=(1.0, 2.0))
    words = ("refine", shot, "-o", tmp_path / "out.usdc", "--level", 2, "--steps", 3)
    done = command(*words, "--report", tmp_path / "report.json")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert 0.5 < report["estimate"]["memory_mb"] / report["peak_memory_mb"] < 2.0
    assert 0.5 < report["estimate"]["layer_mb"] / ((tmp_path / "out.usdc").stat().st_size / 1e6) < 2.0


def test_a_long_run_says_after_three_frames_when_it_will_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    whole = r"3 of 48 frames in 30 s: all in about 8 min more, at \d\d:\d\d"
    assert re.fullmatch(whole, messages(48, 1, [10.0, 20.0, 30.0])[-1])
    assert "about 4 min more" in messages(48, 2, [10.0, 20.0, 30.0])[-1]
    assert "about 4 min more" in messages(48, 1, [20.0, 25.0, 30.0])[-1]  # The first frame is no measure of the others.
    assert messages(48, 1, [0.1, 0.2, 0.3]) == [""] * 3
    monkeypatch.setattr("physgraph_usd.shot.estimate.LONG_RUN", 0.0)
    shot = cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0, 3.0, 4.0, 5.0))
    done = run("refine", shot, "-o", tmp_path / "out.usdc", "--level", 0)
    assert done.exit_code == 0, done.output
    assert "3 of 5 frames in " in done.output


def messages(count: int, workers: int, ends: Sequence[float]) -> list[str]:
    """The forecasts after frames that end at these times [s]."""
    forecast = Forecast(count, workers)
    return [forecast.after(end) for end in ends]


def test_a_forecast_is_revised_where_frames_become_slower():
    """Ten frames of 10 s and ten of 40 s: half of the run is in the frames that the first forecast did not know."""
    ends = [10.0 * k for k in range(1, 11)] + [100.0 + 40.0 * k for k in range(1, 11)]
    found = [text for text in messages(20, 1, ends) if text]
    assert [text.partition(" frames")[0] for text in found] == ["3 of 20", "11 of 20", "14 of 20"]
    assert "about 3 min more" in found[0]
    assert "about 4 min more" in found[-1]
    assert len([text for text in messages(20, 1, [10.0 * k for k in range(1, 21)]) if text]) == 1


def test_what_cannot_fit_is_refused_with_the_level_that_can():
    garment = garment_of(*sheet(20, 20, kind="quads"))
    there = estimate([garment], [3]).memory + 1.0
    assert cannot_fit([garment], [3], memory=there) is None
    error = cannot_fit([garment], [5], memory=there)
    assert isinstance(error, GarmentError)
    assert str(error).startswith("</World/Sheet>: level 5 makes 410,881 fine vertices, which need about ")
    assert str(error).endswith("; use --level 3")
    assert "fewer --workers" in str(cannot_fit([garment], [3], memory=there, frames=8, workers=2))
    assert str(cannot_fit([garment], [3], memory=1e6)).endswith("reduce the cage")


def test_what_cannot_fit_is_refused_before_anything_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("physgraph_usd.shot.estimate.memory_there", lambda: 1e9)
    shot = cloth_shot(tmp_path / "shot.usda", times=(1.0,), size=(63, 62))
    assert "use --level " in inspect_shot(shot, level=5)["problem"]
    for dry_run in (False, True):
        with pytest.raises(GarmentError, match=r"</World/cloth>: level 5 makes 4,003,745 fine.*; use --level \d"):
            refine(shot, tmp_path / "out.usdc", level=5, dry_run=dry_run)
    assert not (tmp_path / "out.usdc").exists()


def peak(folder: Path, frames: int) -> float:
    """Peak resident memory [MB] of a refine in a process of its own."""
    report, times = folder / f"{frames}.json", tuple(map(float, range(frames)))
    shot = cloth_shot(folder / f"shot{frames}.usdc", times=times, size=(156, 40))
    done = command("refine", shot, "-o", folder / f"{frames}.fine.usdc", "--level", 2, "--report", report)
    assert done.returncode == 0, done.stderr
    told = json.loads(report.read_text())
    assert len(told["frames"]) == frames
    return told["peak_memory_mb"]


@pytest.mark.slow
def test_240_frames_of_100k_fine_points_stay_under_2_gib(
    tmp_path: Path, record_property: Callable[[str, object], None]
):
    """Kept in single precision, 216 frames of points alone would be 259 MB."""
    few, many = peak(tmp_path, 24), peak(tmp_path, 240)
    record_property("peak_memory_mb", {24: few, 240: many})
    assert many < 2048.0, (few, many)
    assert many < 1.05 * few, (few, many)
