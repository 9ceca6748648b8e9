"""Kills, full disks and full file systems: no partial file under the final name, and a rerun finishes (must hold 7)."""

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from shots import cloth_shot, command, faults, interrupted, run

from physgraph_usd.shot.frames import LOCK, frames_folder
from physgraph_usd.usd.write.atomic import HOST

TIMES = tuple(float(t) for t in range(1, 26))
LINE = ("--level", "2", "--steps", "4", "--temporal", "off")
PATIENCE_SECONDS = 180.0
"""How long something must not have happened before a test gives up; nothing else depends on it."""


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty-five frames, some seconds of work."""
    return cloth_shot(tmp_path_factory.mktemp("shot") / "shot.usdc", times=TIMES, size=(10, 8))


@pytest.fixture(scope="module")
def whole(shot: Path) -> bytes:
    """The bytes of an undisturbed run."""
    out = shot.parent / "runs" / "fine.usdc"
    out.parent.mkdir()
    assert run("refine", shot, "-o", out, *LINE).exit_code == 0
    return out.read_bytes()


def begun(*args: object, stderr: int = subprocess.DEVNULL, **options: Any) -> subprocess.Popen[str]:
    """The command, started in a process of its own."""
    line = [sys.executable, "-m", "physgraph_usd", *map(str, args)]
    return subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=stderr, text=True, **options)


@contextlib.contextmanager
def running(shot: Path, out: Path, *extra: str, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A run that has begun to write, in a process group of its own."""
    process = begun("refine", shot, "-o", out, *LINE, *extra, start_new_session=True, **options)
    try:
        limit = time.monotonic() + PATIENCE_SECONDS
        while process.poll() is None and len(finished(out)) < 3 and time.monotonic() < limit:
            time.sleep(0.002)
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def finished(out: Path) -> list[Path]:
    """Frames that a run has finished."""
    return [file for file in frames_folder(out).glob("*.npz") if file.stem.isdecimal()]


def finishes(shot: Path, out: Path, whole: bytes, *more: str) -> None:
    """A rerun that goes on, or begins anew, gives the whole layer and clears up what was left."""
    count = len(finished(out))
    done = run("refine", shot, "-o", out, *LINE, *more)
    assert done.exit_code == 0, done.stderr
    used = f"{count} of {len(TIMES)} frames are those of a run that was interrupted"
    anew = f"{count} finished frames of a run that was interrupted are solved anew; --resume would have used them"
    assert (used if "--resume" in more else anew) in done.stderr
    assert out.read_bytes() == whole
    assert [file.name for file in out.parent.iterdir()] == [out.name]


@pytest.mark.parametrize(("seed", "workers"), [(0, "1"), pytest.param(1, "2", marks=pytest.mark.slow)])
def test_a_killed_run_leaves_nothing_under_the_name_nor_a_process_and_a_rerun_finishes(
    shot: Path, whole: bytes, seed: int, workers: str
):
    """At a random moment of the writing; the rerun has the bytes of a run that was left alone (S34)."""
    folder = shot.parent / f"killed{seed}"
    folder.mkdir()
    out = folder / "fine.usdc"
    with running(shot, out, "--workers", workers) as process:
        time.sleep(float(np.random.default_rng(seed).uniform(0.0, 0.25)))
        alive, started = process.poll() is None, psutil.Process(process.pid).children(recursive=True)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not psutil.wait_procs(started, timeout=PATIENCE_SECONDS)[1], "workers outlive the run"
    assert alive, "the run was over before it was killed: make it longer"
    assert started or workers == "1"
    assert (frames_folder(out) / LOCK).exists()
    assert not out.exists()
    finishes(shot, out, whole, *(() if seed else ("--resume",)))


@pytest.mark.slow
def test_a_worker_that_is_killed_is_named_by_its_frame_and_costs_no_finished_one(shot: Path, whole: bytes):
    """The worker may have either half of the shot; frames before its own are finished by the other one."""
    out = shot.parent / "worker" / "fine.usdc"
    out.parent.mkdir()
    with running(shot, out, "--workers", "2", stderr=subprocess.PIPE) as process:
        workers = [worker for server in psutil.Process(process.pid).children() for worker in server.children()]
        assert len(workers) == 2
        workers[0].kill()
        error = process.communicate(timeout=PATIENCE_SECONDS)[1]
    assert process.returncode == 1, error
    assert "error: a worker process died at time code" in error.splitlines()[-1]
    assert "if memory ran out, use fewer --workers or a lower --level" in error.splitlines()[-1]
    named = int(error.split("died at time code ")[1].split(";")[0])
    assert {f"{k}.npz" for k in range(named - 1)} <= {file.name for file in finished(out)}
    assert not out.exists()
    finishes(shot, out, whole, "--resume")


