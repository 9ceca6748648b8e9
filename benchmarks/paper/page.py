"""The page of the paper's results: its parts, a journal of what was measured, and Markdown."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click

from benchmarks.rows import Row, commit
from physgraph_usd import __version__
from physgraph_usd.solver.integrate.weights import NETWORKS

HEAD = ("| what | the paper | target | ours | |", "|---|---|---|---|---|")
TEXT = """# The paper's results

Written by `python -m benchmarks.paper{form}` in {minutes:.0f} minutes of processor time ({machine}, version
{version}, commit {commit}). {long} The paper is "PhysGraph: Physics-Based Cloth Enhancement Using Graph Neural
Networks". Its shirt, its body and its motions are not free: each part says what stands in their place. "-" is where the
paper gives no figure, or nothing was aimed at.

**{met} of {counted} figures with a target meet it.** Weights of the learned integrators: {weights}.
"""


@dataclass(frozen=True)
class Part:
    """One measurement of the page.

    Attributes:
        name: Its key in the journal and on the command line.
        title: The heading.
        measure: Takes whether the short form is wanted.
        longer: Time of the long form over the short one's, about, by its steps, frames and levels.
    """

    name: str
    title: str
    measure: Callable[[bool], list[Row]]
    longer: float = 3.0


class Journal:
    """Parts that were measured, in a file that grows; with --fresh, or by other code, everything is measured anew."""

    def __init__(self, file: Path, key: dict[str, Any], *, fresh: bool) -> None:
        """Open it.

        Args:
            file: The file; made where it is not there.
            key: What was measured with; parts of another key do not count.
            fresh: Drop what is there.
        """
        self._file, self._key = file, key
        file.parent.mkdir(parents=True, exist_ok=True)
        if fresh or not file.exists():
            file.write_text("", encoding="utf-8")

    def read(self) -> dict[str, dict[str, Any]]:
        """What is known, by the parts' names."""
        whole = [line for line in self._file.read_text(encoding="utf-8").splitlines(keepends=True) if line[-1] == "\n"]
        rows = [json.loads(line) for line in whole]
        return {row["part"]: row for row in rows if row["key"] == self._key}

    def add(self, name: str, rows: Sequence[Row], seconds: float) -> None:
        """Keep a part."""
        text = self._file.read_text(encoding="utf-8")
        row = {"part": name, "key": self._key, "seconds": round(seconds, 1), "rows": [asdict(each) for each in rows]}
        whole = text[: text.rfind("\n") + 1]  # What was cut off by the end of an earlier run is dropped.
        self._file.write_text(whole + json.dumps(row) + "\n", encoding="utf-8")


def run(parts: Sequence[Part], journal: Journal, *, short: bool) -> dict[str, dict[str, Any]]:
    """Measure the parts that the journal does not know; returns all that it knows then."""
    for part in parts:
        if part.name in journal.read():
            click.echo(f"{part.name}: known", err=True)
            continue
        click.echo(f"{part.name} ...", err=True)
        began = time.process_time() + _children()
        rows = part.measure(short)
        journal.add(part.name, rows, time.process_time() + _children() - began)
    return journal.read()


def page(parts: Sequence[Part], known: dict[str, dict[str, Any]], *, short: bool) -> str:
    """The page in Markdown."""
    shown = [(part, known[part.name]) for part in parts if part.name in known]
    verdicts = [row["met"] for _, each in shown for row in each["rows"] if row["met"] is not None]
    seconds = sum(each["seconds"] for _, each in shown)
    longer = sum(part.longer * each["seconds"] for part, each in shown) / 60.0
    head = TEXT.format(
        form=" --short" if short else "",
        minutes=seconds / 60.0,
        long=f"The long form takes about {longer:.0f}, by its steps, frames and levels." if short else "",
        machine=f"{platform.machine()}, CPU",
        version=__version__,
        commit=commit(),
        met=sum(map(bool, verdicts)),
        counted=len(verdicts),
        weights=", ".join(hashes()) or "none",
    )
    return "\n".join([head, *(line for part, each in shown for line in section(part, each, short=short))])


def section(part: Part, known: dict[str, Any], *, short: bool) -> Iterator[str]:
    """The lines of a part: its heading, its command and rows."""
    yield f"## {part.title}\n"
    yield f"`python -m benchmarks.paper --only {part.name}{' --short' if short else ''}` ({known['seconds']:.0f} s)\n"
    yield from HEAD
    yield from (Row(**row).line() for row in known["rows"])
    yield ""


def hashes() -> Iterator[str]:
    """Names and the first digits of the hashes of the weights that ship."""
    for file in sorted(kind.file for kind in NETWORKS.values()):
        yield f"`{file.stem}` {hashlib.sha256(file.read_bytes()).hexdigest()[:12]}"


def _children() -> float:
    """Processor time of the processes that were waited for [s]."""
    spent = os.times()
    return spent.children_user + spent.children_system
