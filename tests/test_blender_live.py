"""The part of the add-on's live cloth that needs no Blender: the process that stays, and what it is asked."""

import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from blender import addon_module
from shots import CLOTH, cloth_shot

from physgraph_usd.studio.live import change, parsed
from physgraph_usd.studio.session import TuneSession
from physgraph_usd.studio.values import TUNABLES

PATIENCE_SECONDS = 180.0


@pytest.fixture(scope="module")
def live() -> ModuleType:
    return addon_module("live")


@pytest.fixture(scope="module")
def command() -> ModuleType:
    return addon_module("command")


@pytest.fixture
def program(tmp_path: Path) -> list[str]:
    shot = cloth_shot(tmp_path / "sheet.usda", size=(8, 6))
    return [sys.executable, "-m", "physgraph_usd", "live", str(shot), "--garment", CLOTH]


@pytest.fixture
def process(live: ModuleType, program: list[str], tmp_path: Path) -> Iterator[Any]:
    made = live.LiveProcess(program, tmp_path / "log")
    yield made
    made.stop().join(PATIENCE_SECONDS)


def wait_for(process: Any, holds: Callable[[Any], object]) -> Any:
    """The first news of which something holds."""
    until = time.monotonic() + PATIENCE_SECONDS
    while time.monotonic() < until:
        news = process.news()
        if holds(news):
            return news
        time.sleep(0.01)
    pytest.fail(process.last_words())


def test_the_process_answers_with_files_and_ends(live: ModuleType, process: Any) -> None:
    shot = wait_for(process, lambda news: news.shot).shot
    assert shot["garments"] == [CLOTH]
    process.send({"time": 2.0})
    news = wait_for(process, lambda news: news.settled)
    points, faces = np.load(news.points[CLOTH]), live.faces_in(news.faces[CLOTH])
    assert faces.corners.max() == len(points) - 1
    assert np.array_equal(faces.starts, 4 * np.arange(8 * 6 * 16))
    process.send({"values": {CLOTH: {"density": -1.0}}})
    assert "density is -1" in wait_for(process, lambda news: news.errors).errors[0]
    process.stop().join(PATIENCE_SECONDS)
    assert wait_for(process, lambda news: news.ended)
    assert not Path(news.points[CLOTH]).exists()
    process.send({"time": 1.0})


def test_a_process_started_ahead_takes_the_next_shot(live: ModuleType, program: list[str], tmp_path: Path) -> None:
    """It is a command of its own, since the add-on names one by its path."""
    command = tmp_path / "physgraph-usd"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m physgraph_usd "$@"\n')
    command.chmod(0o755)
    ahead, line = live.Ahead(), [str(command), *program[3:]]
    ahead.start(str(command))
    waiting = ahead.process
    ahead.start(str(command))
    assert ahead.process is waiting
    process = ahead.take(line, tmp_path / "log")
    assert process is waiting
    assert wait_for(process, lambda news: news.shot).shot["garments"] == [CLOTH]
    process.send({"time": 2.0})
    assert wait_for(process, lambda news: news.settled).points
    process.stop().join(PATIENCE_SECONDS)
    assert not process.log.exists()


def test_a_process_started_ahead_ends_with_its_input_and_a_missing_command_is_tried_once(live: ModuleType) -> None:
    ahead = live.Ahead()
    ahead.start("no-such-command")
    assert ahead.process is None
    ahead.start(sys.executable)  # Python takes "live" for a file that is not there.
    process = ahead.process
    assert process is not None
    process._process.wait(PATIENCE_SECONDS)
    assert not process.runs
    ahead.stop()
    assert ahead.process is None


@pytest.mark.slow
def test_a_process_that_fails_says_why(live: ModuleType, program: list[str], tmp_path: Path) -> None:
    process = live.LiveProcess([*program[:-1], "/World/nothing"], tmp_path / "log")
    wait_for(process, lambda news: news.ended)
    assert "/World/nothing" in process.last_words()
    process.send({})
    process.stop().join(PATIENCE_SECONDS)


def test_one_that_does_not_end_is_killed(live: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "PATIENCE_SECONDS", 0.2)
    folder = tmp_path / "folder"
    folder.mkdir()
    first = json.dumps({"garments": [], "folder": str(folder)})
    code = f"import sys, time; sys.stdout.write({first!r} + chr(10)); sys.stdout.flush(); time.sleep(60)"
    process = live.LiveProcess([sys.executable, "-c", code], tmp_path / "log")
    wait_for(process, lambda news: news.shot)
    process.stop().join(PATIENCE_SECONDS)
    assert process._process.returncode == -signal.SIGKILL
    assert not folder.exists()


def test_a_line_that_is_no_json_is_an_error(live: ModuleType, tmp_path: Path) -> None:
    process = live.LiveProcess([sys.executable, "-c", "import sys; sys.stdout.write('hello\\n')"], tmp_path / "log")
    news = wait_for(process, lambda news: news.errors)
    assert news.errors == ["hello"]
    process.stop().join(PATIENCE_SECONDS)


def test_the_session_then_has_what_the_panel_says(
    live: ModuleType, command: ModuleType, program: list[str], tmp_path: Path
) -> None:
    """From any settings to any others, the session has the values that a session of its own has from the start."""
    choices = [
        command.Settings((1, 2)),
        command.Settings((1, 2), values={"density": 0.2}),
        command.Settings((1, 2), values={"guide:stiffness": 9.0, "rest:weftEase": 2.0}, level=1),
        command.Settings((1, 2), preset="denim", values={"density": 0.2}, level=1),
        command.Settings((1, 2), preset="silk"),
    ]
    session = TuneSession(program[4], garments=[CLOTH])
    known = choices[0]
    for settings in [*choices, *reversed(choices), choices[3], choices[1], choices[4], choices[2]]:
        request = live.request_for(settings, known, [CLOTH])
        assert bool(request) == (settings != known)
        change(session, parsed(json.dumps(request).encode()), save=lambda _: None)
        known, fresh = settings, TuneSession(program[4], garments=[CLOTH], out=tmp_path / "other.usda")
        if settings.preset:
            fresh.set_preset(CLOTH, settings.preset)
        for name, value in settings.values.items():
            fresh.set_value(CLOTH, name, value)
        fresh.set_level(CLOTH, settings.level)
        assert {name: session.value(CLOTH, name) for name in TUNABLES} == {
            name: fresh.value(CLOTH, name) for name in TUNABLES
        }
        assert session.setting.levels == fresh.setting.levels
        fresh.close()
    session.close()
