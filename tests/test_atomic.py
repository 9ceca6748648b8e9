"""Files that are complete or not there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from layers import vec3
from pxr import Sdf

from physgraph_usd.errors import LayerError, UsageError
from physgraph_usd.interrupts import leave_if_asked, signals_noted
from physgraph_usd.usd.write.atomic import HOST, remove_stale, temporary_path
from physgraph_usd.usd.write.stream import LayerStream

POINTS = Sdf.Path("/World/coat.points")


def fill(stream: LayerStream, frames: int, *, vertices: int = 10) -> None:
    stream.attribute(POINTS, Sdf.ValueTypeNames.Point3fArray)
    for frame in range(frames):
        stream.set(POINTS, vec3(np.full((vertices, 3), float(frame))), time=float(frame))


def interrupt(target: Path) -> None:
    """Write a little and be stopped by the user."""
    with LayerStream(target, overwrite=True) as stream:
        fill(stream, 3)
        stream.flush()
        raise KeyboardInterrupt


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_a_committed_layer_is_whole(tmp_path: Path, suffix: str) -> None:
    target = tmp_path / f"out{suffix}"
    with LayerStream(target) as stream:
        fill(stream, 3)
        assert not target.exists()
        stream.commit()
    assert names(tmp_path) == [target.name]
    assert list(Sdf.Layer.OpenAsAnonymous(str(target)).ListTimeSamplesForPath(POINTS)) == [0.0, 1.0, 2.0]


def test_an_error_keeps_the_file_that_was_there(tmp_path: Path) -> None:
    target = tmp_path / "out.usdc"
    target.write_text("old")
    with pytest.raises(UsageError, match="exists"):
        LayerStream(target)
    with pytest.raises(KeyboardInterrupt):
        interrupt(target)
    assert target.read_text() == "old"
    assert names(tmp_path) == ["out.usdc"]


def test_two_writers_of_one_layer_do_not_meet(tmp_path: Path) -> None:
    with LayerStream(tmp_path / "out.usdc") as stream:
        with pytest.raises(LayerError, match="being written by this process already"):
            LayerStream(tmp_path / "out.usdc")
        fill(stream, 2)
        stream.commit()
    assert names(tmp_path) == ["out.usdc"]


def test_what_dead_processes_left_is_removed(tmp_path: Path) -> None:
    target = tmp_path / "out.usdc"
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    stale = tmp_path / f"out.usdc.{HOST}.{int(dead.stdout)}.tmp.usdc"
    alive = tmp_path / f"out.usdc.{HOST}.{os.getppid()}.tmp.usdc"
    other = tmp_path / f"shot.usdc.{HOST}.{int(dead.stdout)}.tmp.usdc"
    elsewhere = tmp_path / f"out.usdc.{HOST}2.{int(dead.stdout)}.tmp.usdc"
    for path in (stale, alive, other, elsewhere):
        path.write_text("x")
    assert remove_stale(target) == [stale]
    assert names(tmp_path) == sorted([alive.name, other.name, elsewhere.name])
    assert temporary_path(target).parent == tmp_path


def test_hosts_of_one_disk_do_not_meet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two machines write one layer under the same process number; neither takes the other's file away."""
    target = tmp_path / "out.usdc"
    with LayerStream(target) as stream:
        fill(stream, 1)
        stream.flush()
        monkeypatch.setattr("physgraph_usd.usd.write.atomic.HOST", "elsewhere")
        with LayerStream(target) as second:
            fill(second, 1)
            second.flush()
            assert len(names(tmp_path)) == 2
        stream.commit()
    assert names(tmp_path) == ["out.usdc"]


class Destroyed:
    """An object in whose destructor a termination signal comes."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


def write_on(target: Path, reached: list[str]) -> None:
    with signals_noted(), LayerStream(target) as stream:
        Destroyed()
        fill(stream, 2)
        reached.append("flush")
        stream.flush()
        reached.append("end")


def test_a_signal_in_a_destructor_ends_the_next_flush(tmp_path: Path) -> None:
    reached: list[str] = []
    with pytest.raises(SystemExit) as caught:
        write_on(tmp_path / "out.usdc", reached)
    assert caught.value.code == 128 + signal.SIGTERM
    assert names(tmp_path) == []
    assert reached == ["flush"]
    leave_if_asked()  # The next run of this process is not asked to end.
