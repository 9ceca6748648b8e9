"""Writes files atomically: a file is complete under its final name or absent.

A file is written next to its target under a temporary name with host and process id, flushed to disk, and moved over
the target in one step. A killed process can leave only the temporary file; the next run on the same host removes the
file. Temporary files of different hosts are never removed: their processes cannot be checked.
"""

from __future__ import annotations

import os
import re
import socket
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from ...errors import LayerError, UsageError

NO_LINK = getattr(os, "O_NOFOLLOW", 0)
"""Flag of `os.open` to refuse links; Windows has none."""
ASSET_PATHS = ("relative", "absolute")
"""Forms of a path in a file: relative to the file's folder, or absolute."""
FRAMES_SUFFIX = ".frames"
"""Suffix of the folder of a layer's finished frames, after the layer's name."""
HOST = re.sub(r"[^\w-]", "_", socket.gethostname()) or "host"
"""Name of this machine, for temporary file names."""


def temporary_path(target: Path, *, suffix: str = ".usdc") -> Path:
    """A temporary file beside its target: ``<target>.<host>.<pid>.tmp<suffix>``."""
    return target.with_name(f"{target.name}.{HOST}.{os.getpid()}.tmp{suffix}")


def prepare_target(target: Path, *, overwrite: bool) -> None:
    """Check that a target may be written, and remove temporary files left beside the target by dead processes.

    Raises:
        UsageError: The target exists and may not be replaced, or is a folder or a link.
        LayerError: The folder cannot be made.
    """
    check_no_link(target)
    if target.is_dir():
        raise UsageError(f"{target} is a folder; name a layer such as {target / 'refined.usdc'}")
    if target.exists() and not overwrite:
        raise UsageError(f"{target} exists; choose another name or replace it by --overwrite")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LayerError(f"cannot make the folder {target.parent}: {error.strerror}") from error
    remove_stale(target)


def remove_stale(target: Path) -> list[Path]:
    """Remove a target's temporary files made on this host by dead processes or by this process; returns the files."""
    pattern = re.compile(re.escape(f"{target.name}.{HOST}.") + r"(\d+)\.tmp(\.\w+)?")
    removed = []
    for path in sorted(target.parent.iterdir()):
        match = pattern.fullmatch(path.name)
        if match and not _is_other_process(int(match[1])):
            # Windows refuses to remove an open file.
            with suppress(OSError):
                path.unlink()
                removed.append(path)
    return removed


def _is_other_process(pid: int) -> bool:
    """Whether a different live process has the id; always False on Windows, where os.kill would end the process."""
    if pid == os.getpid() or os.name == "nt":
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def check_no_link(target: Path) -> None:
    """Refuse (UsageError) a link to a file, to a folder or to nothing; a link to a device is allowed."""
    if target.is_symlink() and (target.is_file() or target.is_dir() or not target.exists()):
        raise UsageError(f"{target} is a link to {os.readlink(target)}; name that, or remove the link")


def check_folder_of(target: Path) -> None:
    """Check that the folder of a file to be written exists.

    Raises:
        UsageError: The folder is missing.
    """
    folder = target.resolve().parent
    if not folder.is_dir():
        raise UsageError(f"the folder {folder} does not exist; make it, or name another by -o")


def make_file(path: Path) -> BinaryIO:
    """Open a file for writing, truncated; OSError for a link or an unwritable file."""
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | NO_LINK, 0o666), "wb")


def write_text(target: Path, text: str) -> None:
    """Write a text as UTF-8, whole or not at all (LayerError); creates the folder if missing."""
    temporary = temporary_path(target, suffix="")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with make_file(temporary) as stream:
            stream.write(text.encode())
        publish(temporary, target)
    except OSError as error:
        raise LayerError(f"cannot write {target}: {error.strerror}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def check_place(target: Path) -> None:
    """Refuse a path where no file can be created later; the folder may be missing.

    Raises:
        UsageError: The target is a folder or a link, or a file stands where a folder is needed.
        LayerError: The folder cannot be written.
    """
    check_no_link(target)
    folder = next(parent for parent in target.absolute().parents if parent.exists())
    if target.is_dir() or not folder.is_dir():
        raise UsageError(f"cannot write {target}: it is a folder, or {folder} is none")
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise LayerError(f"cannot write {target}: {error.strerror} in {folder}") from error


def publish(temporary: Path, target: Path) -> None:
    """Flush a finished temporary file to the disk and move it over the target in the same folder.

    Raises:
        LayerError: The disk is full or the target is held open by another program.
    """
    try:
        _flush(temporary)
        temporary.replace(target)
        if os.name != "nt":
            _flush(target.parent)
    except OSError as error:
        raise LayerError(f"cannot write {target}: {error.strerror}; nothing was left under that name") from error


def _flush(path: Path) -> None:
    flags = os.O_RDONLY if os.name != "nt" else os.O_RDWR
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
