"""Rows of the page of results: what was measured, the paper's figure, ours, and whether it was met."""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from physgraph_usd.shot.solve import prepare_device

HEAD = ("| what | the paper | target | ours | |", "|---|---|---|---|---|")


@dataclass(frozen=True)
class Row:
    """One figure.

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


@dataclass(frozen=True)
class Found:
    """What a measurement found.

    Attributes:
        rows: Its figures.
        notes: Paragraphs and tables in Markdown that say how to read them.
        picture: Picture that it drew, relative to the page, or "".
    """

    rows: list[Row]
    notes: list[str] = field(default_factory=list)
    picture: str = ""

    def plain(self) -> dict[str, Any]:
        """Ready for JSON."""
        return asdict(self)

    @staticmethod
    def of(plain: dict[str, Any]) -> Found:
        """What `plain` gave."""
        return Found([Row(**row) for row in plain["rows"]], plain["notes"], plain["picture"])


@dataclass(frozen=True)
class Part:
    """One measurement of the page.

    Attributes:
        name: Its key in the journal and on the command line.
        title: The heading.
        command: What measures it alone.
        measure: Takes whether the short form is wanted.
        longer: Time of the long form over the short one's, about, by its steps, frames and levels.
    """

    name: str
    title: str
    command: str
    measure: Callable[[bool], Found]
    longer: float = 3.0


def under(what: str, value: float, most: float, *, unit: str = "", paper: str = "-", digits: str = ".3g") -> Row:
    """A figure that must not be over a bound; NaN is."""
    return Row(what, f"{value:{digits}}{unit}", paper, f"at most {most:g}{unit}", bool(value <= most))


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table in Markdown."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join(lines + [f"| {' | '.join(map(str, row))} |" for row in rows])


def show(found: Found) -> None:
    """Write a measurement to standard output."""
    say("\n".join([*HEAD, *(row.line() for row in found.rows)]))
    for note in found.notes:
        say(f"\n{note}")
    if found.picture:
        say(f"\npicture {found.picture}")


def code_of(*folders: Path) -> str:
    """The first digits of a hash of the code in some folders: what another code measured does not count."""
    digest = hashlib.sha256()
    for folder in folders:
        for file in sorted(folder.rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def say(line: str) -> None:
    """Write a line to standard output."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def run_alone(measure: Callable[[bool], Found]) -> None:
    """The command of one measurement: prints its rows."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--long", action="store_true", help="measure more")
    given = parser.parse_args()
    prepare_device("cpu")
    with torch.no_grad():
        show(measure(not given.long))
