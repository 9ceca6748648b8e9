"""A session for another program: requests come as lines of JSON, and answers leave as lines of JSON.

The first answer describes the shot: `{"garments": [PATH, ...], "times": [TIME, ...], "levels": {PATH: 2}, "folder":
FOLDER}`. The files of the answers lie in the folder, which is removed at the end. Nothing is solved before the first
request, which may be empty. A request is an object of these keys, each optional:

    {"authored": [PATH, ...]}               Take the garments' values from the shot again.
    {"preset": {PATH: "denim"}}             Try a fabric.
    {"values": {PATH: {"bendStiffness": 1e-5}}}  Try values [SI], by the schema's short names.
    {"level": {PATH: 2}}                    Try a number of subdivisions.
    {"time": 12.0}                          Go to a time code of the shot.
    {"contact": false}                      Let cloth feel bodies and cloth, or nothing.
    {"save": true}                          Write the layer; the answer is {"saved": FILE}.
    {"quit": true}                          End, as the end of the input does.

They are done in this order, and then the frame is solved. Each round is answered, and so is the settled frame:

    {"points": {PATH: FILE.npy}, "faces": {PATH: FILE.npz}, "settled": false, "time": 12.0}

A file of points holds float32 [m], world space, shape (V, 3), and is replaced two answers later. A file of faces holds
`counts` and `indices` of the fine mesh, and stays. `{"error": TEXT}` is the answer to a request that cannot be used,
which changes nothing, and to a frame that cannot be solved.
"""

from __future__ import annotations

import json
import os
import select
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from operator import methodcaller
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import PhysGraphError, SolveError, UsageError
from ..interrupts import leave_if_asked
from ..solver.fabric import PRESETS
from ..usd.lookup import check_known, parse_overrides
from ..usd.schema import GARMENT
from .loop import Change, SolveLoop
from .session import TuneSession
from .takes import Shown
from .values import TUNABLES

POLL_SECONDS = 0.1
"""Time between two questions whether a signal came [s]."""
LEVEL = "refine:level"


class Answers:
    """The writer of answers; a watcher of the loop.

    Attributes:
        stream: Unbuffered stream of the answers.
    """

    def __init__(self, session: TuneSession, stream: BinaryIO, folder: Path) -> None:
        """Describe the shot; ``folder`` takes the files of points and faces."""
        self.stream, self._session, self._folder = stream, session, folder
        self._lock, self._count = threading.Lock(), 0
        levels = dict(zip(session.garments, session.setting.levels, strict=True))
        self.say(garments=session.garments, times=session.times, levels=levels, folder=str(folder))

    def say(self, **answer: Any) -> None:
        """Write an answer; after the reader has gone, nothing."""
        line = json.dumps(answer).encode() + b"\n"
        with self._lock, suppress(BrokenPipeError):
            self.stream.write(line)

    def busy(self, what: str) -> None:
        """Work has begun, which is no answer."""

    def solved(self) -> None:
        """Ignore a solved frame of the range."""

    def seen(self, points: Mapping[str, np.ndarray]) -> None:
        """Answer with a round."""
        self._answer(points, settled=False)

    def show(self, shown: Shown) -> None:
        """Answer with a solved frame."""
        found = zip(self._session.garments, shown.points, strict=True)
        self._answer({path: each for path, each in found if each is not None}, settled=shown.settled)

    def fail(self, error: PhysGraphError) -> None:
        """Answer with an error."""
        self.say(error=str(error))

    def save(self, session: TuneSession) -> None:
        """Write the session's layer."""
        self.say(saved=str(session.save()))

    def _answer(self, points: Mapping[str, np.ndarray], *, settled: bool) -> None:
        self._count += 1
        places = {path: self._session.garments.index(path) for path in points}
        try:
            files = {path: self._points_file(places[path], each) for path, each in points.items()}
            faces = {path: self._faces_file(index) for path, index in places.items()}
        except OSError as error:
            self.say(error=f"cannot write {error.filename}: {error.strerror}")
        else:
            self.say(points=files, faces=faces, settled=settled, time=self._session.time)

    def _points_file(self, index: int, points: np.ndarray) -> str:
        """Write points into one of two files in turn; replacement is atomic."""
        level = len(self._session.refinements[index])
        file = self._folder / f"points-{index}-{level}-{self._count % 2}.npy"
        part = file.with_suffix(".part")
        with part.open("wb") as stream:
            np.save(stream, points.astype(np.float32))
        part.replace(file)
        return str(file)

    def _faces_file(self, index: int) -> str:
        """Write the faces of a garment's level once."""
        chain = self._session.refinements[index]
        mesh = chain[-1].mesh if chain else self._session.shot.scene.garments[index].mesh
        file = self._folder / f"faces-{index}-{len(chain)}.npz"
        if not file.exists():
            np.savez(file, counts=mesh.counts, indices=mesh.indices)
        return str(file)


