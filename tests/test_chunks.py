"""Chunks: seams that do not show, order, and what happens when a process dies."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloth import rms
from frame_solvers import Allocating, Broken, Counting, Dying, Exhausted, Failing, Killed, Raising, Short
from hypothesis import given
from hypothesis import strategies as st
from shots import EDGE, cloth_shot, faults, fine, refine, sample_times

from physgraph_usd.errors import GarmentError, LayerError, PhysGraphError, SolveError, UsageError
from physgraph_usd.shot.chunks import PREROLL, chunks_of, solve_in_chunks
from physgraph_usd.shot.frames import FrameFolder, Outcome
from physgraph_usd.shot.processes import Call, memory_is_named

SEAM = 5e-2
"""Largest difference that the number of workers makes, RMS over a frame, in fine edge lengths; 0.036 was measured."""
LONG = tuple(float(time) for time in range(1, 25))


TIMES = [float(t) for t in range(8)]


def solve(solver: Callable[..., Iterator[Outcome]], folder: Path, *, workers: int, **options: Any) -> list[Outcome]:
    """Solve eight frames; each says in its points how many frames its process had solved before."""
    with FrameFolder(folder, {}, **options) as frames:
        return list(solve_in_chunks(solver, TIMES, frames, workers=workers, preroll=3))


def before(outcomes: Sequence[Outcome]) -> list[int]:
    return [int(np.asarray(outcome.points[0])[0, 0]) for outcome in outcomes]


def interrupt(folder: Path, solver: Counting, finished: Iterable[int]) -> None:
    """A run that is interrupted when it has finished some frames."""
    with FrameFolder(folder, {"level": 2}) as frames:
        for index in finished:
            frames.write(index, next(iter(solver([float(index)]))))
        raise KeyboardInterrupt


@given(missing=st.sets(st.integers(0, 60)), workers=st.integers(1, 80))
def test_chunks_cover_what_is_missing_once_evenly(missing: set[int], workers: int):
    shares = chunks_of(sorted(missing), workers)
    assert [index for share in shares for part in share for index in part] == sorted(missing)
    sizes = [sum(map(len, share)) for share in shares]
    assert len(shares) <= workers
    assert not sizes or max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize(
    ("count", "workers", "times"), [(24, 2, 1.33), (24, 4, 2.0), (240, 2, 1.9), (240, 4, 3.6), (24, 24, 24 / 7)]
)
def test_the_longest_process_says_how_much_quicker_a_shot_can_be(count: int, workers: int, times: float):
    """How many times as fast N frames are in W processes: N / (N / W + R), as docs/solver.md has it."""
    parts = [part for share in chunks_of(range(count), workers) for part in share]
    longest = max(part.stop - max(0, part.start - PREROLL) for part in parts)
    assert longest == count / workers + PREROLL
    assert count / longest == pytest.approx(times, rel=0.02)


def test_order_and_preroll(tmp_path: Path):
    outcomes = solve(Counting(), tmp_path / "f", workers=2)
    assert [outcome.time for outcome in outcomes] == TIMES
    assert before(outcomes) == [0, 1, 2, 3, 3, 4, 5, 6]
    assert [outcome.reused for outcome in outcomes] == [(n % 2 == 1,) for n in (0, 1, 2, 3, 3, 4, 5, 6)]
    assert os.getpid() not in {outcome.record["pid"] for outcome in outcomes}


def test_one_worker_stays_in_this_process(tmp_path: Path):
    assert {outcome.record["pid"] for outcome in solve(Counting(), tmp_path / "f", workers=1)} == {os.getpid()}


@pytest.mark.parametrize("workers", [1, 2])
def test_a_frame_that_failed_is_handed_on_and_ends_nothing(tmp_path: Path, workers: int):
    outcomes = solve(Failing(), tmp_path / "f", workers=workers)
    assert [outcome.time for outcome in outcomes if not outcome.points] == [5.0]
    assert len(outcomes) == 8


@pytest.mark.parametrize(
    ("solver", "error", "said"),
    [
        (Dying(), SolveError, r"a worker process died \(exit code 9\)"),
        (Killed(), SolveError, r"died \(SIGKILL\), perhaps for lack of memory"),
        (Raising(), PhysGraphError, "unexpected ValueError: a bug"),
        (Exhausted(), SolveError, "out of memory; a lower --level or fewer --workers needs less"),
        (Allocating(), SolveError, "out of memory; a lower --level or fewer --workers needs less"),
        (Broken(), GarmentError, "</World/cloth> at time code 5: torn"),
        (Short(), SolveError, "without the result of time code 3"),
    ],
)
def test_what_ends_a_worker_is_named(tmp_path: Path, solver: Counting, error: type[PhysGraphError], said: str):
    with pytest.raises(error, match=said):
        solve(solver, tmp_path / "f", workers=2, keep=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "said",
    [
        "Failed to allocate 21600000000 bytes on device 'cuda:0'",
        "CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total capacity of 79.10 GiB",
        "Warp CUDA error 2: out of memory (in function wp_alloc_device_default)",
    ],
)
def test_what_a_gpu_lacks_may_be_there_without_it(said: str):
    with pytest.raises(SolveError, match="out of memory on the CUDA device; a lower --level or --device cpu"):
        with memory_is_named():
            raise RuntimeError(said)


class Late:
    """A function that ran on another machine, whose files are seen here only after a while."""

    lag, ready = 5.0, True

    def __init__(self, function: Callable[..., Any], *args: Any) -> None:
        self._timer = threading.Timer(0.3, function, args)
        self._timer.start()

    def result(self) -> None: ...

    def ask_to_end(self) -> None: ...

    def end(self) -> None:
        self._timer.join()


@pytest.mark.skipif(not hasattr(os, "waitid"), reason="no other system tells of a stopped process")
def test_a_worker_that_is_stopped_is_told_of_once_and_ends_all_the_same(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr("physgraph_usd.shot.processes.PATIENCE_SECONDS", 0.05)
    call = Call(time.sleep, 60.0)
    (pid,) = (child.pid for child in multiprocessing.active_children())
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    for _ in range(10):
        assert not call.ready
        time.sleep(0.02)
    monkeypatch.undo()
    call.end()
    told = [record.message for record in caplog.records]
    assert told == [f"the worker process {pid} is stopped and the run waits; kill -CONT {pid} lets it go on"]
    assert not multiprocessing.active_children()


def test_files_that_are_seen_late_are_waited_for(tmp_path: Path):
    with FrameFolder(tmp_path / "f", {}) as frames:
        outcomes = list(solve_in_chunks(Counting(), TIMES, frames, workers=1, start=Late))
    assert before(outcomes) == list(range(8))


def test_a_task_that_outlasts_its_run_writes_nothing_into_another(tmp_path: Path):
    with FrameFolder(tmp_path / "f", {"level": 2}) as frames:
        outlasting = pickle.loads(pickle.dumps(frames))
    outcome = next(iter(Counting()([0.0])))
    with pytest.raises(LayerError):
        outlasting.write(0, outcome)
    with FrameFolder(tmp_path / "f", {"level": 3}) as other:
        with pytest.raises(LayerError, match="another run's by now"):
            outlasting.write(0, outcome)
        assert other.read(0, 0.0) is None


@pytest.mark.parametrize("workers", [1, 2])
def test_frames_that_two_processes_solved_come_with_both(tmp_path: Path, workers: int):
    """In parts of the way that grow evenly, and only as far back as the last seam."""
    outcomes = solve(Counting(), tmp_path / "a", workers=workers)
    leads = {outcome.time: outcome.lead for outcome in outcomes if outcome.lead}
    if workers == 1:
        assert not leads
        return
    assert {time: (lead.seam, lead.weight) for time, lead in leads.items()} == {1: (4, 0.25), 2: (4, 0.5), 3: (4, 0.75)}
    assert [int(np.asarray(lead.outcome.points[0])[0, 0]) for lead in leads.values()] == [0, 1, 2]
    near = {outcome.time: outcome.lead for outcome in solve(Counting(), tmp_path / "b", workers=8) if outcome.lead}
    assert {time: (lead.seam, lead.weight) for time, lead in near.items()} == {t: (t + 1, 0.5) for t in range(7)}


class TestKeptFrames:
    """Frames that a run had finished when it was interrupted."""

    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        """The frames 0, 1, 4 of a run whose fifth frame ended it."""
        with pytest.raises(KeyboardInterrupt):
            interrupt(tmp_path / "f", Counting(), (0, 1, 4))
        return tmp_path / "f"

    @pytest.mark.parametrize("workers", [1, 2])
    def test_are_used_and_the_others_are_solved_after_a_preroll(self, folder: Path, workers: int):
        with FrameFolder(folder, {"level": 2}, resume=True) as frames:
            outcomes = list(solve_in_chunks(Counting(), TIMES, frames, workers=workers, preroll=3))
        assert [outcome.time for outcome in outcomes] == TIMES
        assert before(outcomes)[:5] == [0, 0, 2, 3, 0]
        assert before(outcomes)[5] == 3
        assert not folder.exists()

    def test_are_solved_anew_without_resume(self, folder: Path):
        frames = FrameFolder(folder, {"level": 2})
        assert (frames.kept, frames.dropped) == (frozenset(), 3)
        assert not list(folder.glob("*.npz"))

    def test_of_another_run_are_not_dropped_unasked(self, folder: Path):
        for resume, drop in ((False, False), (True, False), (True, True)):
            with pytest.raises(UsageError, match=r"holds 3 finished frames of a run with other level; .* --overwrite"):
                FrameFolder(folder, {"level": 3}, resume=resume, drop=drop)
        assert len(list(folder.glob("*.npz"))) == 3
        assert FrameFolder(folder, {"level": 3}, drop=True).dropped == 0
        assert not list(folder.glob("*.npz"))

    def test_that_are_not_whole_are_solved_again(self, folder: Path):
        (folder / "1.npz").write_bytes((folder / "1.npz").read_bytes()[:-40])
        assert FrameFolder(folder, {"level": 2}, resume=True).kept == {0, 4}

    @pytest.mark.parametrize(
        "points", [np.full((3, 3), np.nan), np.zeros((2, 3)), np.zeros((3, 3), np.int64), np.zeros((3, 2))]
    )
    def test_that_no_kernel_may_see_are_named(self, tmp_path: Path, points: np.ndarray):
        with FrameFolder(tmp_path / "f", {}, counts=[3]) as frames:
            frames.write(0, Outcome(0.0, (points,), (False,), {}))
            with pytest.raises(LayerError, match=r"0\.npz is damaged \(points of shape"):
                frames.read(0, 0.0)
            frames.write(0, Outcome(0.0, (np.zeros((3, 3)),), (False,), {}))
            assert frames.read(0, 0.0) is not None

    def test_that_are_damaged_are_named(self, folder: Path):
        data = (folder / "1.npz").read_bytes()
        (folder / "1.npz").write_bytes(data[:150] + b"\xff" * 40 + data[190:])
        frames = FrameFolder(folder, {"level": 2}, resume=True)
        with pytest.raises(LayerError, match=r"1\.npz is damaged"):
            list(solve_in_chunks(Counting(), TIMES, frames, workers=1))

    def test_a_folder_of_the_users_is_left_alone(self, tmp_path: Path):
        (tmp_path / "f").mkdir()
        (tmp_path / "f" / "notes.txt").write_text("mine")
        with pytest.raises(UsageError, match="no folder of finished frames"):
            FrameFolder(tmp_path / "f", {}, drop=True)
        assert (tmp_path / "f" / "notes.txt").read_text() == "mine"

    def test_failed_frames_are_not_kept(self, tmp_path: Path):
        with pytest.raises(KeyboardInterrupt):
            interrupt(tmp_path / "f", Failing(), range(8))
        assert FrameFolder(tmp_path / "f", {"level": 2}, resume=True).kept == {0, 1, 2, 3, 4, 6, 7}
        assert not list((tmp_path / "f").glob("*.failed.npz")), "they are tried again"


def layer_with(shot: Path, folder: Path, **options: object) -> Path:
    folder.mkdir()
    report = refine(shot, folder / "fine.usdc", **options)
    assert report.exit_code == 0
    return folder / "fine.usdc"


class TestLayers:
    def test_s34_any_number_of_workers_gives_the_same_bytes_without_history(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usdc")
        layers = [layer_with(shot, tmp_path / str(n), workers=n, temporal="off") for n in (1, 2)]
        assert layers[0].read_bytes() == layers[1].read_bytes()
        assert faults(layers[0], shot) == []

    @pytest.mark.slow
    def test_s35_equal_frames_give_the_same_bytes_across_a_seam(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usdc", frozen=True)
        layers = [layer_with(shot, tmp_path / str(n), workers=n, temporal="off") for n in (1, 2)]
        assert layers[0].read_bytes() == layers[1].read_bytes()

    def test_s34_the_same_command_gives_the_same_bytes(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usdc")
        assert len({layer_with(shot, tmp_path / str(n)).read_bytes() for n in range(3)}) == 1

    @pytest.mark.parametrize("temporal", ["tether", pytest.param("warm", marks=pytest.mark.slow)])
    def test_s34_seams_do_not_show_with_history(self, tmp_path: Path, temporal: str):
        """Less than a twentieth of a fine edge, RMS, is left at a seam, and it fades; cloth moves far more."""
        shot = cloth_shot(tmp_path / "shot.usdc", times=LONG)
        one, two = (layer_with(shot, tmp_path / str(n), workers=n, temporal=temporal) for n in (1, 2))
        apart = [rms(fine(shot, one, time) - fine(shot, two, time)) / (EDGE / 2) for time in LONG]
        assert max(apart[:6]) == 0.0
        assert max(apart) < SEAM, apart
        off = {t: fine(shot, two, t) - fine(shot, one, t) for t in LONG}
        steps = [rms(off[b] - off[a]) / (EDGE / 2) for a, b in pairwise(LONG)]
        assert max(steps) < max(apart), steps
        moves = [rms(fine(shot, one, a) - fine(shot, one, b)) / (EDGE / 2) for a, b in pairwise(LONG)]
        assert min(moves) > 2 * max(apart)
        assert sample_times(one) == sample_times(two) == LONG

    @pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
    def test_a_resumed_run_goes_on_as_if_it_had_not_been_interrupted(self, tmp_path: Path, workers: int):
        """What the pre-roll leaves where it goes on is no more than what it leaves between two workers."""
        shot, out = cloth_shot(tmp_path / "shot.usdc", times=LONG), tmp_path / "fine.usdc"

        def interrupt(done: int, _: int) -> None:
            if done == 12:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            refine(shot, out, progress=interrupt, workers=workers)
        report = refine(shot, out, resume=True)
        (said,) = [warning for warning in report.warnings if "of 24 frames are those of a run" in warning]
        assert said.startswith("12 of 24") or workers > 1
        assert "each stretch after 6 frames solved again" in said
        assert [frame["time"] for frame in report.frames] == list(LONG)
        whole = layer_with(shot, tmp_path / "whole")
        apart = [rms(fine(shot, whole, time) - fine(shot, out, time)) / (EDGE / 2) for time in LONG]
        assert max(apart[:6]) == 0.0
        assert max(apart) < SEAM, apart
        assert faults(out, shot) == []
