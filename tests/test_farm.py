"""Shots and chunks on the workers of a Dask scheduler: the bytes of a local run, whatever becomes of a worker."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from frame_solvers import as_named
from pxr import Sdf, Usd, UsdGeom
from shots import CLOTH, cloth_shot, command, faults, refine
from stages import sheet_points, vec3

from physgraph_usd.errors import PhysGraphError, UsageError
from physgraph_usd.shot.workers import connected, result_of
from physgraph_usd.usd.read.targets import TARGETS

distributed = pytest.importorskip("distributed", reason="needs Dask (extra farm)")
TIMES = tuple(float(time) for time in range(1, 49))
BEADS = "/World/beads"
NOWHERE = "tcp://127.0.0.1:9"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A worker process of one thread."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0", host="127.0.0.1"
    ) as started:
        yield started


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A waving sheet with beads that follow it."""
    path = cloth_shot(tmp_path_factory.mktemp("farm") / "shot.usdc", times=TIMES)
    stage = Usd.Stage.Open(str(path))
    UsdGeom.Points.Define(stage, BEADS).CreatePointsAttr(vec3(sheet_points(None, (6, 4))[8:11]))
    stage.GetPrimAtPath(CLOTH).CreateRelationship(TARGETS).SetTargets([BEADS])
    stage.Save()
    return path


def layer_of(shot: Path, folder: Path, **options: Any) -> Path:
    """Refine a shot into a folder of its own, since a record names its shot from there."""
    folder.mkdir()
    assert refine(shot, folder / "fine.usdc", **options).exit_code == 0
    return folder / "fine.usdc"


@pytest.mark.slow
def test_h34_a_worker_that_is_killed_changes_no_byte(cluster: Any, shot: Path, tmp_path: Path):
    """A worker dies in the middle of its chunk; another one takes the chunk over."""
    cluster.scale(2)
    cluster.wait_for_workers(2)
    local = layer_of(shot, tmp_path / "local", workers=4)
    killed: list[int] = []
    told: list[tuple[int, int]] = []

    def kill_one(done: int, total: int) -> None:
        told.append((done, total))
        if done == 3:
            with distributed.Client(cluster.scheduler_address) as client:
                killed.extend(client.run(os.getpid).values())
            os.kill(killed[0], signal.SIGKILL)

    farmed = layer_of(shot, tmp_path / "farm", workers=4, scheduler=cluster.scheduler_address, progress=kill_one)
    assert killed
    assert told == [(done, 48) for done in range(1, 49)]
    assert farmed.read_bytes() == local.read_bytes()
    assert Sdf.Layer.FindOrOpen(str(farmed)).ListTimeSamplesForPath(f"{BEADS}.points") == list(TIMES)
    assert faults(farmed, shot) == []
    assert [file.name for file in farmed.parent.iterdir()] == ["fine.usdc"]


def test_a_layer_is_that_of_a_local_run(cluster: Any, shot: Path, tmp_path: Path):
    """Of frames that stand alone, so that chunks make no difference."""
    asked: dict[str, Any] = {"frames": (1.0, 4.0), "temporal": "off"}
    farmed = layer_of(shot, tmp_path / "farm", workers=2, scheduler=cluster.scheduler_address, **asked)
    assert farmed.read_bytes() == layer_of(shot, tmp_path / "local", **asked).read_bytes()


@pytest.mark.slow
def test_several_shots_each_in_chunks(cluster: Any, tmp_path: Path):
    """By the command, from another folder than the workers', and a shot that is broken leaves the others alone."""
    shots = [cloth_shot(tmp_path / f"{name}.usdc") for name in ("one", "two")]
    (tmp_path / "broken.usdc").write_bytes(b"no stage")
    names = [shot.name for shot in (*shots, tmp_path / "broken.usdc")]
    line = ("refine", *names, "--level", "1", "--steps", "6", "--workers", "2")
    done = command(*line, "-o", "out", "--scheduler", cluster.scheduler_address, cwd=tmp_path)
    assert done.returncode == 3, done.stderr
    assert "error: broken.usdc" in done.stderr
    (tmp_path / "local").mkdir()
    for shot in shots:
        refine(shot, tmp_path / "local" / f"{shot.stem}.refined.usdc", workers=2)
        made = tmp_path / "out" / f"{shot.stem}.refined.usdc"
        assert made.read_bytes() == (tmp_path / "local" / made.name).read_bytes()


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("torn", "</World/cloth> at time code 5: torn"),
        ("raises", "unexpected ValueError: a bug"),
        pytest.param("dies", "unexpected KilledWorker: .*all those workers died", marks=pytest.mark.slow),
    ],
)
def test_what_ends_a_task_is_named(cluster: Any, kind: str, said: str):
    with connected(cluster.scheduler_address) as start:
        with pytest.raises(PhysGraphError, match=said):
            result_of(start(as_named, kind))
        assert result_of(start(as_named, "returns")) == "returns"


@pytest.mark.parametrize(
    ("name", "other", "said"),
    [
        ("__version__", "0.0.0", r"this machine 0\.0\.0 "),
        ("code_digest", lambda: "feedfeedfeed", r"\(code feedfeedfeed\)"),
    ],
)
def test_workers_of_another_version_or_checkout_are_refused(
    cluster: Any, shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, other: Any, said: str
):
    monkeypatch.setattr(f"physgraph_usd.shot.workers.{name}", other)
    with pytest.raises(UsageError, match=said):
        refine(shot, tmp_path / "fine.usdc", scheduler=cluster.scheduler_address)


def test_workers_of_several_threads_are_refused(shot: Path, tmp_path: Path):
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0", protocol="tcp", host="127.0.0.1"
    ) as two:
        with pytest.raises(UsageError, match="has 2 threads; start each with --nthreads 1"):
            refine(shot, tmp_path / "fine.usdc", scheduler=two.scheduler_address)


def test_a_scheduler_that_is_not_there_is_named(shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("physgraph_usd.shot.workers.CONNECT_SECONDS", 0.2)
    for address in (NOWHERE, "farm"):
        with pytest.raises(UsageError, match=f"no Dask scheduler answers at {address}"):
            refine(shot, tmp_path / "fine.usdc", scheduler=address)
        assert not list(tmp_path.iterdir())


def test_without_dask_its_package_is_named(shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match="pip install distributed"):
        refine(shot, tmp_path / "fine.usdc", scheduler=NOWHERE)
