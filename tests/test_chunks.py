"""Chunks: seams that do not show, order, and what happens when a process dies."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from cloth import rms
from frame_solvers import Counting, Dying, Failing, Raising, Short
from hypothesis import given
from hypothesis import strategies as st
from shots import EDGE, cloth_shot, faults, fine, refine, sample_times

from physgraph_usd.chunks import RUN_UP, chunks_of, solve_in_chunks
from physgraph_usd.errors import SolveError

SEAM = 5e-2
"""Largest difference that the number of workers makes, RMS over a frame, in fine edge lengths; 0.036 was measured."""
LONG = tuple(float(time) for time in range(1, 25))


@given(count=st.integers(0, 60), workers=st.integers(1, 80))
def test_chunks_cover_all_times_once_evenly(count: int, workers: int):
    parts = chunks_of(list(range(count)), workers)
    assert [index for a, b in parts for index in range(a, b)] == list(range(count))
    sizes = [b - a for a, b in parts]
    assert len(parts) <= workers
    assert not sizes or max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize(
    ("count", "workers", "times"), [(24, 2, 1.33), (24, 4, 2.0), (240, 2, 1.9), (240, 4, 3.6), (24, 24, 24 / 7)]
)
def test_the_longest_process_says_how_much_quicker_a_shot_can_be(count: int, workers: int, times: float):
    """The figures of docs/solver.md, by N / (N / W + R)."""
    longest = max(last - max(0, first - RUN_UP) for first, last in chunks_of(list(range(count)), workers))
    assert longest == count / workers + RUN_UP
    assert count / longest == pytest.approx(times, rel=0.02)


def test_order_and_run_up():
    times = [float(t) for t in range(8)]
    outcomes = list(solve_in_chunks(Counting(), times, workers=2, run_up=3))
    assert [outcome.time for outcome in outcomes] == times
    assert [int(np.asarray(outcome.points[0])[0, 0]) for outcome in outcomes] == [0, 1, 2, 3, 3, 4, 5, 6]
    assert [outcome.reused for outcome in outcomes] == [(n % 2 == 1,) for n in (0, 1, 2, 3, 3, 4, 5, 6)]
    assert os.getpid() not in {outcome.record["pid"] for outcome in outcomes}


def test_one_worker_stays_in_this_process():
    outcomes = list(solve_in_chunks(Counting(), [1.0, 2.0], workers=1))
    assert {outcome.record["pid"] for outcome in outcomes} == {os.getpid()}


def test_a_frame_that_failed_is_handed_on_and_ends_nothing():
    outcomes = list(solve_in_chunks(Failing(), [float(t) for t in range(8)], workers=2))
    assert [outcome.time for outcome in outcomes if not outcome.points] == [5.0]
    assert len(outcomes) == 8


def test_a_process_that_dies_is_a_clear_error():
    with pytest.raises(SolveError, match="a worker process died"):
        list(solve_in_chunks(Dying(), [float(t) for t in range(8)], workers=2))


def test_a_bug_in_a_worker_is_not_hidden():
    with pytest.raises(ValueError, match="a bug"):
        list(solve_in_chunks(Raising(), [float(t) for t in range(8)], workers=2))


def test_a_worker_that_ends_early_is_named():
    with pytest.raises(SolveError, match="without the result of time code 3"):
        list(solve_in_chunks(Short(), [float(t) for t in range(8)], workers=2))


def test_no_folder_is_left(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    list(solve_in_chunks(Counting(), [1.0, 2.0], workers=2))
    next(solve_in_chunks(Counting(), [1.0, 2.0], workers=2))
    assert not list(tmp_path.iterdir())


def layer_with(shot: Path, folder: Path, **options: object) -> Path:
    folder.mkdir()
    report = refine(shot, folder / "fine.usdc", **options)
    assert report.exit_code == 0
    return folder / "fine.usdc"


class TestLayers:
    def test_s34_any_number_of_workers_gives_the_same_bytes_without_history(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usdc")
        layers = [layer_with(shot, tmp_path / str(n), workers=n, temporal="off") for n in (1, 3)]
        assert layers[0].read_bytes() == layers[1].read_bytes()
        assert faults(layers[0], shot) == []

    def test_s35_equal_frames_give_the_same_bytes_across_a_seam(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usdc", frozen=True)
        layers = [layer_with(shot, tmp_path / str(n), workers=n, temporal="off") for n in (1, 2)]
        assert layers[0].read_bytes() == layers[1].read_bytes()

    def test_s34_the_same_command_gives_the_same_bytes(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usdc")
        assert len({layer_with(shot, tmp_path / str(n)).read_bytes() for n in range(3)}) == 1

    @pytest.mark.parametrize("temporal", ["tether", pytest.param("warm", marks=pytest.mark.slow)])
    def test_s34_seams_do_not_show_with_history(self, tmp_path: Path, temporal: str):
        """The run-up leaves less at a seam than a twentieth of a fine edge, RMS, and it fades; cloth moves far more."""
        shot = cloth_shot(tmp_path / "shot.usdc", times=LONG)
        one, two = (layer_with(shot, tmp_path / str(n), workers=n, temporal=temporal) for n in (1, 2))
        apart = [rms(fine(shot, one, time) - fine(shot, two, time)) / (EDGE / 2) for time in LONG]
        assert max(apart[:12]) == 0.0
        assert max(apart) < SEAM, apart
        assert np.mean(apart[-4:]) < np.mean(apart[12:16]), apart[12:]
        moves = [rms(fine(shot, one, a) - fine(shot, one, b)) / (EDGE / 2) for a, b in pairwise(LONG)]
        assert min(moves) > 2 * max(apart)
        assert sample_times(one) == sample_times(two) == LONG
