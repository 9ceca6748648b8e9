"""Locks a folder for one process at a time; the system releases the lock if the process dies."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from ..errors import LayerError
from ..usd.write.atomic import HOST, NO_LINK, check_no_link

LOCK = "run.lock"
"""The lock file; contains the name of the process that holds the lock."""
try:
    import fcntl
except ImportError:  # Windows has another module.
    import msvcrt

    def _hold(handle: int) -> None:
        os.lseek(handle, 1 << 20, os.SEEK_SET)  # locked bytes cannot be read
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
else:

    def _hold(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


class FolderLock:
    """A process's lock on a folder."""

    def __init__(self, folder: Path, *, layer: Path) -> None:
        """Lock a folder; created if missing.

        Args:
            folder: The folder.
            layer: The layer made in the folder, for the message.

        Raises:
            LayerError: A running process holds the lock.
            UsageError: The lock file is a link.
            OSError: The folder cannot be created or written.
        """
        self._file = folder / LOCK
        while True:
            folder.mkdir(exist_ok=True)
            check_no_link(self._file)
            self._handle = os.open(self._file, os.O_RDWR | os.O_CREAT | NO_LINK, 0o666)
            if not _held(self._handle):
                who = os.read(self._handle, 200).decode(errors="replace") or "another run"
                os.close(self._handle)
                raise LayerError(f"{layer} is being made by {who}; wait for it, end it, or name another layer")
            if _is_at(self._file, self._handle):
                break
            os.close(self._handle)  # The previous holder has removed the file.
        os.ftruncate(self._handle, 0)
        os.write(self._handle, f"process {os.getpid()} on {HOST}".encode())

    def release(self) -> None:
        """Release the lock; remove the folder if empty."""
        if os.name == "nt":  # Windows cannot remove an open file.
            os.close(self._handle)
        for remove in (self._file.unlink, self._file.parent.rmdir):
            with suppress(OSError):
                remove()
        if os.name != "nt":
            os.close(self._handle)


def is_held(folder: Path) -> bool:
    """Whether a running process holds a folder's lock."""
    try:
        handle = os.open(folder / LOCK, os.O_RDWR | NO_LINK)
    except OSError:
        return False
    try:
        return not _held(handle)
    finally:
        os.close(handle)


def _held(handle: int) -> bool:
    """Lock an open file unless already locked; on a file system without locks, always succeeds."""
    try:
        _hold(handle)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return True
    return True


def _is_at(file: Path, handle: int) -> bool:
    """Whether an open file is still the file at a path."""
    try:
        return os.path.samestat(os.fstat(handle), file.stat())
    except FileNotFoundError:
        return False
