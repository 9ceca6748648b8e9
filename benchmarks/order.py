"""Does the chart repeat? The order of methods at a gap of 3%, in several runs of the same chart.

    python -m benchmarks.order [--shots flag,sleeve] [--runs 3] [--minutes 3]

Each run is `physgraph-usd chart SAMPLE --level 1 --clock cpu --count 1` anew, in a folder of its own. A row a method,
its milliseconds to the gap in each run; then whether the order is the same. Times of one run that differ by less than
a tenth count as equal, as they do in the chart: two methods have changed places where each is the faster one by more
than that in some run. Who does not get to the gap within a chart's time is slower than all who do. Those that swap
within a tenth are told too.
"""

from __future__ import annotations

import argparse
import math
import statistics
import tempfile
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

from physgraph_usd.lab.chart.measure import JUDGED
from physgraph_usd.lab.chart.options import ChartOptions
from physgraph_usd.lab.chart.run import chart_shot
from physgraph_usd.lab.chart.table import TOLERANCE
from physgraph_usd.lab.samples import write_sample

from .rows import say, table


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table a shot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", default="flag,sleeve", help="samples")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--minutes", type=float, default=3.0, help="of each run")
    given = parser.parse_args(arguments)
    for name in given.shots.split(","):
        runs = [times(name, given.minutes) for _ in range(given.runs)]
        say(f"\n{name}, level 1, milliseconds of one core to a gap of {JUDGED:.0%}\n")
        say("\n".join(compared(runs)))


def times(name: str, minutes: float) -> dict[str, float]:
    """Milliseconds to the gap by method, the fastest first, of a chart made anew."""
    with tempfile.TemporaryDirectory() as folder:
        shot = write_sample(name, Path(folder))
        options = ChartOptions(level=1, clock="cpu", count=1, budget_minutes=minutes)
        return chart_shot(shot, Path(folder) / "chart", options).times_to(JUDGED)


def compared(runs: Sequence[dict[str, float]]) -> list[str]:
    """The table of some runs, and what their orders have in common."""
    methods = sorted(set().union(*runs), key=lambda m: (statistics.median(run.get(m, math.inf) for run in runs), m))
    rows = [[method, *(f"{run[method]:.0f}" if method in run else "-" for run in runs)] for method in methods]
    lines = [table(("method", *(f"run {k + 1}" for k in range(len(runs)))), rows), ""]
    told = []
    for a, b in combinations(methods, 2):
        lead = [run.get(b, math.inf) / run.get(a, math.inf) for run in runs if a in run or b in run]
        if min(lead) < 1.0 / TOLERANCE and max(lead) > TOLERANCE:
            told.append(f"{a} and {b} change places: {', '.join(f'{each:.2f}' for each in lead)}")
        elif min(lead) < 1.0 < max(lead):
            lines.append(f"{a} and {b} are as fast: {', '.join(f'{each:.2f}' for each in lead)}")
    verdict = "the order is not the same" if told else f"the order is the same in {len(runs)} runs"
    return [*lines, verdict, *told]


if __name__ == "__main__":
    main()
