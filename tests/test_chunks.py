"""The frames of a shot in several processes: seams that do not show, and frames that an interrupted run finished."""

from __future__ import annotations

import os
import pickle
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloth import rms
from frame_solvers import counting
from shots import EDGE, cloth_shot, faults, fine, interrupted, refine, run, sample_times

from physgraph_usd.errors import LayerError, SolveError
from physgraph_usd.shot.chunks import solve_in_chunks
from physgraph_usd.shot.frames import FrameFolder
from physgraph_usd.shot.workers import cores, memory_is_named, result_of, separate_processes
from physgraph_usd.solver.mesh.kernels import cards_for

SEAM = 5e-2
"""Largest difference that the number of workers makes, RMS over a frame, in fine edge lengths; 0.036 was measured."""
LONG = tuple(float(time) for time in range(1, 25))


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


def test_processes_share_out_cards_and_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "6")
    with separate_processes(3, cards=["0", "2"]) as start:
        calls = [start(os.getenv, name) for name in ("CUDA_VISIBLE_DEVICES",) * 3 + ("OMP_NUM_THREADS",)]
        *cards, threads = [result_of(call) for call in calls]
    assert sorted(cards) in (["0", "0", "2"], ["0", "2", "2"])
    assert threads == str(max(1, cores() // 3))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    assert cards_for("cuda") == cards_for("auto") == ["4", "7"]
    assert cards_for("cuda:1") == cards_for("cpu") == []


class TestFarmFolder:
    """Workers of other machines share the folder of finished frames over a network."""

    def test_files_that_are_seen_late_are_waited_for(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        timers: list[threading.Timer] = []

        def start(*call: Any) -> Future[None]:
            timers.append(threading.Timer(0.3 if len(timers) < 2 else 60.0, call[0], call[1:]))
            timers[-1].start()
            done: Future[None] = Future()
            done.set_result(None)
            return done

        times = [float(time) for time in range(8)]
        with FrameFolder(tmp_path / "f", {}) as frames:
            results = list(
                solve_in_chunks(counting, times, frames, workers=2, preroll=3, start=start, movers=None, warn=print)
            )
        assert [int(np.asarray(result.garments[0].points)[0, 0]) for result in results] == [0, 1, 2, 3, 3, 4, 5, 6]
        monkeypatch.setattr("physgraph_usd.shot.chunks.LATE_SECONDS", 0.1)
        with FrameFolder(tmp_path / "f", {}) as frames, pytest.raises(SolveError, match="the result of time code 0"):
            next(solve_in_chunks(counting, times, frames, workers=1, start=start, movers=None, warn=print))
        timers[-1].cancel()

    def test_a_run_that_waited_for_one_that_ends_says_so(self, tmp_path: Path):
        first = FrameFolder(tmp_path / "f", {}).__enter__()
        ends = threading.Timer(0.3, first.__exit__, (None, None, None))
        ends.start()
        with pytest.raises(LayerError, match="was made by another run meanwhile; run again"):
            FrameFolder(tmp_path / "f", {})
        ends.join()

    def test_a_task_that_outlasts_its_run_writes_nothing_into_another(self, tmp_path: Path):
        with FrameFolder(tmp_path / "f", {"level": 2}) as frames:
            outlasting = pickle.loads(pickle.dumps(frames))
        result = next(counting([0.0]))
        with pytest.raises(LayerError):
            outlasting.write(0, result)
        with FrameFolder(tmp_path / "f", {"level": 3}) as other:
            with pytest.raises(LayerError, match="another run's by now"):
                outlasting.write(0, result)
            assert other.read(0, 0.0) is None


class TestKeptFrames:
    @pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
    def test_a_resumed_run_goes_on_as_if_it_had_not_been_interrupted(self, tmp_path: Path, workers: int):
        """What the pre-roll leaves where it goes on is no more than what it leaves between two workers."""
        shot, out = cloth_shot(tmp_path / "shot.usdc", times=LONG), tmp_path / "fine.usdc"
        interrupted(shot, out, after=12, workers=workers)
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

    def test_frames_that_failed_or_are_not_whole_are_solved_again_and_damaged_ones_are_named(self, tmp_path: Path):
        shot, out = cloth_shot(tmp_path / "shot.usdc", broken={2.0: float("nan")}), tmp_path / "fine.usdc"
        folder = out.with_name(f"{out.name}.frames")
        interrupted(shot, out, after=5, temporal="off")
        assert {file.name for file in folder.glob("*.npz")} == {"0.npz", "1.failed.npz", "2.npz", "3.npz", "4.npz"}
        (folder / "2.npz").write_bytes((folder / "2.npz").read_bytes()[:-40])
        whole = (folder / "3.npz").read_bytes()
        (folder / "3.npz").write_bytes(whole[:150] + b"\xff" * 40 + whole[190:])
        line = ("refine", shot, "-o", out, "--level", "1", "--steps", "6", "--temporal", "off", "--resume")
        done = run(*line)
        assert (done.exit_code, "3.npz is damaged" in done.stderr) == (1, True), done.stderr
        (folder / "3.npz").unlink()
        done = run(*line)
        assert done.exit_code == 3, done.stderr
        assert "3 of 6 frames are those of a run that was interrupted" in done.stderr
        assert sample_times(out) == (1.0, 3.0, 4.0, 5.0, 6.0)
        assert not folder.exists()


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

    def test_s34_the_same_command_gives_the_same_bytes(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usdc")
        assert len({layer_with(shot, tmp_path / str(n)).read_bytes() for n in range(3)}) == 1
