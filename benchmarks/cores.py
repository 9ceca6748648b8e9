"""One frame on several cores, and a whole shot by several processes, in turns.

    python -m benchmarks.cores [--shot NAME]... [--frames 12] [--workers 60] [--turns 2] [--level 2]

Refines samples by the command that a user gives. Prints a row a sample: milliseconds of a warm frame on 1, 2, 4 and so
on of this machine's cores (prepared, solved and measured; the median over frames, the least over turns), then the
seconds of a shot of so many frames, all of the command, by as many processes.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import click

from benchmarks.rows import say, table
from benchmarks.versions import groups_of
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.processes import cores
from physgraph_usd.usd.read.reader import open_shot

CHOSEN = ("dancer", "skirt")
"""Samples where none is named."""


@click.command()
@click.option("--shot", "names", multiple=True, default=CHOSEN, show_default=True)
@click.option("--frames", default=12, show_default=True, help="Frames of one process.")
@click.option("--workers", default=60, show_default=True, help="Frames of several processes; 0 leaves them out.")
@click.option("--turns", default=2, show_default=True)
@click.option("--level", default=2, show_default=True)
def main(names: Sequence[str], **numbers: int) -> None:
    """Print what cores and processes gain."""
    counts = [2**k for k in range(cores().bit_length())]
    head = [f"warm frame, {count} cores [ms]" for count in counts]
    head += [f"{numbers['workers']} frames, {count} processes [s]" for count in counts if numbers["workers"]]
    say(table(["sample", *head], []))
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            shot = write_sample(name, Path(folder))
            times = open_shot(str(shot)).scene.times
            cells = []
            for frames, option in ((numbers["frames"], "OMP_NUM_THREADS"), (numbers["workers"], "--workers")):
                if frames:
                    asked = [str(shot), "--level", str(numbers["level"])]
                    asked += ["--frames", f"{times[0]}:{times[min(frames, len(times)) - 1]}"]
                    runs = [[taken(asked, option, count) for count in counts] for _ in range(numbers["turns"])]
                    cells += [f"{min(each):,.1f}" for each in zip(*runs, strict=True)]
            say(f"| {name} | {' | '.join(cells)} |")


def taken(arguments: Sequence[str], option: str, count: int) -> float:
    """Milliseconds of a warm frame on so many cores, or with ``--workers`` the seconds of the command."""
    with tempfile.TemporaryDirectory() as made:
        out = Path(made) / "fine.usdc"
        command = [sys.executable, "-m", "physgraph_usd", "refine", *arguments, "-o", str(out)]
        command += ["--report", f"{out}.json"]
        by_workers = option == "--workers"
        environment = os.environ if by_workers else os.environ | {option: str(count)}
        began = time.perf_counter()
        command += [option, str(count)] if by_workers else []
        subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
        if by_workers:
            return time.perf_counter() - began
        frames = json.loads(Path(f"{out}.json").read_text("utf-8"))["frames"][1:]
        return statistics.median(sum(sum(each["milliseconds"].values()) for each in groups_of(f)) for f in frames)


if __name__ == "__main__":
    main()
