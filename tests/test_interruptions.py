"""Kills, full disks and full file systems: no partial file under the final name, and a rerun finishes (must hold 7)."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from shots import cloth_shot, command, faults, sample_times

TIMES = tuple(float(t) for t in range(1, 61))
LINE = ("--level", "2", "--steps", "4", "--temporal", "off")


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixty frames, about as many hundredths of a second of work."""
    return cloth_shot(tmp_path_factory.mktemp("shot") / "shot.usdc", times=TIMES, size=(16, 12))


@pytest.fixture(scope="module")
def whole(shot: Path) -> bytes:
    """The bytes of an undisturbed run."""
    out = shot.parent / "runs" / "fine.usdc"
    out.parent.mkdir()
    assert command("refine", shot, "-o", out, *LINE).returncode == 0
    return out.read_bytes()


@contextlib.contextmanager
def running(shot: Path, out: Path, *extra: str) -> Iterator[subprocess.Popen[bytes]]:
    """A run that has begun to write, in a process group of its own."""
    line = [sys.executable, "-m", "physgraph_usd", "refine", str(shot), "-o", str(out), *LINE, *extra]
    process = subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        limit = time.monotonic() + 60
        while process.poll() is None and not list(out.parent.glob("*.tmp.*")) and time.monotonic() < limit:
            time.sleep(0.002)
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def finishes(shot: Path, out: Path, whole: bytes) -> None:
    """A rerun with the same command gives the whole layer and clears up what was left."""
    done = command("refine", shot, "-o", out, *LINE)
    assert done.returncode == 0, done.stderr
    assert out.read_bytes() == whole
    assert [file.name for file in out.parent.iterdir()] == [out.name]


@pytest.mark.parametrize("seed", range(3))
def test_a_killed_run_leaves_nothing_under_the_name_and_a_rerun_finishes(
    shot: Path, whole: bytes, tmp_path: Path, seed: int
):
    """At a random moment of the writing; the rerun has the bytes of a run that was left alone (S34)."""
    folder = shot.parent / f"killed{seed}"
    folder.mkdir()
    out = folder / "fine.usdc"
    with running(shot, out) as process:
        time.sleep(float(np.random.default_rng(seed).uniform(0.0, 0.25)))
        alive = process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert alive, "the run was over before it was killed: make it longer"
    assert not out.exists()
    finishes(shot, out, whole)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_killed_at_any_moment_from_start_to_end(shot: Path, whole: bytes, tmp_path: Path, seed: int):
    out = tmp_path / "fine.usdc"
    line = [sys.executable, "-m", "physgraph_usd", "refine", str(shot), "-o", str(out), *LINE]
    process = subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(float(np.random.default_rng(seed).uniform(0.0, 6.0)))
    process.kill()
    process.wait()
    if out.exists():
        assert len(sample_times(out)) == len(TIMES)
        assert faults(out, shot) == []
    else:
        assert command("refine", shot, "-o", out, *LINE).returncode == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_polite_signal_clears_up(shot: Path, tmp_path: Path, number: signal.Signals):
    out = tmp_path / "fine.usdc"
    with running(shot, out) as process:
        time.sleep(0.05)
        process.send_signal(number)
        code = process.wait(timeout=30)
    assert code != 0
    assert not list(tmp_path.iterdir())


def test_a_killed_run_with_workers_leaves_no_process_and_no_folder(
    shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "scratch").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "scratch"))
    out = tmp_path / "fine.usdc"
    with running(shot, out, "--workers", "2") as process:
        time.sleep(1.0)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert not out.exists()
        limit = time.monotonic() + 30
        while _alive(process.pid) and time.monotonic() < limit:
            time.sleep(0.1)
        assert not _alive(process.pid), "workers outlive the run"
    assert not list((tmp_path / "scratch").glob("physgraph-*"))


def _alive(group: int) -> bool:
    """Whether a process group has members."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("megabytes", [0.02, 0.5, 2.0])
def test_a_full_disk_is_a_clear_error(shot: Path, tmp_path: Path, megabytes: float):
    """Files may not grow beyond a limit, as on a disk that fills up early, in the middle and late."""
    limit = int(megabytes * 1e6)

    def fill() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    out = tmp_path / "fine.usdc"
    done = command("refine", shot, "-o", out, *LINE, preexec_fn=fill)
    assert done.returncode == 1, done.stderr
    lines = done.stderr.strip().splitlines()
    assert lines[-1].startswith("error: "), done.stderr
    assert "Traceback" not in done.stderr
    assert str(out.name) in lines[-1]
    assert not list(tmp_path.iterdir())


def test_a_folder_that_may_not_be_written(shot: Path, tmp_path: Path):
    if os.geteuid() == 0:
        pytest.skip("root may write anywhere")
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    done = command("refine", shot, "-o", folder / "fine.usdc", *LINE)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
