"""A process that stays and solves one frame again and again: `physgraph-usd live`; needs no Blender."""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

import numpy as np

from .command import PATIENCE_SECONDS, CommandError, Settings, start, words_in


@dataclass
class News:
    """The answers since the last call of `LiveProcess.news`; only the newest positions.

    Attributes:
        shot: Garments, time codes and levels of the shot, once, after reading; else empty.
        points: Files of positions [m], world space, by the garment's prim path.
        faces: Files of faces, alike.
        settled: Whether the newest positions are settled, as by `refine`; None without positions.
        errors: Errors in words.
        ended: Whether the process has ended.
    """

    shot: dict[str, Any] = field(default_factory=dict)
    points: dict[str, str] = field(default_factory=dict)
    faces: dict[str, str] = field(default_factory=dict)
    settled: bool | None = None
    errors: list[str] = field(default_factory=list)
    ended: bool = False


class LiveProcess:
    """A running `physgraph-usd live`.

    The process ends with its input, so also after a crash of Blender.

    Attributes:
        command: The command.
        log: File that its words go to.
    """

    def __init__(self, line: list[str], log: Path) -> None:
        """Start the process.

        Args:
            line: The command line.
            log: File that its words go to.

        Raises:
            CommandError: It cannot be started.
        """
        self.command, self.log, self._answers = line[0], log, queue.SimpleQueue[dict[str, Any] | None]()
        self._folder = ""
        with log.open("wb") as stream:
            self._process = start(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream)
        self._input, self._output = cast(BinaryIO, self._process.stdin), cast(BinaryIO, self._process.stdout)
        threading.Thread(target=self._read, name="physgraph live", daemon=True).start()

    @property
    def runs(self) -> bool:
        """Whether the process has not ended."""
        return self._process.poll() is None

    def send(self, request: Mapping[str, Any] | list[str]) -> None:
        """Send a request; ignored after the process has ended."""
        with suppress(BrokenPipeError, ValueError):
            self._input.write(json.dumps(request).encode() + b"\n")
            self._input.flush()

    def news(self) -> News:
        """The answers since the last call."""
        found = News()
        while True:
            try:
                answer = self._answers.get_nowait()
            except queue.Empty:
                return found
            if answer is None:
                found.ended = True
            elif "error" in answer:
                found.errors.append(answer["error"])
            elif "points" in answer:
                found.points |= answer["points"]
                found.faces |= answer["faces"]
                found.settled = answer["settled"]
            elif "garments" in answer:
                found.shot, self._folder = answer, answer["folder"]

    def last_words(self) -> str:
        """The process's words on standard error."""
        return words_in(self.log.read_text(encoding="utf-8", errors="replace"))

    def stop(self) -> threading.Thread:
        """End the process after its present step, or kill it after `PATIENCE_SECONDS`; returns the waiting thread."""
        with suppress(BrokenPipeError):
            self._input.close()
        thread = threading.Thread(target=self._end, name="physgraph live ends", daemon=True)
        thread.start()
        return thread

    def _read(self) -> None:
        with self._output:
            for line in self._output:
                try:
                    self._answers.put(json.loads(line))
                except ValueError:
                    self._answers.put({"error": line.decode(errors="replace").strip()})
        self._answers.put(None)

    def _end(self) -> None:
        try:
            self._process.wait(PATIENCE_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.log.unlink(missing_ok=True)
        if self._folder:  # A process that was killed leaves it.
            shutil.rmtree(self._folder, ignore_errors=True)


class Ahead:
    """A process that has loaded the solver before there is a shot, so that the first cloth need not wait for it.

    Attributes:
        process: The process, or None.
    """

    def __init__(self) -> None:
        """Start nothing yet."""
        self.process: LiveProcess | None = None
        self._known = ""

    def start(self, command: str) -> None:
        """Start the process, once for each command: one that cannot be started is not tried again."""
        if command != self._known:
            self.stop()
            self._known = command
            file, log = tempfile.mkstemp(prefix="physgraph-live-", suffix=".log")
            os.close(file)
            with suppress(CommandError):
                self.process = LiveProcess([command, "live", "-"], Path(log))

    def take(self, line: list[str], log: Path) -> LiveProcess:
        """The process, sent the arguments of a command line; a new one if none waits or it is of another command.

        Raises:
            CommandError: It cannot be started.
        """
        process, self.process, self._known = self.process, None, ""
        if process is not None and process.runs and process.command == line[0]:
            process.send(line[2:])
            return process
        if process is not None:
            process.stop()
        return LiveProcess(line, log)

    def stop(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.stop()
        self.process, self._known = None, ""


def request_for(settings: Settings, known: Settings, garments: Sequence[str]) -> dict[str, Any]:
    """The difference between two settings as a request; empty if they are equal.

    Args:
        settings: Values on the panel; a level of -1 changes nothing.
        known: Values in the process; without preset and values, the shot's own.
        garments: Prim paths.
    """
    found: dict[str, Any] = {}
    values = {name: value for name, value in settings.values.items() if known.values.get(name) != value}
    if settings.preset != known.preset or known.values.keys() - settings.values.keys():
        found["authored"], values = list(garments), dict(settings.values)
        if settings.preset:
            found["preset"] = dict.fromkeys(garments, settings.preset)
    if values:
        found["values"] = dict.fromkeys(garments, values)
    if settings.level not in (known.level, -1):
        found["level"] = dict.fromkeys(garments, settings.level)
    return found


class Faces(NamedTuple):
    """The faces of a fine mesh.

    Attributes:
        file: The file that holds them.
        starts: First corner of each face.
        corners: Vertex of each corner, faces one after another.
    """

    file: str
    starts: np.ndarray
    corners: np.ndarray


def faces_in(file: str) -> Faces:
    """Read a file of faces."""
    with np.load(file) as found:
        ends = np.cumsum(found["counts"])
        return Faces(file, (ends - found["counts"]).astype(np.int32), found["indices"])
