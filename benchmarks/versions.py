"""Versions of the solver side by side: what warm frames and whole shots cost in each.

    python -m benchmarks.versions OTHER... [--shots FOLDER] [--shot NAME] [--frames N] [--level 2]

Each OTHER is a checkout of another version in a folder of its own. Every shot is refined by each of them and by this
one in turn, on one core, in a process of its own, by the command that a user gives. Prints a row a shot: of each
version the median of its warm frames, solving and measuring, and all frames, in milliseconds of wall time as its report
has them; the ratios of this version to each other; and how much crosses.
"""

from __future__ import annotations

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import click

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.usd.read.reader import open_shot

from .contact_shots import REAL
from .rows import say

SAMPLES = ("sleeve", "skirt", "layers")
HERE = Path(__file__).resolve().parents[1]


@click.command()
@click.argument("others", nargs=-1, type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--shots", "folder", type=click.Path(path_type=Path), help="The real shots, which we may not ship.")
@click.option("--shot", "names", multiple=True, help="Only these.")
@click.option("--frames", default=0, help="So many frames of each, from where it is set in; 0 for whole shots.")
@click.option("--level", default=2, show_default=True)
@click.option("--core", default=0, show_default=True, help="The core that all run on.")
def main(others: Sequence[Path], folder: Path | None, names: Sequence[str], frames: int, level: int, core: int) -> None:
    """Print what each version takes for each shot."""
    trees = [*(other.resolve() for other in others), HERE]
    say("| shot | " + " | ".join(f"{tree.name}: warm, whole, crossings" for tree in trees) + " | ratios |")
    say("|---|" + "---|" * (len(trees) + 1))
    with tempfile.TemporaryDirectory() as made:
        cases = {name: (write_sample(name, Path(made)), [], [], 0) for name in SAMPLES}
        if folder is not None:
            cases |= {name: (folder / name, *case) for name, case in REAL.items() if (folder / name).exists()}
        for name, (file, garments, bodies, first) in cases.items():
            if names and name not in names:
                continue
            given = [option for each in garments for option in ("--garment", each)]
            given += [option for each in bodies for option in ("--collider", each)]
            if frames:
                times = open_shot(str(file), garments=garments, colliders=bodies).scene.times[first : first + frames]
                given += ["--frames", f"{times[0]}:{times[-1]}"]
            found = [taken(tree, [str(file), *given, "--level", str(level)], Path(made), core) for tree in trees]
            ratios = (f"{found[-1][0] / each[0]:.2f}, {found[-1][1] / each[1]:.2f}" for each in found[:-1])
            cells = (f"{warm:,.0f}, {whole:,.0f}, {crossings:,}" for warm, whole, crossings in found)
            say(f"| {name} | {' | '.join(cells)} | {'; '.join(ratios)} |")


def taken(tree: Path, arguments: Sequence[str], made: Path, core: int) -> tuple[float, float, int]:
    """Median milliseconds of a version's warm frames and those of all, and its crossings."""
    out = made / f"{tree.name}.usdc"
    command = ["taskset", "-c", str(core), sys.executable, "-m", "physgraph_usd", "refine", *arguments]
    command += ["-o", str(out), "--report", f"{out}.json", "--overwrite"]
    path = os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise click.ClickException(f"{tree.name}: {done.stderr[-500:]}")
    said = Path(f"{out}.json").read_text("utf-8")
    each = [sum(phases.values()) for phases in milliseconds(json.loads(said)["frames"])]
    crossings = sum(map(int, re.findall(r'"after": \{"crossings": (\d+)', said)))
    return statistics.median(each[1:] or each), sum(each), crossings


def milliseconds(node: object) -> Iterator[dict[str, float]]:
    """The phases of every frame of a report, wherever its version has them."""
    if isinstance(node, dict):
        if isinstance(node.get("milliseconds"), dict):
            yield node["milliseconds"]
        node = list(node.values())
    if isinstance(node, list):
        for each in node:
            yield from milliseconds(each)


if __name__ == "__main__":
    main()
