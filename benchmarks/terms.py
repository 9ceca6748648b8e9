"""Time of each elastic term on a sheet of about 100,000 edges, one core: smooth, and crumpled by a fifth of an edge.

    python -m benchmarks.terms

Medians in milliseconds of processor time, force and energy together; last the membrane's over the springs'. Times are
of the machine, ratios between versions are what tells: run checkouts in turns.
"""

from __future__ import annotations

import statistics
import time

import torch

from benchmarks.rows import say
from benchmarks.step import sheet
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.forces.base import Force
from physgraph_usd.solver.forces.bending import Bending
from physgraph_usd.solver.forces.membrane import Membrane, shear_stiffness
from physgraph_usd.solver.forces.stretch import Stretch

EDGES, REPEATS, CRUMPLED = 100_000, 101, 0.2


def milliseconds(term: Force, x: torch.Tensor) -> float:
    """Median time of an evaluation [ms]."""
    times, force = [], torch.zeros_like(x)
    for _ in range(REPEATS):
        began = time.process_time()
        term.add_force(x, force)
        times.append(time.process_time() - began)
    return 1e3 * statistics.median(times)


def main() -> None:
    """Print the table."""
    prepare_device("cpu")
    system, smooth = sheet(EDGES, "cpu")
    level, silk = system.level, PRESETS["silk"]
    assert level is not None
    stretch, shear, bend = (torch.tensor([each]) for each in (silk.stretch, shear_stiffness(silk), silk.bend))
    terms = (Stretch(level, stretch), Membrane(level, stretch, shear), Bending(level, bend))
    noise = torch.randn(smooth.shape, generator=torch.Generator().manual_seed(1))
    crumpled = smooth + CRUMPLED * float(level.spacing.mean()) * noise
    say("| cloth | springs | membrane | bending | membrane / springs |\n|---|---|---|---|---|")
    for name, x in (("smooth", smooth), ("crumpled", crumpled)):
        found = [milliseconds(term, x) for term in terms]
        say(f"| {name} | {' | '.join(f'{each:.2f}' for each in found)} | {found[1] / found[0]:.2f} |")


if __name__ == "__main__":
    main()
