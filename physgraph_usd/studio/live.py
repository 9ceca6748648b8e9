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
which changes nothing (the frame is answered again), and to a frame that cannot be solved.
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
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import PhysGraphError, SolveError, UsageError
from ..interrupts import leave_if_asked
from ..usd.lookup import check_known
from .loop import Change, SolveLoop, Watcher
from .session import TuneSession
from .takes import Shown

POLL_SECONDS = 0.1
"""Time between two questions whether a signal came [s]."""
FORMS: dict[str, Any] = {
    "authored": ["/World/Coat"], "preset": {"/World/Coat": "denim"}, "values": {"/World/Coat": {"density": 0.2}},
    "level": {"/World/Coat": 2.0}, "time": 12.0, "contact": True, "save": True, "quit": True,
}  # fmt: skip
"""An example of each part of a request."""


class Answers(Watcher):
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

    def seen(self, points: Mapping[str, np.ndarray]) -> None:
        """Answer with a round."""
        self._answer(points, settled=False)

    def show(self, shown: Shown) -> None:
        """Answer with a solved frame."""
        points = {path: garment.points for path, garment in zip(self._session.garments, shown.garments, strict=True)}
        self._answer({path: x for path, x in points.items() if x is not None}, settled=shown.settled)

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
                    asked = partial(change, request=(request := parsed(line)), save=answers.save)
                    if loop is None:
                        asked(session)
                        loop = SolveLoop(session, answers)
                        loop.start()
                    else:
                        loop.ask(asked)
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


def change(session: TuneSession, request: Mapping[str, Any], *, save: Change) -> None:
    """Do what a request of the form `FORMS` asks; ``save`` writes the layer.

    Raises:
        UsageError: A garment, a name or a value cannot be used; nothing is changed then.
        StageError, LayerError: The layer cannot be written.
    """
    before, time = session.setting, session.time
    wanted = session.sampled(request["time"]) if "time" in request else time
    try:
        for garment in request.get("authored", ()):
            session.set_as_authored(garment)
        for garment, preset in request.get("preset", {}).items():
            session.set_preset(garment, preset)
        for garment, values in request.get("values", {}).items():
            for name, value in values.items():
                session.set_value(garment, name, value)
        for garment, level in request.get("level", {}).items():
            session.set_level(garment, level)
    except UsageError:
        session.put(before, "refused")
        raise
    if wanted != time:
        session.set_time(wanted)
    if "contact" in request:
        session.set_contact(request["contact"])
    if request.get("save"):
        save(session)


def parsed(line: bytes) -> Mapping[str, Any]:
    """A request from a line of JSON.

    Raises:
        UsageError: It is not of the form `FORMS`.
    """
    try:
        request = json.loads(line)
        if not isinstance(request, dict):
            raise ValueError(f"{json.dumps(request)} is no object")
    except ValueError as error:
        raise UsageError(f"cannot read a request: {error}") from error
    for key, given in request.items():
        check_known("request", key, FORMS)
        if not _is_like(given, FORMS[key]):
            raise UsageError(f"{key} is {json.dumps(given)}; it must be like {json.dumps(FORMS[key])}")
    return request


def _is_like(given: Any, form: Any) -> bool:
    """Whether JSON has the form of an example, whose first part stands for all parts."""
    if isinstance(form, float):
        is_number = isinstance(given, int | float) and not isinstance(given, bool)
        return is_number and abs(given) <= float(np.finfo(np.float32).max)
    if not isinstance(given, type(form)) or not isinstance(form, dict | list):
        return isinstance(given, type(form))
    parts, forms = (each.values() if isinstance(each, dict) else each for each in (given, form))
    return all(_is_like(part, next(iter(forms))) for part in parts)


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
