"""What benchmarks print: lines, tables, and figures beside those of the paper."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Row:
    """One figure beside the paper's.

    Attributes:
        what: What it is, with its unit.
        ours: Our figure.
        paper: The paper's, "-" where it gives none.
        target: What we set out for, "-" where nothing was said.
        met: Whether our figure meets the target; None where there is none.
    """

    what: str
    ours: str
    paper: str = "-"
    target: str = "-"
    met: bool | None = None

    def line(self) -> str:
        """The row in Markdown."""
        verdict = {True: "met", False: "**missed**", None: ""}[self.met]
        return f"| {self.what} | {self.paper} | {self.target} | {self.ours} | {verdict} |"


def under(what: str, value: float, most: float, *, unit: str = "", paper: str = "-", digits: str = ".3g") -> Row:
    """A figure that must not be over a bound; NaN is."""
    return Row(what, f"{value:{digits}}{unit}", paper, f"at most {most:g}{unit}", bool(value <= most))


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table in Markdown."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join(lines + [f"| {' | '.join(map(str, row))} |" for row in rows])


def code_of(*places: Path) -> str:
    """The first digits of a hash of some files, and of the code in some folders: other code has another."""
    digest = hashlib.sha256()
    for place in places:
        for file in [place] if place.is_file() else sorted(place.rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def commit(*folders: str) -> str:
    """The commit of this checkout, and whether the package or a folder was changed since; "no commit" without one."""
    root = Path(__file__).resolve().parents[1]
    asked = (["rev-parse", "--short=10", "HEAD"], ["status", "--porcelain", "--", "physgraph_usd", *folders])
    ran = [subprocess.run(["git", *line], cwd=root, capture_output=True, text=True, check=False) for line in asked]
    head, changed = (each.stdout.strip() for each in ran)
    return f"{head or 'no commit'}{', with changes' if changed else ''}"


class Journal:
    """Measurements by name in a file that grows: a program that was stopped goes on where it was."""

    def __init__(self, file: Path | None, *, fresh: bool = False) -> None:
        """Read what is known.

        Args:
            file: The file, a line a measurement; None keeps nothing.
            fresh: Drop what is there.
        """
        self._file = file
        self._known: dict[str, tuple[Any, float]] = {}
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            text = file.read_text(encoding="utf-8") if file.exists() and not fresh else ""
            whole = text[: text.rfind("\n") + 1]  # The end of a run may have cut off the last line.
            file.write_text(whole, encoding="utf-8")
            self._known = {name: (value, seconds) for name, value, seconds in map(json.loads, whole.splitlines())}

    def get(self, name: str, measure: Callable[[], Any]) -> Any:
        """A measurement, of plain values, made where it is not known."""
        if name not in self._known:
            began = _processor()
            value = json.loads(json.dumps(measure()))
            self._known[name] = value, round(_processor() - began, 2)
            if self._file is not None:
                with self._file.open("a", encoding="utf-8") as file:
                    file.write(json.dumps([name, *self._known[name]]) + "\n")
        return self._known[name][0]

    def seconds(self, name: str | None = None) -> float:
        """Processor time of a measurement, or of all that are known [s]."""
        return sum(spent for each, (_, spent) in self._known.items() if name in (None, each))


def _processor() -> float:
    """Processor time of this process and of the processes that it has waited for [s]."""
    spent = os.times()
    return time.process_time() + spent.children_user + spent.children_system


def say(line: str) -> None:
    """Write a line to standard output."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
