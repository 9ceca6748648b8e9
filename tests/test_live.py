"""The command `live`, as another program uses it: lines of JSON in, lines of JSON out, one process that stays."""

import json
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd
from shots import CLOTH, cloth_shot

from physgraph_usd.errors import UsageError
from physgraph_usd.studio.live import change, parsed
from physgraph_usd.studio.session import TuneSession
from physgraph_usd.studio.takes import Shown

PATIENCE_SECONDS = 180.0
STIFF = {"bendStiffness": 3e-4, "guide:stiffness": 100.0}


class Process:
    """The command on a shot; each answer is read once."""

    def __init__(self, shot: Path) -> None:
        line = [sys.executable, "-m", "physgraph_usd", "live", str(shot), "--garment", CLOTH]
        self.run = subprocess.Popen(
            line, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )

    def ask(self, **request: Any) -> None:
        self.write(json.dumps(request))

    def write(self, line: str) -> None:
        assert self.run.stdin is not None
        self.run.stdin.write(f"{line}\n".encode())

    def answer(self) -> dict[str, Any]:
        assert self.run.stdout is not None
        assert select.select([self.run.stdout], [], [], PATIENCE_SECONDS)[0], "no answer"
        line = self.run.stdout.readline()
        assert line, self.run.stderr.read().decode() if self.run.stderr else ""
        return json.loads(line)

    def answer_with(self, *keys: str) -> dict[str, Any]:
        """The next answer with one of some keys."""
        return next(answer for answer in iter(self.answer, None) if set(keys) & set(answer))

    def settled(self) -> tuple[list[np.ndarray], np.ndarray, dict[str, Any]]:
        """Points before the frame was settled, those after, and the last answer."""
        rounds = list[np.ndarray]()
        while True:
            answer = self.answer_with("points")
            points = np.load(answer["points"][CLOTH])
            if answer["settled"]:
                return rounds, points, answer
            rounds.append(points)

    def end(self) -> tuple[int, bytes]:
        """Exit code after the end of the input, and the rest of the output."""
        rest, _ = self.run.communicate(timeout=PATIENCE_SECONDS)
        return self.run.returncode, rest


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "sheet.usda", size=(8, 6))


@pytest.fixture
def process(shot: Path) -> Iterator[Process]:
    made = Process(shot)
    try:
        yield made
    finally:
        made.run.communicate(timeout=PATIENCE_SECONDS)


@pytest.fixture
def session(shot: Path, tmp_path: Path) -> Iterator[TuneSession]:
    with closing(TuneSession(shot, garments=[CLOTH], out=tmp_path / "other.usda")) as made:
        yield made


def points(shown: Shown) -> np.ndarray:
    assert shown.garments[0].points is not None
    return shown.garments[0].points


def test_the_cloth_is_the_sessions(process: Process, session: TuneSession):
    """A first frame, a preset with values over it, another frame and another level, each settled; then the end."""
    first = process.answer()
    folder = Path(first.pop("folder"))
    assert first == {"garments": [CLOTH], "times": list(session.times), "levels": {CLOTH: 2}}
    process.ask(time=3)
    session.set_time(3.0)
    before = points(session.settle())
    _, found, answer = process.settled()
    assert answer["time"] == 3.0
    assert np.abs(found - before).max() < 1e-6
    process.ask(preset={CLOTH: "denim"}, values={CLOTH: STIFF})
    session.set_preset(CLOTH, "denim")
    for name, value in STIFF.items():
        session.set_value(CLOTH, name, value)
    session.solve()
    rounds, found, answer = process.settled()
    assert len(rounds) >= 2
    assert np.abs(found - before).max() > 1e-4
    assert np.abs(found - points(session.settle())).max() < 1e-6
    faces = np.load(answer["faces"][CLOTH])
    known = session.refinements[0][-1].mesh
    assert np.array_equal(faces["counts"], known.counts)
    assert np.array_equal(faces["indices"], known.indices)
    process.ask(level={CLOTH: 0}, time=4.0)
    _, found, answer = process.settled()
    assert (len(found), answer["time"]) == (9 * 7, 4.0)
    assert len(np.load(answer["faces"][CLOTH])["counts"]) == 8 * 6
    assert Path(answer["points"][CLOTH]).parent == folder
    assert len(list(folder.glob("*.npy"))) <= 2 * len(list(folder.glob("*.npz"))) == 4
    code, rest = process.end()
    assert code == 0
    assert all(json.loads(line)["settled"] for line in rest.splitlines())
    assert not folder.exists()


@pytest.mark.slow
@pytest.mark.parametrize("last", ['{"quit": true}\n', ""])
def test_what_was_asked_before_the_end_is_saved(process: Process, shot: Path, last: str):
    assert process.run.stdin is not None
    process.ask()
    process.ask(values={CLOTH: {"density": 0.5}})
    process.run.stdin.write(b'{"save": true}' + (b"\n" if last else b""))
    process.run.stdin.write(last.encode())
    code, said = process.end()
    assert code == 0
    answers = [json.loads(line) for line in said.splitlines()]
    assert [Path(each["saved"]) for each in answers if "saved" in each] == [shot.with_suffix(".tuned.usda")]
    stage = Usd.Stage.Open(str(shot.with_suffix(".tuned.usda")))
    assert stage.GetPrimAtPath(CLOTH).GetAttribute("physgraph:material:density").Get() == 0.5


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_while_it_waits(process: Process, number: int):
    process.answer()
    process.run.send_signal(number)
    process.run.wait(PATIENCE_SECONDS)
    assert process.run.returncode == 128 + number


@pytest.mark.parametrize(
    "request_",
    [
        {"authored": CLOTH},
        {"preset": {CLOTH: "steel"}},
        {"preset": {CLOTH: ["denim"]}},
        {"preset": [CLOTH]},
        {"values": {CLOTH: 1.0}},
        {"values": {CLOTH: {"density": True}}},
        {"values": {CLOTH: {"density": float("nan")}}},
        {"values": {CLOTH: {"density": "1"}}},
        {"values": {CLOTH: {"density": 10**400}}},
        {"level": {CLOTH: -1}},
        {"level": {CLOTH: 1.5}},
        {"level": {CLOTH: 6}},
        {"level": 2},
        {"time": 2.5},
        {"time": [1]},
        {"time": None},
    ],
)
def test_what_is_refused(session: TuneSession, request_: dict[str, Any]):
    """A request that begins with a value that can be used changes nothing either."""
    before = session.setting, session.time
    with pytest.raises(UsageError):
        change(session, parsed(json.dumps({"preset": {CLOTH: "silk"}} | request_).encode()), save=lambda _: None)
    assert (session.setting, session.time) == before


@pytest.mark.parametrize(("words", "code"), [(b"", 0), (b"[1, 2]\n", 2), (b"{\n", 2), (b'["no.usda"]\n', 2)])
def test_arguments_that_come_with_the_input(words: bytes, code: int):
    line = [sys.executable, "-m", "physgraph_usd", "live", "-"]
    run = subprocess.run(line, input=words, capture_output=True, timeout=PATIENCE_SECONDS, check=False)
    assert run.returncode == code, run.stderr.decode()
    assert b"Traceback" not in run.stderr
