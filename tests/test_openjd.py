"""The OpenJobDescription template, checked and run by the reference command line: chunks, then the stitch."""

import json
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from shots import CLOTH, cloth_shot, faults, run, sample_times

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


def test_its_tasks_are_chunks_of_consecutive_frames(tmp_path: Path):
    done = openjd("summary", TEMPLATE, *parameters(tmp_path, Frames="1-10"))
    assert done.returncode == 0, done.stderr + done.stdout
    assert "Total steps: 2" in done.stdout


def test_its_reader_finds_progress_and_status_of_a_chunk(tmp_path: Path):
    """By the filter that farms' sessions read a task's output with; parameters left empty are none."""
    from openjd.sessions._action_filter import ActionMessageKind, ActionMonitoringFilter

    told: list[tuple[Any, Any]] = []
    reader = ActionMonitoringFilter(session_id="s", callback=lambda kind, value, *_: told.append((kind, value)))
    shot = cloth_shot(tmp_path / "shot.usdc", times=TIMES[:4])
    empty = [word for option in ("--garment", "--collider", "--level") for word in (option, "")]
    line = ["--frames", "1-2", "--preroll", "1", *empty, "--openjd", "--steps", "1"]
    done = run("refine", shot, "-o", tmp_path / "c", *line)
    assert done.exit_code == 0, done.stderr
    for text in done.stderr.splitlines():
        record = logging.makeLogRecord({"msg": text, "levelno": logging.INFO, "session_id": "s"})
        reader.filter(record)
    assert [value for kind, value in told if kind is ActionMessageKind.PROGRESS] == [50.0, 100.0]
    assert [str(value)[:13] for kind, value in told if kind is ActionMessageKind.STATUS] == [
        "1 of 2 frames",
        "2 of 2 frames",
    ]


@pytest.mark.slow
def test_a_job_makes_one_layer_and_a_second_run_of_it_solves_nothing_again(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usdc", times=TIMES)
    (tmp_path / "c").mkdir()
    asked = parameters(tmp_path, Garment=CLOTH, Level="1")
    runs = [openjd("run", TEMPLATE, "--step", "Stitch", "--run-dependencies", *asked) for _ in range(2)]
    assert [done.returncode for done in runs] == [0, 0], runs
    assert [done.stdout.count("4 of 4 frames are those of a run") for done in runs] == [0, 2]
    assert "openjd_progress: 100.0" in runs[0].stdout
    assert "openjd_status: seam at 5: " in runs[0].stdout
    assert sorted(file.name for file in (tmp_path / "c").iterdir()) == ["chunk.1-4", "chunk.5-8"]
    layer = tmp_path / "out" / "fine.usdc"
    assert faults(layer, shot) == []
    assert sample_times(layer) == TIMES
