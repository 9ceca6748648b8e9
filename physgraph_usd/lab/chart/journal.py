"""The rows of a chart in a growing file: a stopped run continues from the last row."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ...errors import UsageError

NAME = "chart.rows.jsonl"
KINDS = ("problem", "plan", "reference", "point", "warm", "failed", "term")
"""Kinds of rows."""
REMEDY = "take that line out, or measure anew with --overwrite"


class Journal:
    """Rows of plain values, a row per line, written immediately after measurement."""

    def __init__(self, folder: Path, problem: dict[str, Any], *, overwrite: bool) -> None:
        """Open the rows of a folder; rows of a different problem are dropped with ``overwrite``.

        Raises:
            UsageError: The folder holds the rows of another problem, or a row is damaged.
        """
        self._file = folder / NAME
        self._rows: list[dict[str, Any]] = []
        if self._file.exists() and not overwrite:
            self._rows = list(self._read())
        if not self._rows:
            self._file.write_text("", encoding="utf-8")
            self.add("problem", problem=problem)
        elif self._rows[0].get("problem") != json.loads(json.dumps(problem)):
            raise UsageError(
                f"{self._file} holds the chart of another shot or of other options; choose another folder or overwrite"
            )

    def add(self, kind: str, /, **values: Any) -> dict[str, Any]:
        """Write a row and return the row."""
        row = {"row": kind, **values}
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        self._rows.append(row)
        return row

    def rows(self, kind: str, /, **where: Any) -> list[dict[str, Any]]:
        """The rows of a kind that have the given values."""
        return [r for r in self._rows if r["row"] == kind and all(r.get(k) == v for k, v in where.items())]

    def one(self, kind: str, /, **where: Any) -> dict[str, Any] | None:
        """The first matching row, or None."""
        return next(iter(self.rows(kind, **where)), None)

    def _read(self) -> Iterator[dict[str, Any]]:
        """The whole rows of the file; a last line that was cut off is dropped from it."""
        data = self._file.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if whole != data:
            self._file.write_bytes(whole)
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                row = json.loads(line)
            except (ValueError, RecursionError) as error:
                raise UsageError(f"{self._file}, line {number}, is damaged; {REMEDY}") from error
            if not isinstance(row, dict) or row.get("row") not in KINDS:
                raise UsageError(f"{self._file}, line {number}, is no row of a chart; {REMEDY}")
            yield row