def says_interrupted(out: Path, report: Path, summary: Path, *, code: int, of: int) -> int:
    """Report and summary agree on what is kept, which is what lies there; returns how many frames that are."""
    count = len(finished(out))
    are, them = ("is", "it") if count == 1 else ("are", "them")
    said = f"interrupted, {count} of {of} frames {are} kept in {frames_folder(out)}; --resume goes on from {them}"
    plain, batch = (json.loads(file.read_text(encoding="utf-8")) for file in (report, summary))
    assert (plain["exit_code"], plain["error"]) == (code, said if count else "interrupted, no frame is kept")
    row = batch["shots"][0]
    state, error = ("interrupted", said) if count else ("not done", "")
    assert (batch["exit_code"], row["state"], row["frames"], row["error"]) == (code, state, count, error)
    return count


@pytest.mark.parametrize(
    ("number", "workers"),
    [
        (signal.SIGINT, "1"),
        pytest.param(signal.SIGTERM, "2", marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, "1", marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, "2", marks=pytest.mark.slow),
    ],
)
def test_a_polite_signal_keeps_finished_frames_and_says_so(
    shot: Path, whole: bytes, tmp_path: Path, number: signal.Signals, workers: str
):
    """The run is resumed with another number of workers; the layer has the bytes of one that was left alone (S34)."""
    out = shot.parent / f"polite{number}{workers}" / "fine.usdc"
    out.parent.mkdir()
    report, summary = tmp_path / "report.json", tmp_path / "summary.json"
    with running(shot, out, "--workers", workers, "--report", str(report), "--summary", str(summary)) as process:
        process.send_signal(number)
        code = process.wait(timeout=PATIENCE_SECONDS)
    assert code == 128 + number
    assert [file.name for file in out.parent.iterdir()] == [frames_folder(out).name]
    assert all(file.name == "run.json" or file in finished(out) for file in frames_folder(out).iterdir())
    assert says_interrupted(out, report, summary, code=code, of=len(TIMES)) >= 3
    if (number, workers) == (signal.SIGTERM, "1"):
        finishes(shot, out, whole, "--resume", "--workers", "2", "--report", str(report))


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere workers are no forks of a server")
def test_ctrl_c_while_the_workers_server_imports_is_one_line(shot: Path, tmp_path: Path):
    """A terminal sends Ctrl-C to the server too."""
    line = ("refine", shot, "-o", tmp_path / "fine.usdc", "--workers", "2")
    with begun(*line, stderr=subprocess.PIPE, start_new_session=True) as process:
        limit = time.monotonic() + PATIENCE_SECONDS
        while not (children := _servers(process.pid)) and time.monotonic() < limit:
            time.sleep(0.002)
        time.sleep(0.1)  # In the midst of its imports, which take a second.
        os.killpg(process.pid, signal.SIGINT)
        error = process.communicate(timeout=PATIENCE_SECONDS)[1]
    assert children
    assert (process.returncode, error) == (130, "interrupted\n")


def _servers(pid: int) -> list[psutil.Process]:
    """Servers of workers that a process has started."""
    return [child for child in psutil.Process(pid).children() if any("forkserver" in word for word in child.cmdline())]