def serve(session: TuneSession, stream: BinaryIO, lines: Iterator[bytes]) -> None:
    """Answer requests, a line each, until their end or until a request to quit.

    Raises:
        SolveError: The thread that solves has ended.
    """
    loop: SolveLoop | None = None
    with tempfile.TemporaryDirectory(prefix="physgraph-live-") as folder:
        answers = Answers(session, stream, Path(folder))
        try:
            for line in lines:
                try:
                    request = _parsed(line)
                    change = _in_turn(changes_in(request, session, save=answers.save))
                    if loop is None:
                        change(session)
                        loop = SolveLoop(session, answers)
                        loop.start()
                    else:
                        loop.ask(change)
                except PhysGraphError as error:
                    answers.fail(error)
                else:
                    if request.get("quit"):
                        break
            if loop is not None:
                _finish(loop)
        finally:
            if loop is not None:
                loop.close()


def _finish(loop: SolveLoop) -> None:
    """Wait until the loop has made all changes; their frame need not be solved."""
    done = threading.Event()
    loop.ask(lambda _: done.set())
    while not done.wait(POLL_SECONDS):
        leave_if_asked()
        if not loop.runs:
            raise SolveError("the thread that solves has ended; standard error has its last words")


def changes_in(request: Mapping[str, Any], session: TuneSession, *, save: Change) -> list[Change]:
    """Changes of a session, from a request.

    Raises:
        UsageError: A key, a garment, a name or a value cannot be used.
    """
    known = {
        "authored": _of_authored, "preset": _of_presets, "values": _of_values, "level": _of_levels,
        "time": _of_time, "contact": _of_contact, "save": lambda given, _: [save] if given else [],
        "quit": lambda *_: [],
    }  # fmt: skip
    for key in request:
        check_known("request", key, known)
    return [change for key, read in known.items() if key in request for change in read(request[key], session)]


@contextmanager
def answers_alone() -> Iterator[BinaryIO]:
    """Standard output for answers; other text, from libraries too, goes to standard error meanwhile."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    with os.fdopen(kept, "wb", buffering=0) as stream:
        try:
            yield stream
        finally:
            sys.stdout.flush()
            os.dup2(kept, 1)


def lines_of(descriptor: int) -> Iterator[bytes]:
    """Lines of a stream as they come, until the stream ends; signals are noticed while none comes."""
    rest = b""
    while True:
        leave_if_asked()
        if not select.select([descriptor], [], [], POLL_SECONDS)[0]:
            continue
        read = os.read(descriptor, 1 << 16)
        *whole, rest = (rest + (read or b"\n")).split(b"\n")
        yield from filter(bytes.strip, whole)
        if not read:
            return


def _parsed(line: bytes) -> Mapping[str, Any]:
    try:
        return _table(json.loads(line), "a request")
    except ValueError as error:
        raise UsageError(f"cannot read a request: {error}") from error


def _in_turn(changes: list[Change]) -> Change:
    def change(session: TuneSession) -> None:
        for each in changes:
            each(session)

    return change


def _table(given: Any, what: str) -> Mapping[str, Any]:
    if not isinstance(given, dict):
        raise UsageError(f"{what} must be an object, not {json.dumps(given)}")
    return given


def _number(given: Any, what: str) -> float:
    if isinstance(given, bool) or not isinstance(given, int | float) or not abs(given) <= sys.float_info.max:
        raise UsageError(f"{what} must be a number, not {json.dumps(given)}")
    return float(given)


def _checked(garment: Any, session: TuneSession) -> str:
    if garment not in session.garments:
        raise UsageError(f"no garment <{garment}>; garments: {', '.join(session.garments)}")
    return garment


def _check_limits(garment: str, name: str, value: float) -> None:
    """Refuse (UsageError) a value outside the schema's limits."""
    parse_overrides([f"{garment}.{GARMENT[name].name}={value!r}"])


def _of_authored(given: Any, session: TuneSession) -> list[Change]:
    if not isinstance(given, list):
        raise UsageError(f"authored must be a list of garments, not {json.dumps(given)}")
    return [methodcaller("set_as_authored", _checked(garment, session)) for garment in given]


def _of_presets(given: Any, session: TuneSession) -> list[Change]:
    for preset in _table(given, "preset").values():
        check_known("preset", preset, sorted(PRESETS))
    return [methodcaller("set_preset", _checked(garment, session), preset) for garment, preset in given.items()]


def _of_values(given: Any, session: TuneSession) -> list[Change]:
    found = list[Change]()
    for garment, values in _table(given, "values").items():
        for name, value in _table(values, f"values of <{_checked(garment, session)}>").items():
            check_known("value", name, TUNABLES)
            number = _number(value, name)
            _check_limits(garment, name, number)
            found.append(methodcaller("set_value", garment, name, number))
    return found


def _of_levels(given: Any, session: TuneSession) -> list[Change]:
    levels = {_checked(garment, session): _number(level, LEVEL) for garment, level in _table(given, "level").items()}
    for garment, level in levels.items():
        if level < 0:
            raise UsageError(f"level {level:g}: give 0 or more")
        _check_limits(garment, LEVEL, level)
    return [methodcaller("set_level", garment, int(level)) for garment, level in levels.items()]


def _of_time(given: Any, session: TuneSession) -> list[Change]:
    time = session.sampled(None if given is None else _number(given, "time"))
    return [methodcaller("set_time", time)]


def _of_contact(given: Any, _: TuneSession) -> list[Change]:
    if not isinstance(given, bool):
        raise UsageError(f"contact must be true or false, not {json.dumps(given)}")
    return [methodcaller("set_contact", given)]
