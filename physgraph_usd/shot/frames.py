"""Stores the finished frames of a run in a folder: the frames survive an interruption, and `stitch` joins them.

The folder holds one file per frame, complete or absent, and `RUN`, a record of everything the frames depend on. The
folder beside a layer is removed only once the layer is complete under its name; a chunk's folder stays. One run locks
the folder.
"""

from __future__ import annotations

import errno
import json
import os
import re
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from filelock import BaseFileLock, FileLock, Timeout

from ..errors import LayerError, UsageError, counted
from ..solver.scene import GarmentResult, Result
from ..usd.write.atomic import FRAMES_SUFFIX, HOST, check_no_link, make_file, temporary_path, write_text

RUN = "run.json"
"""File with a record of everything the frames depend on."""
LOCK = "run.lock"
"""File locked by the run that writes the folder; holds the name of the run's process. The system unlocks the file when
the process dies, and a file server when a machine dies."""
LOCK_SECONDS = 1.0
"""Longest wait for a run that is about to unlock the folder [s]."""
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)
"""Errors of file systems without locks; a run works there unlocked."""
CHUNK = "chunk"
"""Entry in a chunk's record: number of the first frame, and of the frame after the last."""
_DONE, _FAILED = ".npz", ".failed.npz"
_DAMAGED = (OSError, ValueError, KeyError, TypeError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""Errors of numpy and zipfile when reading a file not written by `FrameFolder.write`."""
_NAME = re.compile(r"(\d+)(?:\.before(\d+))?(\.failed)?\.npz")
"""Name of a frame's file: number, number of the first frame after the pre-roll if in one, and whether it failed."""
_OURS = re.compile(rf"({_NAME.pattern}|run\.json)(\.[\w-]+\.\d+\.tmp)?")
"""File names of finished frames and of the record, including temporary names while writing."""


def frames_folder(layer: Path) -> Path:
    """The folder of a layer's finished frames."""
    return layer.with_name(layer.name + FRAMES_SUFFIX)


@dataclass(frozen=True)
class Kept:
    """Finished frames of an incomplete run.

    Attributes:
        frames: Number of finished frames.
        of: Number of frames of the run.
    """

    folder: Path
    frames: int
    of: int

    def __str__(self) -> str:
        """Number of kept frames, folder, and the option that resumes the run."""
        are, them = ("is", "it") if self.frames == 1 else ("are", "them")
        frames = f"{self.frames} of {counted(self.of, 'frame')}"
        return f"{frames} {are} kept in {self.folder}; --resume goes on from {them}"


def kept_for(out: Path) -> Kept | None:
    """Finished frames beside a layer, or in an incomplete chunk's folder; None without any, or while a run goes on."""
    folder = out if out.is_dir() else frames_folder(out)
    run = record_in(folder)
    first, stop = run.get(CHUNK) or (0, len(run.get("times", ())))
    count = len(Finished(folder).kept)
    if not count or (CHUNK in run and count == stop - first) or _is_locked(folder):
        return None
    return Kept(folder, count, stop - first)


def _lock(folder: Path) -> BaseFileLock:
    """The lock of a folder, not yet acquired."""
    return FileLock(folder / LOCK, timeout=LOCK_SECONDS, thread_local=False, fallback_to_soft=False)


def _is_locked(folder: Path) -> bool:
    """Whether a running process holds the lock of a folder."""
    if not (folder / LOCK).is_file():
        return False
    try:
        with _lock(folder):
            return False
    except OSError as error:
        return isinstance(error, Timeout)


def record_in(folder: Path) -> dict[str, Any]:
    """The record of the run that wrote a folder; empty if missing."""
    try:
        record = json.loads((folder / RUN).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


class Finished:
    """Finished frames in a folder, read-only.

    Attributes:
        kept: Numbers of the complete, successful frames.
        failed: Numbers of the frames that failed.
        seams: By number of the first frame after a seam of two processes, number of the first frame of its pre-roll.
    """

    def __init__(self, folder: Path, *, counts: Sequence[int] = ()) -> None:
        """List the finished frames; ``counts`` as in `FrameFolder`."""
        self.folder, self.counts = folder, tuple(counts)
        self._list()

    def _list(self) -> None:
        names = [match for file in self.folder.glob("*") if (match := _NAME.fullmatch(file.name))]
        readable = [match for match in names if zipfile.is_zipfile(self.folder / match[0])]
        self.kept = frozenset(int(match[1]) for match in readable if not match[2] and not match[3])
        self.failed = frozenset(int(match[1]) for match in readable if not match[2] and match[3])
        preroll_ends: dict[int, int] = {}
        for seam, index in sorted(((int(match[2]), int(match[1])) for match in readable if match[2]), reverse=True):
            if index + 1 == preroll_ends.get(seam, seam):
                preroll_ends[seam] = index
        self.seams = {seam: first for seam, first in preroll_ends.items() if seam in self.kept}

    def _file(self, index: int, seam: int | None, suffix: str) -> Path:
        return self.folder / (f"{index}" + ("" if seam is None else f".before{seam}") + suffix)

    def read(self, index: int, time: float | None, *, seam: int | None = None) -> Result | None:
        """A frame's result, or None if not finished; ``seam`` as in `write`.

        Raises:
            LayerError: The file is damaged.
        """
        files = (self._file(index, seam, suffix) for suffix in (_DONE, _FAILED))
        file = next((candidate for candidate in files if candidate.exists()), None)
        if file is None:
            return None
        try:
            with np.load(file) as data:
                record = json.loads(str(data["record"]))
                garments = tuple(_garment(data, k, entry) for k, entry in enumerate(record["garments"]))
            self._check_points(garments)
        except _DAMAGED as error:
            raise LayerError(f"{file} is damaged ({error}); remove it and --resume") from error
        return Result(time, garments, record["telemetry"])

    def _check_points(self, garments: Sequence[GarmentResult]) -> None:
        """Refuse (ValueError) points of the wrong shape: kernels index points by face corners, without checks."""
        if garments and self.counts and len(garments) != len(self.counts):
            raise ValueError(f"points of {len(garments)} garments, not of {len(self.counts)}")
        for index, count in enumerate(self.counts if garments else ()):
            points = garments[index].points
            if points is not None and (
                points.shape != (count, 3) or points.dtype.kind != "f" or not np.isfinite(points).all()
            ):
                raise ValueError(f"points of shape {points.shape}, not {count} finite positions")


class FrameFolder(Finished):
    """A run's folder; a context manager that keeps frames if the run fails or the folder is a chunk.

    Attributes:
        kept: Numbers of the frames reused from an interrupted run.
        dropped: Number of finished frames of the same run solved anew.
    """

    def __init__(
        self,
        folder: Path,
        run: Mapping[str, Any],
        *,
        counts: Sequence[int] = (),
        resume: bool = False,
        drop: bool = False,
        keep: bool = True,
        stays: bool = False,
    ) -> None:
        """Take a folder for a run, empty or with the frames of an interrupted run.

        Args:
            folder: The folder; created if missing.
            run: Everything the frames depend on, ready for JSON.
            counts: Number of fine vertices of each garment; a frame with a different count is damaged.
            resume: Use existing finished frames.
            drop: Remove existing finished frames of any run.
            keep: Keep finished frames when the run is interrupted.
            stays: Keep finished frames after the run too, and drop none unasked: the folder is a chunk for `stitch`.

        Raises:
            UsageError: The folder holds finished frames of a different run, or foreign files.
            LayerError: The folder cannot be created, or is locked by a running process.
        """
        super().__init__(folder, counts=counts)
        self._keep, self._stays = keep, stays
        try:
            self._check_ours()
            self._lock = self._locked()
            with ExitStack() as unless_taken:
                unless_taken.callback(self._release)
                self._take(json.loads(json.dumps(run)), resume=resume, drop=drop)
                unless_taken.pop_all()
        except OSError as error:
            raise LayerError(f"cannot write {folder}: {error.strerror}") from error

    def _locked(self) -> BaseFileLock:
        """Lock the folder; created if missing."""
        self.folder.mkdir(exist_ok=True)
        file, lock = self.folder / LOCK, _lock(self.folder)
        layer = self.folder.with_name(self.folder.name.removesuffix(FRAMES_SUFFIX))
        check_no_link(file)
        try:
            lock.acquire()
            if not file.is_file():
                lock.release()
                raise FileNotFoundError(file)
            with suppress(OSError):  # Windows refuses to write a locked file.
                file.write_text(f"process {os.getpid()} on {HOST}", encoding="utf-8")
        except FileNotFoundError as error:  # The other run was complete, and removed the folder.
            fault = f"{layer} was made by another run meanwhile; run again, with --resume to keep it"
            raise LayerError(fault) from error
        except Timeout as timeout:
            owner = "another run"
            with suppress(OSError, ValueError):
                owner = file.read_text(encoding="utf-8") or owner
            raise LayerError(
                f"{layer} is being made by {owner}; wait for it, end it, or name another layer"
            ) from timeout
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        return lock

    def _release(self) -> None:
        """Unlock the folder; remove the folder if empty."""
        with suppress(OSError):  # Windows removes the file when it is unlocked.
            (self.folder / LOCK).unlink()
        self._lock.release()
        with suppress(OSError):
            self.folder.rmdir()

    def _take(self, wanted: dict[str, Any], *, resume: bool, drop: bool) -> None:
        """Use or drop existing frames; frames that failed, or whose files a crash cut short, are solved again."""
        self._list()
        finished, holds = len(self.kept), f"{self.folder} holds {counted(len(self.kept), 'finished frame')}"
        different = sorted(differences(record_in(self.folder), wanted)) if finished else []
        if different and (resume or not drop):
            remedy = "refine as then, or drop them by --overwrite without --resume"
            raise UsageError(f"{holds} of a run with other {', '.join(different[:3])}; {remedy}")
        if finished and self._stays and not (resume or drop):
            raise UsageError(f"{holds}; go on by --resume, or drop them by --overwrite")
        self.dropped = 0 if resume or different else finished
        if not (finished and resume):
            self._clear()
        for file in self.folder.glob(f"*{_DONE}"):
            if file.name.endswith(_FAILED) or not zipfile.is_zipfile(file):
                file.unlink()
        self._list()
        self._run = json.dumps(wanted, indent=2) + "\n"
        write_text(self.folder / RUN, self._run)

    def _check_ours(self) -> None:
        """Refuse a folder with foreign files, because the folder is emptied once the layer is complete."""
        names = {file.name for file in self.folder.glob("*")}
        foreign = sorted(name for name in names if name not in (RUN, LOCK) and not _OURS.fullmatch(name))
        if foreign or (names and not names & {RUN, LOCK}):
            example = f"; {foreign[0]} is not a file of ours" if foreign else ""
            raise UsageError(
                f"{self.folder} is no folder of finished frames{example}; choose another name for the layer"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Store the absolute path, for processes with a different working directory."""
        return self.__dict__ | {"folder": self.folder.absolute(), "_lock": None}

    def write(self, index: int, result: Result, *, seam: int | None = None) -> None:
        """Write a frame's result.

        Args:
            index: Number of the frame.
            seam: Number of the frame whose pre-roll the result belongs to, or None.

        Raises:
            LayerError: The disk is full, or the folder is gone or taken by a new run: a task on a remote machine may
                outlast its run.
        """
        arrays = dict[str, Any]()
        for k, garment in enumerate(result.garments):
            arrays |= {} if garment.points is None else {f"points{k}": garment.points}
            arrays |= {f"heat{k}.{name}": values for name, values in garment.heat.items()}
        entries = [{"telemetry": garment.telemetry, "reused": garment.reused} for garment in result.garments]
        record = json.dumps({"telemetry": result.telemetry, "garments": entries})
        file = self._file(index, seam, _DONE if result.garments else _FAILED)
        temporary = temporary_path(file, suffix="")
        try:
            if (self.folder / RUN).read_text(encoding="utf-8") != self._run:
                raise LayerError(f"{self.folder} is another run's by now")
            with make_file(temporary) as stream:
                np.savez(stream, record=record, **arrays)
            temporary.replace(file)
        except OSError as error:
            raise LayerError(f"cannot write {file}: {error.strerror}") from error
        finally:
            temporary.unlink(missing_ok=True)

    def _clear(self) -> None:
        """Remove our files except the lock file."""
        for file in self.folder.glob("*"):
            if file.name == RUN or _OURS.fullmatch(file.name):
                file.unlink(missing_ok=True)

    def __enter__(self) -> FrameFolder:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Keep the frames of a failed run unless ``keep`` is False; release the folder."""
        try:
            done = kind is None and not self._stays
            if done or (kind and not (self._keep or self.kept)) or not Finished(self.folder).kept:
                self._clear()
        finally:
            self._release()


def _garment(data: Mapping[str, np.ndarray], index: int, entry: Mapping[str, Any]) -> GarmentResult:
    """The result of one garment in a frame's file."""
    prefix = f"heat{index}."
    heat = {name.removeprefix(prefix): data[name] for name in data if name.startswith(prefix)}
    return GarmentResult(data.get(f"points{index}"), entry["telemetry"], entry["reused"], heat)


def differences(stored: Any, wanted: Any, name: str = "") -> list[str]:
    """Names of the entries in which two records differ."""
    if isinstance(stored, dict) and isinstance(wanted, dict):
        return [
            difference
            for key in {*stored, *wanted}
            for difference in differences(stored.get(key), wanted.get(key), key)
        ]
    return [] if stored == wanted else [name]