@pytest.mark.slow
def test_every_signal_at_any_moment_of_any_command_ends_it():
    """Must hold 4 in brief; all of it is the program itself."""
    line = [sys.executable, "-m", "tests.signals", "--short"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_closed_streams_cost_nothing(shot: Path, tmp_path: Path):
    out = tmp_path / "fine.usdc"

    def close() -> None:
        for number in range(3):
            os.close(number)

    assert command("refine", shot, "-o", out, "--frames", "1:3", "-v", preexec_fn=close).returncode == 0
    assert faults(out, shot) == []


def test_a_second_run_leaves_the_frames_of_the_first_alone(shot: Path, whole: bytes):
    """Two processes with one output; the first one waits where it is until the second has ended, then goes on."""
    out = shot.parent / "two" / "fine.usdc"
    out.parent.mkdir()
    with running(shot, out) as first:
        first.send_signal(signal.SIGSTOP)
        there = finished(out)
        second = run("refine", shot, "-o", out, *LINE, "--overwrite")
        assert second.exit_code == 1, second.stderr
        who = f"{out} is being made by process {first.pid} on {HOST}; wait for it, end it, or name another layer"
        assert second.stderr.splitlines()[-1] == f"error: {who}"
        assert "are kept" not in second.stderr
        assert there
        assert finished(out) == there
        first.send_signal(signal.SIGCONT)
        assert first.wait(timeout=PATIENCE_SECONDS) == 0
    assert out.read_bytes() == whole
    assert [file.name for file in out.parent.iterdir()] == [out.name]


ENDED: dict[str, Any] = {"after": 3, "level": 2, "steps": 4, "temporal": "off"}
"""A run in this process that its user ends after three frames."""


def test_frames_of_another_run_are_neither_used_nor_dropped_unasked(shot: Path, tmp_path: Path):
    out = tmp_path / "fine.usdc"
    interrupted(shot, out, **ENDED)
    count = len(finished(out))
    assert count == 3
    for resume in ((), ("--resume",)):
        other = run("refine", shot, "-o", out, *LINE, "--set", "physgraph:material:density=0.3", *resume)
        assert other.exit_code == 2, other.stderr
        assert f"holds {count} finished frames of a run with other overrides" in other.stderr
    assert len(finished(out)) == count


def test_finished_frames_are_not_kept_when_not_asked_for(shot: Path, tmp_path: Path):
    interrupted(shot, tmp_path / "fine.usdc", **ENDED, keep_frames=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("number", "workers"), [(signal.SIGTERM, "2"), pytest.param(signal.SIGINT, "1", marks=pytest.mark.slow)]
)
def test_a_signal_leaves_no_empty_folder(shot: Path, tmp_path: Path, number: signal.Signals, workers: str):
    """Before the first frame, of several shots, into folders that were not there."""
    other = cloth_shot(tmp_path / "other.usdc")
    out = tmp_path / "new" / "out"
    summary = tmp_path / "summary.json"
    more = ("--report", tmp_path / "new" / "reports", "--summary", summary, "--workers", workers)
    process = begun("refine", shot, other, "-o", out, *LINE, *more)
    try:
        while process.poll() is None and not out.exists():
            time.sleep(0.002)
        process.send_signal(number)
        assert process.wait(timeout=PATIENCE_SECONDS) != 0
    finally:
        process.kill()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["other.usdc", "summary.json"]
    assert [row["state"] for row in json.loads(summary.read_text())["shots"]] == ["not done"] * 2


@pytest.mark.slow
@pytest.mark.parametrize(("megabytes", "workers"), [(0.3, "1"), (0.005, "2")])
def test_a_full_disk_is_a_clear_error_and_costs_no_finished_frame(
    shot: Path, whole: bytes, tmp_path: Path, megabytes: float, workers: str
):
    """Files may not grow beyond a limit, as on a disk that fills up in the middle, and early."""
    limit = int(megabytes * 1e6)

    def fill() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    out = shot.parent / f"full{megabytes}{workers}" / "fine.usdc"
    out.parent.mkdir()
    done = command("refine", shot, "-o", out, *LINE, "--workers", workers, preexec_fn=fill)
    assert done.returncode == 1, done.stderr
    lines = done.stderr.strip().splitlines()
    assert lines[-1].startswith("error: "), done.stderr
    assert "Traceback" not in done.stderr
    assert str(out.name) in lines[-1]
    assert not out.exists()
    count = len(finished(out))
    assert count == (0 if megabytes < 0.1 else len(TIMES))
    if count:
        assert f"{count} of {len(TIMES)} frames are kept in {frames_folder(out)}; --resume goes on" in done.stderr
        finishes(shot, out, whole, "--resume")
    assert [file for file in out.parent.iterdir() if file != out] == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_a_log_on_a_full_disk_costs_nothing(shot: Path, tmp_path: Path):
    out = tmp_path / "fine.usdc"
    done = run("refine", shot, "-o", out, "--frames", "1:3", "--log-file", "/dev/full", "-v", *LINE)
    assert done.exit_code == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("cannot write /dev/full") == 1
    assert faults(out, shot) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
def test_memory_that_runs_out_is_a_clear_error(tmp_path: Path):
    """A billion fine vertices where a few gigabytes may be had."""
    shot = cloth_shot(tmp_path / "shot.usdc", times=(1.0, 2.0), size=(400, 400))

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (6_000_000_000, 6_000_000_000))

    done = command("refine", shot, "-o", tmp_path / "fine.usdc", "--level", "5", preexec_fn=limit)
    assert (done.returncode, "Traceback" in done.stderr) == (1, False), done.stderr
    assert "memory" in done.stderr.strip().splitlines()[-1], done.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["shot.usdc"]
