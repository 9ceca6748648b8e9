"""What benchmarks print: lines, tables, and figures beside those of the paper."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Sequence
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


def say(line: str) -> None:
    """Write a line to standard output."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
