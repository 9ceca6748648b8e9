"""The page of the paper's results: its parts, a journal of what was measured, and Markdown."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass

import click

from benchmarks.rows import Journal, Row, commit
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


def run(parts: Sequence[Part], journal: Journal, *, short: bool) -> dict[str, list[Row]]:
    """Rows of each part, measured where the journal does not know them."""
    found = {}
    for part in parts:
        click.echo(f"{part.name} ...", err=True)
        rows = journal.get(part.name, lambda part=part: [asdict(each) for each in part.measure(short)])
        found[part.name] = [Row(**row) for row in rows]
    return found


def page(parts: Sequence[Part], journal: Journal, *, short: bool) -> str:
    """The page in Markdown."""
    rows = run(parts, journal, short=short)
    verdicts = [row.met for each in rows.values() for row in each if row.met is not None]
    seconds = {part.name: journal.seconds(part.name) for part in parts}
    longer = sum(part.longer * seconds[part.name] for part in parts) / 60.0
    head = TEXT.format(
        form=" --short" if short else "",
        minutes=sum(seconds.values()) / 60.0,
        long=f"The long form takes about {longer:.0f}, by its steps, frames and levels." if short else "",
        machine=f"{platform.machine()}, CPU",
        version=__version__,
        commit=commit(),
        met=sum(map(bool, verdicts)),
        counted=len(verdicts),
        weights=", ".join(hashes()) or "none",
    )
    lines = [line for part in parts for line in section(part, rows[part.name], seconds[part.name], short=short)]
    return "\n".join([head, *lines])


def section(part: Part, rows: Sequence[Row], seconds: float, *, short: bool) -> Iterator[str]:
    """The lines of a part: its heading, its command and rows."""
    yield f"## {part.title}\n"
    yield f"`python -m benchmarks.paper --only {part.name}{' --short' if short else ''}` ({seconds:.0f} s)\n"
    yield from HEAD
    yield from (row.line() for row in rows)
    yield ""


def hashes() -> Iterator[str]:
    """Names and the first digits of the hashes of the weights that ship."""
    for file in sorted(kind.file for kind in NETWORKS.values()):
        yield f"`{file.stem}` {hashlib.sha256(file.read_bytes()).hexdigest()[:12]}"
