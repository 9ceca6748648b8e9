"""Files that are complete or not there."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from layers import vec3
from pxr import Sdf

from physgraph_usd.errors import UsageError
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
