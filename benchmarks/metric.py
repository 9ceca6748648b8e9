"""What H0's couplings across two triangles cost and save: whole, and kept to the edges as we factorise it.

    python -m benchmarks.metric [--shots sleeve,flag,skirt]

A row a garment and matrix: its entries, the time of factorising it and of a solve, over those of the matrix kept to the
edges, and the gap that nested quasi-Newton leaves at (10, 10, 5). Times are of all threads together, in one run.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from unittest import mock

import torch

from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.frame import level_forces
from physgraph_usd.solver.integrate.metric import Metric, on_edges
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton

from .rows import say, table
from .unseen import Case, cases, descend

MATRICES: dict[str, Callable] = {"couplings along edges": on_edges, "whole": lambda matrix, edges: matrix}
SCHEDULE = (10, 10, 5)
REPEATS = 9


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", default="sleeve,flag,skirt")
    shots = parser.parse_args(arguments).shots.split(",")
    prepare_device("cpu")
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        for shot in shots:
            found = [measured_with(keep, shot, Path(folder) / "least.json") for keep in MATRICES.values()]
            for name, values in zip(MATRICES, found, strict=True):
                ratios = [f"{mine / theirs:.2f}" for mine, theirs in zip(values[:3], found[0][:3], strict=True)]
                lines.append([shot, name, *ratios, f"{values[3]:.2%}"])
    say(table(("garment", "matrix", "entries", "factorising", "a solve", f"gap at {SCHEDULE}"), lines))


def measured_with(keep: Callable, shot: str, least: Path) -> tuple[float, ...]:
    """`measured` of a garment whose matrix is made so; ``least`` keeps the least energy known."""
    with mock.patch.object(level_forces, "on_edges", keep):
        return measured(next(iter(cases(shots=(shot,), fabrics=("jersey",), cache=least))))


def measured(case: Case) -> tuple[float, ...]:
    """Entries of the finest level's matrix, milliseconds of factorising it and of a solve, and the gap."""
    system = case.systems[-1]
    metric = system.metric
    assert isinstance(metric, Metric)
    force = system.energy_and_force(case.group.levels[-1].base.apply(case.coarse))[1]
    none = torch.zeros(len(force), dtype=torch.float64)
    made = milliseconds(lambda: metric.plus(none), 3)
    solved = milliseconds(lambda: metric.solve(force), REPEATS)
    energy = descend(case.group, case.systems, case.coarse, QuasiNewton(), steps=SCHEDULE).energy
    return float(metric.entries), made, solved, case.reference.gap(energy)


def milliseconds(work: Callable[[], object], repeats: int) -> float:
    """Median time of all threads [ms]."""
    spent = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        spent.append(1e3 * (time.process_time() - began))
    return statistics.median(spent)


if __name__ == "__main__":
    main()
