"""One frame on several cores, and a shot by several processes: `python -m benchmarks.versions --cores`."""

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

from benchmarks.judge_shot import groups_of
from benchmarks.rows import say, table
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.workers import cores
from physgraph_usd.usd.read.reader import open_shot

FRAMES, SHOT = 12, 60
"""Frames on several cores, and by several processes."""


def compare(names: Sequence[str], *, turns: int, level: int) -> None:
    """Print a row a sample: milliseconds of a warm frame (prepared, solved and measured; the median over frames, the
    least over turns) on 1, 2, 4 and so on of this machine's cores, then seconds of the command by as many processes.
    """
    counts = [2**k for k in range(cores().bit_length())]
    head = [f"warm frame, {count} cores [ms]" for count in counts]
    head += [f"{SHOT} frames, {count} processes [s]" for count in counts]
    say(table(["sample", *head], []))
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            shot = write_sample(name, Path(folder))
            times = open_shot(str(shot)).scene.times
            cells = []
            for frames, option in ((FRAMES, "OMP_NUM_THREADS"), (SHOT, "--workers")):
                asked = [str(shot), "--level", str(level)]
                asked += ["--frames", f"{times[0]}:{times[min(frames, len(times)) - 1]}"]
                runs = [[taken(asked, option, count) for count in counts] for _ in range(turns)]
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
        return statistics.median(
            sum(sum(each["milliseconds"].values()) for each in groups_of(f["garments"])) for f in frames
        )
