"""What shots cost: the table of README.md.

    python -m benchmarks.costs [--level 2] [--shot NAME] [FOLDER]

Refines one frame, and then seven in a row, of samples and, where FOLDER holds real shots, of those, with all contact;
reading and writing are counted. Prints a row a shot: fine vertices, the processor time of a first frame, and that of
each frame after it. Wall time on cores that do nothing else is up to a half of it with two cores.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import click

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.usd.read.reader import open_shot

from .contact_shots import REAL
from .rows import say

SAMPLES = {"dancer": 20, "skirt": 10, "tshirt": 10}
"""Samples and the number of their first frame here."""
MORE = 6
"""Frames after the first."""


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path))
@click.option("--level", default=2, show_default=True)
@click.option("--shot", "shots", multiple=True, help="Only these.")
def main(folder: Path | None, level: int, shots: Sequence[str]) -> None:
    """Print what shots cost."""
    prepare_device("cpu")
    say("| shot | fine vertices | first frame | frames after it |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as made:
        cases = {name: (write_sample(name, Path(made)), [], [], first) for name, first in SAMPLES.items()}
        if folder is not None:
            cases |= {name: (folder / name, *case) for name, case in REAL.items() if (folder / name).exists()}
        for name, (file, garments, bodies, first) in cases.items():
            if not shots or name in shots:
                options = RefineOptions(garments=tuple(garments), colliders=tuple(bodies), level=level)
                say(f"| {name} | {row(file, options, first, Path(made) / 'layer.usdc')} |")


def row(file: Path, options: RefineOptions, first: int, out: Path) -> str:
    """Vertices and the two times of one shot."""
    times = open_shot(str(file), garments=options.garments, colliders=options.colliders).scene.times
    last = min(first + MORE, len(times) - 1)
    seconds = []
    for end in (first, first, last):  # twice the first: the kernels are loaded then
        start = time.process_time()
        report = refine_shot(file, out, replace(options, frames=(times[first], times[end]), overwrite=True))
        seconds.append(time.process_time() - start)
    vertices = sum(garment["fine_points"] for garment in report.garments)
    return f"{vertices:,} | {seconds[1]:.1f} s | {(seconds[2] - seconds[1]) / (last - first):.1f} s"


if __name__ == "__main__":
    main()
