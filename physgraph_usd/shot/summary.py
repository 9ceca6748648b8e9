"""Summary of several shots: one row each, as JSON and as a table."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import PhysGraphError, UsageError
from ..usd.write.atomic import check_place, write_text
from ..version import __version__
from .frames import kept_for
from .plain_json import to_json
from .report import DONE, FAILED, FORMAT, IN_PART, RefineReport

SCHEMA = Path(__file__).with_name("summary.schema.json")


@dataclass(frozen=True)
class Row:
    """One shot.

    Attributes:
        shot: Input file.
        state: "done", "in part", "failed", "skipped" (the layer existed), "interrupted" (with frames kept) or "not
            done" (the batch was interrupted before a frame of the shot).
        exit_code: Exit code of the shot, or None if not done.
        frames: Number of requested time codes.
        failed_frames: Time codes without a sample.
        seconds_a_frame: Wall time [s], or None without frames.
        crossings: Edges through faces in the result, in all frames; None if not measured.
        error: The error, or "".
    """

    shot: str
    layer: str
    state: str = "not done"
    exit_code: int | None = None
    frames: int = 0
    failed_frames: tuple[str, ...] = ()
    seconds_a_frame: float | None = None
    crossings: int | None = None
    warnings: tuple[str, ...] = ()
    error: str = ""


def row_of(shot: str | Path, layer: Path, done: RefineReport | PhysGraphError | None) -> Row:
    """The row of a shot.

    Args:
        shot: Input file.
        done: The report, the error, or None if the batch was interrupted.
    """
    if done is None:
        folder_text = kept_for(layer)
        row = Row(str(shot), str(layer))
        return (
            replace(row, state="interrupted", frames=folder_text.frames, error=f"interrupted, {folder_text}")
            if folder_text
            else row
        )
    if isinstance(done, PhysGraphError):
        return Row(str(shot), str(layer), "failed", done.exit_code, error=str(done))
    frames = len(done.frames)
    return Row(
        str(shot),
        str(layer),
        "skipped" if done.skipped else {DONE: "done", IN_PART: "in part"}.get(done.exit_code, "failed"),
        done.exit_code,
        frames,
        tuple(done.failed),
        round(done.seconds["frames"] / frames, 4) if frames else None,
        done.crossings,
        tuple(done.warnings),
    )


def exit_code_of(rows: Sequence[Row]) -> int:
    """The exit code of a complete batch: the shots' code if all agree; 1 if all failed; else 3."""
    codes = {row.exit_code for row in rows}
    if len(codes) == 1 and (only := codes.pop()) is not None:
        return only
    return FAILED if all(row.state == "failed" for row in rows) else IN_PART


def json_of(rows: Sequence[Row], *, exit_code: int) -> str:
    """Rows as JSON that follows `SCHEMA`.

    Args:
        rows: A row per shot.
        exit_code: The exit code of the batch.
    """
    plain: dict[str, Any] = {"format": FORMAT, "version": __version__, "exit_code": exit_code}
    return to_json(plain | {"shots": [asdict(row) for row in rows]})


def write_summary(path: Path, rows: Sequence[Row], *, exit_code: int) -> None:
    """Write rows as JSON, whole or not at all.

    Args:
        rows: A row per shot.
        exit_code: The exit code of the batch.

    Raises:
        LayerError: The file cannot be written.
    """
    write_text(path, json_of(rows, exit_code=exit_code) + "\n")


def check_summary(path: Path, *, overwrite: bool) -> None:
    """Refuse a summary path holding a different file, or an unwritable path.

    Raises:
        UsageError: The file exists, is no summary and may not be replaced, or is a folder.
        LayerError: The folder cannot be written.
    """
    check_place(path)
    if path.exists() and not (overwrite or _is_summary(path)):
        raise UsageError(f"{path} exists and is no summary; choose another name or replace it by --overwrite")


def _is_summary(path: Path) -> bool:
    try:
        plain = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(plain, dict) and plain.keys() == {"format", "version", "exit_code", "shots"}


def table_of(rows: Sequence[Row]) -> list[str]:
    """Rows as lines of a table."""
    head = ("shot", "state", "frames", "wall s a frame", "crossings", "warnings", "exit code")
    cells = [head, *(_cells(row) for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(head))]
    return [
        "  ".join(cell.ljust(width) if column < 2 else cell.rjust(width) for column, (cell, width) in enumerate(pairs))
        for pairs in (tuple(zip(line, widths, strict=True)) for line in cells)
    ]


def _cells(row: Row) -> tuple[str, ...]:
    written = row.frames - len(row.failed_frames)
    frames = "" if not row.frames else str(written) if written == row.frames else f"{written} of {row.frames}"
    numbers = [
        "" if row.seconds_a_frame is None else f"{row.seconds_a_frame:.2f}",
        *("" if cell is None else str(cell) for cell in (row.crossings, len(row.warnings), row.exit_code)),
    ]
    return (Path(row.shot).name, row.state, frames, *numbers)
