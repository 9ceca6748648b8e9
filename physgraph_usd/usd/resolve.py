"""Checks that files exist, by USD's asset resolver alone: the rest of pxr takes three times as long to import."""

from __future__ import annotations

from pathlib import Path

from pxr import Ar

from ..errors import AbsentError, StageError

IN_MEMORY = "anon:"
"""Prefix of the identifiers of layers in memory."""


def is_there(path: str | Path) -> bool:
    """Whether the asset resolver finds a file; in-memory layers count as found."""
    return str(path).startswith(IN_MEMORY) or bool(Ar.GetResolver().Resolve(str(path)))


def check_there(path: str | Path) -> None:
    """Check that a path names a file; in-memory layers pass.

    Raises:
        AbsentError: The file is missing.
        StageError: The path is a pipe or a folder.
    """
    if not is_there(path):
        raise AbsentError(f"no such file: {path}")
    if not str(path).startswith(IN_MEMORY):
        file = Path(str(Ar.GetResolver().Resolve(str(path))))
        if file.exists() and not file.is_file():
            raise StageError(f"{path} is no file" + (": it is a pipe, which has no end" if file.is_fifo() else ""))
