"""How much a method's steps magnify a small difference: whether rounding decides where cloth folds.

    python -m benchmarks.growth [FILE.safetensors ...] [--shots sleeve,flag,swatch]

Two descents of one garment at its finest level, in float64 and unguarded, whose starts differ by a billionth of an
edge. Prints the root mean square of their difference over that of the noise after so many steps, as the median over
the shots, and the worst. A difference grows where cloth buckles, whatever the method: two folds that could go either
way are told apart by less and less. What a method adds to that is its own.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from benchmarks.rows import say, table
from benchmarks.unseen import opened_garment, plain_group
from physgraph_usd.integrate.base import Integrator, System
from physgraph_usd.integrate.learned import integrator_of
from physgraph_usd.integrate.quasi_newton import QuasiNewton
from physgraph_usd.integrate.weights import FOLDER, load_network
from physgraph_usd.shot import prepare_device

NOISE = 1e-9
"""Of the starts, in edge lengths."""
STEPS = (1, 3, 6, 12, 18)
SHOTS = ("sleeve", "flag", "swatch", "skirt", "tshirt")
LEVEL = 1


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path, nargs="*", help="of `physgraph`; those that ship when none are named")
    parser.add_argument("--shots", default=",".join(SHOTS))
    given = parser.parse_args(arguments)
    prepare_device("cpu")
    starts = list(starts_of(given.shots.split(",")))
    methods: dict[str, Integrator] = {"quasi-newton": QuasiNewton(), "lbfgs": QuasiNewton(use_metric=False)}
    for file in given.weights or [FOLDER / "physgraph.safetensors"]:
        methods[f"{file.parent.name}/{file.stem}"] = integrator_of(load_network(file, kind="physgraph"))
    lines = []
    for name, integrator in methods.items():
        grown = [growth(system, x, integrator) for system, x in starts]
        each = list(zip(*grown, strict=True))
        lines.append([name, *(f"{statistics.median(values):.2g}, {max(values):.2g}" for values in each)])
    say(table(("method", *(f"after {steps}" for steps in STEPS)), lines))


def starts_of(shots: Sequence[str]) -> Iterator[tuple[System, torch.Tensor]]:
    """The finest level's problem of each shot and its upsampled cage [m]."""
    for name in shots:
        opened = opened_garment(name)
        if opened is None:
            continue
        garment, gravity, frame = opened
        group = plain_group(garment, gravity, torch.float64, level=LEVEL, device="cpu")
        systems, coarse = group.systems([frame])
        yield systems[-1], group.levels[-1].base.apply(coarse)


@torch.no_grad()
def growth(system: System, x: torch.Tensor, integrator: Integrator, *, steps: Sequence[int] = STEPS) -> list[float]:
    """How many times the noise two descents differ after so many steps.

    Args:
        system: The problem.
        x: Where one descent starts [m], shape (V, 3); the other starts there but for the noise.
        integrator: The method.
        steps: After how many steps to look, growing.
    """
    draw = torch.Generator().manual_seed(1)
    noise = NOISE * system.spacing.unsqueeze(1) * torch.randn(x.shape, dtype=x.dtype, generator=draw)
    noise = noise * system.free
    one, other = integrator.start(system, x), integrator.start(system, x + noise)
    found = []
    for made in range(1, max(steps) + 1):
        one, other = integrator.step(system, one), integrator.step(system, other)
        if made in steps:
            found.append(float((one.x - other.x).norm() / noise.norm()))
    return found


if __name__ == "__main__":
    main()
