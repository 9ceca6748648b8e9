"""The paper's results, each with its command, its figure and ours: writes docs/notes/results.md.

    python -m benchmarks.results [--short] [--whole] [-o docs/notes/results.md] [--only NAME] [--fresh]

With --whole the page also says what was done, with tables.

Each part is measured by a command of its own, which stands beside its figures. What was measured lies in a journal, a
part the moment it is known: a run that was stopped goes on where it was, while the code is the same. The short form
takes less than 15 minutes on two cores and writes how long the long form takes. GPU rows of the timing table are read
from docs/figures/step_cuda.json, which `python -m benchmarks.step_rows --device cuda --json FILE` writes.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import torch

import physgraph_usd
from benchmarks import (
    contact_rows,
    convergence,
    forces_ablation,
    loose_garment,
    material_grid,
    potentials,
    skinning_repair,
    step_rows,
    temporal,
)
from benchmarks.rows import HEAD, Found, Part, code_of
from physgraph_usd import __version__
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.integrate.weights import KINDS

PAGE = Path("docs/notes/results.md")
CACHE = Path("build")
"""Folder of the journals."""
PARTS = (
    Part("potentials", "Potentials and body collision", "benchmarks.potentials", potentials.measure),
    Part("timing", "Time", "benchmarks.step_rows", step_rows.measure, 30.0),
    Part("convergence", "Convergence", "benchmarks.convergence --rows", convergence.rows, 2.0),
    Part("forces", "Forces, one after another", "benchmarks.forces_ablation", forces_ablation.measure, 4.0),
    Part("loose", "A loose garment against a converged solve", "benchmarks.loose_garment", loose_garment.measure),
    Part("skinning", "Linear-blend skinning repaired", "benchmarks.skinning_repair", skinning_repair.measure, 5.0),
    Part("materials", "Materials", "benchmarks.material_grid", material_grid.measure, 4.0),
    Part("colliders", "Block and torus", "benchmarks.contact_rows colliders", contact_rows.colliders),
    Part("itself", "Self collision", "benchmarks.contact_rows itself", contact_rows.itself),
    Part("several", "Several garments", "benchmarks.contact_rows several", contact_rows.several, 10.0),
    Part("temporal", "A sequence", "benchmarks.temporal --rows", temporal.rows, 4.0),
)
"""The page, from top to bottom."""

TEXT = """# The paper's results

Written by `python -m benchmarks.results{form}` in {minutes:.0f} minutes of processor time ({machine}, version
{version}). {long} The paper is "PhysGraph: Physics-Based Cloth Enhancement Using Graph Neural Networks". Its shirt, its
body and its motions are not free: each part says what stands in their place. "-" is where the paper gives no figure, or
nothing was aimed at.

**{met} of {counted} figures with a target meet it.** Weights of the learned integrators: {weights}.
"""


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

    def add(self, name: str, found: Found, seconds: float) -> None:
        """Keep a part."""
        text = self._file.read_text(encoding="utf-8")
        row = {"part": name, "key": self._key, "seconds": round(seconds, 1), "found": found.plain()}
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
        found = part.measure(short)
        journal.add(part.name, found, time.process_time() + _children() - began)
    return journal.read()


def page(parts: Sequence[Part], known: dict[str, dict[str, Any]], *, short: bool, whole: bool = True) -> str:
    """The page in Markdown; whole has what was done and tables too."""
    shown = [(part, known[part.name]) for part in parts if part.name in known]
    rows = [row for _, each in shown for row in Found.of(each["found"]).rows if row.met is not None]
    seconds = sum(each["seconds"] for _, each in shown)
    longer = sum(part.longer * each["seconds"] for part, each in shown) / 60.0
    head = TEXT.format(
        form=" --short" if short else "",
        minutes=seconds / 60.0,
        long=f"The long form takes about {longer:.0f}, by its steps, frames and levels." if short else "",
        machine=f"{platform.machine()}, CPU",
        version=__version__,
        met=sum(bool(row.met) for row in rows),
        counted=len(rows),
        weights=", ".join(hashes()) or "none",
    )
    sections = (line for part, each in shown for line in section(part, each, short=short, whole=whole))
    return "\n".join([head, *sections])


def section(part: Part, known: dict[str, Any], *, short: bool, whole: bool = True) -> Iterator[str]:
    """The lines of a part: its heading, its command and rows; whole: what the command's file says, and notes."""
    found = Found.of(known["found"])
    yield f"## {part.title}\n"
    yield f"`python -m {part.command}{'' if short else ' --long'}` ({known['seconds']:.0f} s)\n"
    if whole:
        yield from about(part)
    yield from HEAD
    yield from (row.line() for row in found.rows)
    yield ""
    if not whole:
        return
    for note in found.notes:
        yield f"{note}\n"
    if found.picture:
        yield f"![{part.title}](../{found.picture})\n"


def about(part: Part) -> Iterator[str]:
    """What the docstring of a part's file says below its title and its commands."""
    paragraphs = (sys.modules[part.measure.__module__].__doc__ or "").split("\n\n")[1:]
    yield from (f"{each.strip()}\n" for each in paragraphs if not each.startswith("    "))


def hashes() -> Iterator[str]:
    """Names and the first digits of the hashes of the weights that ship."""
    for file in sorted(kind.file for kind in KINDS.values()):
        yield f"`{file.stem}` {hashlib.sha256(file.read_bytes()).hexdigest()[:12]}"


def _children() -> float:
    """Processor time of the processes that were waited for [s]."""
    spent = os.times()
    return spent.children_user + spent.children_system


@click.command()
@click.option("--short", is_flag=True, help="Less than 15 minutes on two cores.")
@click.option("--whole", is_flag=True, help="Say what was done, with tables.")
@click.option("-o", "--out", type=click.Path(dir_okay=False, path_type=Path), default=PAGE, help="Page to write.")
@click.option("--only", multiple=True, type=click.Choice([part.name for part in PARTS]), help="Measure only these.")
@click.option("--fresh", is_flag=True, help="Measure everything anew.")
def main(short: bool, whole: bool, out: Path, only: tuple[str, ...], fresh: bool) -> None:
    """Measure what is not yet known and write the page."""
    prepare_device("cpu")
    form = "short" if short else "long"
    key = {
        "version": __version__,
        "form": form,
        "code": code_of(Path(physgraph_usd.__file__).parent, Path(__file__).parent),
    }
    journal = Journal(CACHE / f"results.{form}.jsonl", key, fresh=fresh)
    with torch.no_grad():
        known = run([part for part in PARTS if not only or part.name in only], journal, short=short)
    out.write_text(page(PARTS, known, short=short, whole=whole), encoding="utf-8")
    click.echo(out)


if __name__ == "__main__":
    main()
