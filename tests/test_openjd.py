"""The OpenJobDescription template, checked and run by the reference command line: chunks, then the stitch."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from shots import cloth_shot, faults, refine, sample_times

pytest.importorskip("openjd.cli", reason="needs openjd-cli, which runs the templates")
TEMPLATE = Path(__file__).resolve().parents[1] / "plugins" / "openjd" / "refine.yaml"
TIMES = tuple(map(float, range(1, 9)))


def openjd(*args: object) -> subprocess.CompletedProcess[str]:
    """Run the reference command line, where it finds the command that this Python has."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    line = [str(Path(sys.executable).with_name("openjd")), *map(str, args)]
    return subprocess.run(
        line, capture_output=True, text=True, check=False, timeout=280, env=os.environ | {"PATH": path}
    )


def parameters(folder: Path, **more: Any) -> tuple[str, str]:
    given = {"Shot": str(folder / "shot.usdc"), "Layer": str(folder / "out" / "fine.usdc"), "Chunks": str(folder / "c")}
    return "--job-param", json.dumps(given | {"Frames": "1-8", "ChunkSize": "4"} | more)


def test_the_template_is_valid():
    done = openjd("check", TEMPLATE)
    assert done.returncode == 0, done.stderr + done.stdout


def test_its_tasks_are_chunks_of_consecutive_frames(tmp_path: Path):
    done = openjd("summary", TEMPLATE, *parameters(tmp_path, Frames="1-10"))
    assert done.returncode == 0, done.stderr + done.stdout
    assert "Total steps: 2" in done.stdout


@pytest.mark.slow
def test_a_job_makes_one_layer_and_a_second_run_of_it_solves_nothing_again(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usdc", times=TIMES)
    (tmp_path / "c").mkdir()
    runs = [openjd("run", TEMPLATE, "--step", "Stitch", "--run-dependencies", *parameters(tmp_path)) for _ in range(2)]
    assert [done.returncode for done in runs] == [0, 0], runs
    assert [done.stdout.count("is taken as done") for done in runs] == [0, 2]
    assert sorted(file.name for file in (tmp_path / "c").iterdir()) == ["chunk.1-4.usdc", "chunk.5-8.usdc"]
    layer = tmp_path / "out" / "fine.usdc"
    assert faults(layer, shot) == []
    assert sample_times(layer) == TIMES


@pytest.mark.slow
def test_a_job_fails_where_a_chunk_is_missing(tmp_path: Path):
    refine(cloth_shot(tmp_path / "shot.usdc", times=TIMES), tmp_path / "chunk.usdc", frames=(1.0, 4.0), run_up=6)
    done = openjd("run", TEMPLATE, "--step", "Stitch", *parameters(tmp_path, Chunks=str(tmp_path / "chunk.usdc")))
    assert done.returncode != 0
    assert "frames 5:8 are in no chunk" in done.stdout
