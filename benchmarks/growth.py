"""How much a method's steps magnify a small difference: whether rounding decides where cloth folds.

    python -m benchmarks.growth [FILE.safetensors ...] [--shots sleeve,flag,swatch]

Two tables, unguarded descents of garments at their finest level; medians over the shots, and the worst after so many
steps. The first has two starts that differ by a billionth of an edge, in float64: the root mean square of their
difference over that of the noise. The second has the same start in float32 and in float64: the root mean square of
their difference in edges (S33 of docs/notes/stability.md on real garments). A difference grows where cloth buckles,
whatever the method: two folds that could go either way are told apart by less and less. What a method adds to that is
its own.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.rows import say, table
from benchmarks.unseen import opened_garment, plain_group
from physgraph_usd.lab.methods.lbfgs import Lbfgs
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.integrate.base import Carry, Integrator, System
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.weights import FOLDER, integrator_of, load_network

NOISE = 1e-9
"""Of the starts, in edge lengths."""
STEPS = (1, 3, 6, 12, 18)
SHOTS = ("sleeve", "flag", "swatch", "skirt", "tshirt")
LEVEL = 1
MAKERS: dict[str, Callable[[], Integrator]] = {
    "quasi-newton": QuasiNewton,
    "lbfgs": Lbfgs,
}


@dataclass(frozen=True)
class Start:
    """The finest level's problem in one precision, and its upsampled cage [m]."""

    system: System
    x: torch.Tensor


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path, nargs="*", help="of `physgraph`; those that ship when none are named")
    parser.add_argument("--shots", default=",".join(SHOTS))
    given = parser.parse_args(arguments)
    prepare_device("cpu")
    starts = list(starts_of(given.shots.split(",")))
    makers = dict(MAKERS)
    for file in given.weights or [FOLDER / "physgraph.safetensors"]:
        makers[f"{file.parent.name}/{file.stem}"] = lambda f=file: integrator_of(load_network(f, kind="physgraph"))
    head = ("method", *(f"after {steps}" for steps in STEPS))
    for title, measure in (("times the noise", growth), ("single against double precision, edges", rounding)):
        say(f"\n{title}\n\n{table(head, [row(name, make, starts, measure) for name, make in makers.items()])}")


def row(
    name: str, make: Callable[[], Integrator], starts: Sequence[tuple[Start, Start]], measure: Callable
) -> list[str]:
    """A method's medians and worst figures."""
    each = zip(*(measure(make, single, double) for single, double in starts), strict=True)
    return [name, *(f"{statistics.median(values):.2g}, {max(values):.2g}" for values in each)]


def starts_of(shots: Sequence[str]) -> Iterator[tuple[Start, Start]]:
    """The problem of each shot in float32 and in float64."""
    for name in shots:
        opened = opened_garment(name)
        if opened is None:
            continue
        garment, gravity, frame = opened
        made = []
        for dtype in (torch.float32, torch.float64):
            group = plain_group(garment, gravity, dtype, level=LEVEL, device="cpu")
            systems, coarse = group.systems([frame])
            made.append(Start(systems[-1], group.levels[-1].base.apply(coarse)))
        yield made[0], made[1]


def growth(make: Callable[[], Integrator], single: Start, double: Start) -> list[float]:
    """How many times the noise two descents in float64 differ after `STEPS`."""
    system, x = double.system, double.x
    draw = torch.Generator().manual_seed(1)
    noise = NOISE * system.spacing.unsqueeze(1) * torch.randn(x.shape, dtype=x.dtype, generator=draw)
    noise = noise * system.free
    return differences(make, (system, x), (system, x + noise), scale=noise.norm())


def rounding(make: Callable[[], Integrator], single: Start, double: Start) -> list[float]:
    """How far descents in float32 and in float64 differ after `STEPS`: root mean square in edge lengths."""
    pairs = (single.system, single.x), (double.system, double.x)
    return differences(make, *pairs, scale=double.system.spacing.unsqueeze(1) * len(double.x) ** 0.5)


@torch.no_grad()
def differences(
    make: Callable[[], Integrator],
    one: tuple[System, torch.Tensor],
    other: tuple[System, torch.Tensor],
    *,
    scale: torch.Tensor,
) -> list[float]:
    """Norm of the difference of two descents after `STEPS`, over a scale."""
    integrators = make(), make()
    carries: list[Carry] = [i.start(*start) for i, start in zip(integrators, (one, other), strict=True)]
    found = []
    for made in range(1, max(STEPS) + 1):
        carries = [i.step(s[0], c) for i, s, c in zip(integrators, (one, other), carries, strict=True)]
        if made in STEPS:
            found.append(float(((carries[0].x.double() - carries[1].x.double()) / scale).norm()))
    return found


if __name__ == "__main__":
    main()
