"""The paper's convergence figure: energy against steps on a patch, for every integrator.

    python -m benchmarks.convergence [--out docs/pictures/convergence.png] > benchmarks/results/convergence.md

Patches of another seed than those trained on, stretch and bending only, their border fixed, subdivided twice (x16).
Rates of Adam and gradient descent are the paper's, in units that make them comparable (an Adam rate is in edge lengths,
a gradient step in 1 / largest diagonal), and the best of a sweep. Nothing is guarded. Prints the gap after each force
evaluation up to K = 5 and at the end; evaluations in line searches and at coarse levels are counted in full.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import torch

from physgraph_usd.lab.methods.first_order import Adam, GradientDescent
from physgraph_usd.lab.methods.lbfgs import Lbfgs
from physgraph_usd.lab.train.patches import PatchConfig, make_patches
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.integrate.base import Integrator
from physgraph_usd.solver.integrate.descend import solve_level
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.stop import Budget
from physgraph_usd.solver.integrate.weights import NETWORKS, integrator_of, load_network

from .rows import Row, commit, say
from .unseen import Case, plain_group, reference_of

STEPS = 30
PAPER_STEPS = 5
ADAM_RATES = (1e-2, 1e-3, 1e-4)
ADAM_SWEEP = (3e-3, 6e-3, 2e-2, 4e-2, 8e-2, 0.16)
GRADIENT_RATES = (0.1, 1.0, 10.0)
GRADIENT_SWEEP = (0.2, 0.3, 0.4, 0.5, 0.66, 0.8, 1.3)
SEED = 77
TEXT = """# Convergence

Gap to the least energy known after each force evaluation, on three patches of another seed than those trained on:
stretch and bending only, fixed border, two subdivisions, no guard. Written by `python -m benchmarks.convergence` at
commit {commit}."""
CONFIG = PatchConfig(count=3, levels=(2, 2), elastic=True, most_vertices=4000, reference_steps=400)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, default=NETWORKS["physgraph-paper"].file)
    parser.add_argument("--physgraph", type=Path, default=NETWORKS["physgraph"].file)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=None)
    given = parser.parse_args(arguments)
    prepare_device(given.device)
    say(TEXT.format(commit=commit()))
    for number, patch in enumerate(trained_like(given.device)):
        say(f"\npatch {number}: {patch.name}, {patch.group.levels[-1].vertex_count} vertices, {patch.reference}")
        lines = curves(patch, given.weights, given.physgraph, device=given.device)
        show_table(lines)
        if given.out and number == 0:
            draw(lines, given.out)


def trained_like(device: str, config: PatchConfig = CONFIG) -> Iterator[Case]:
    """Patches like those that the paper's network was trained on, of another seed."""
    for patch in make_patches(config, seed=SEED):
        garment, at = patch.garment, {"level": patch.garment.level, "device": device}
        group = plain_group(garment, patch.gravity, torch.float32, **at)
        systems, coarse = group.systems([patch.frame])
        known = reference_of(garment, patch.gravity, patch.frame, **at)
        yield Case(patch.words, group, patch.frame, systems, coarse, known)


def rows(short: bool) -> list[Row]:
    """On how many patches the paper's network lies below Adam and gradient descent."""
    config = CONFIG if short else replace(CONFIG, count=2 * CONFIG.count)
    files = NETWORKS["physgraph-paper"].file, NETWORKS["physgraph"].file
    below = [not overtaken(curves(patch, *files, device="cpu")) for patch in trained_like("cpu", config)]
    title = "the paper's network below Adam and gradient descent of every rate at every k <= 5"
    return [Row(title, f"{sum(below)} of {len(below)} patches", "every k", f"{len(below)} patches", all(below))]


def overtaken(lines: dict[str, list[float]]) -> list[tuple[str, int]]:
    """Names and numbers of evaluations at which the paper's network is not below Adam or gradient descent."""
    ours = lines["physgraph-paper"]
    others = [name for name in lines if name.startswith(("Adam", "gradient"))]
    return [(name, k) for name in others for k in range(1, PAPER_STEPS + 1) if not ours[k] < lines[name][k]]


def curves(patch: Case, paper: Path, own: Path, *, device: str) -> dict[str, list[float]]:
    """Gap against steps for every method, by its name."""
    found = {f"Adam {rate:g}": flat(patch, Adam(rate)) for rate in ADAM_RATES}
    found |= best("Adam", {rate: flat(patch, Adam(rate)) for rate in (*ADAM_RATES, *ADAM_SWEEP)})
    found |= {f"gradient descent {rate:g}": flat(patch, GradientDescent(rate)) for rate in GRADIENT_RATES}
    rates = (*GRADIENT_RATES, *GRADIENT_SWEEP)
    found |= best("gradient descent", {rate: flat(patch, GradientDescent(rate)) for rate in rates})
    found["L-BFGS"] = flat(patch, Lbfgs())
    found["quasi-Newton, finest level"] = flat(patch, QuasiNewton())
    found["quasi-Newton, nested"] = nested(patch, QuasiNewton())
    if paper.exists():
        network = load_network(paper, kind="physgraph-paper", device=device)
        found["physgraph-paper"] = flat(patch, integrator_of(network))
    if own.exists():
        network = load_network(own, kind="physgraph", device=device)
        found["physgraph, finest level"] = flat(patch, integrator_of(network))
    return from_least(found)


def best(name: str, runs: dict[float, list[float]]) -> dict[str, list[float]]:
    """The run that ends lowest after K steps, among those that stay finite."""
    rate = min(runs, key=lambda r: runs[r][PAPER_STEPS] if math.isfinite(runs[r][PAPER_STEPS]) else math.inf)
    return {f"{name}, best of {len(runs)} ({rate:g})": runs[rate]}


def flat(patch: Case, integrator: Integrator) -> list[float]:
    """Gap after each force evaluation at the finest level, from the upsampled cage; line searches count in full."""
    system, x = patch.systems[-1], patch.group.levels[-1].base.apply(patch.coarse)
    carry = integrator.start(system, x)
    gaps, before = [1.0], system.evaluations
    while len(gaps) <= STEPS:
        after = integrator.step(system, carry)
        waiting = min(max(system.evaluations - before, 1), STEPS + 1 - len(gaps)) - 1
        gaps += [gaps[-1]] * waiting + [patch.reference.gap(after.energy)]
        carry, before = after, system.evaluations
    return gaps


def nested(patch: Case, integrator: Integrator) -> list[float]:
    """The same through the levels, n steps at each, the evaluations at all levels counted."""
    gaps = [1.0] + [math.nan] * STEPS
    for each in range(1, STEPS // len(patch.systems) + 1):
        x, energy, spent = patch.group.levels[0].base.apply(patch.coarse), math.inf, -1
        for index, (level, system) in enumerate(zip(patch.group.levels, patch.systems, strict=True)):
            x = x if level.from_below is None else level.from_below.apply(x)
            x, report = solve_level(system, integrator, x, level=index, budget=Budget(each))
            energy, spent = report.energy_after, spent + report.evaluations
        if spent <= STEPS:
            gaps[spent] = patch.reference.gap(energy)
    return gaps


def from_least(lines: dict[str, list[float]]) -> dict[str, list[float]]:
    """Gaps counted from the least energy that any of them came to, where that is below the one known before."""
    least = min(0.0, *(value for gaps in lines.values() for value in gaps if math.isfinite(value)))
    return {name: [(value - least) / (1.0 - least) for value in gaps] for name, gaps in lines.items()}


def show_table(lines: dict[str, list[float]]) -> None:
    """Print gaps at the first steps and at the last."""
    shown = (*range(1, PAPER_STEPS + 1), 10, STEPS)
    say("\n| force evaluations | " + " | ".join(str(k) for k in shown) + " |\n|---|" + "---|" * len(shown))
    for name, gaps in lines.items():
        say(f"| {name} | " + " | ".join(in_words(gaps, k) for k in shown) + " |")
    if "physgraph-paper" in lines:
        lost = overtaken(lines)
        say("\nphysgraph-paper lies below Adam and gradient descent at every k <= 5: " + ("yes" if not lost else "no"))
        for name, k in lost:
            say(f"not below {name} at k = {k}")


def in_words(gaps: list[float], k: int) -> str:
    """A gap as a percentage; what diverged, as such; where a descent through levels has no figure, the one before."""
    known = [value for value in gaps[: k + 1] if not math.isnan(value)]
    value = known[-1] if has_holes(gaps) else gaps[k]
    return f"{value:.1%}" if value < 10 else "diverged"


def has_holes(gaps: list[float]) -> bool:
    """Whether figures are missing between others, as in a descent through levels."""
    return any(math.isnan(a) and not math.isnan(b) for a, b in pairwise(gaps))


def draw(lines: dict[str, list[float]], file: Path) -> None:
    """Draw gap against steps with Pillow: logarithmic upwards, one colour a family."""
    from PIL import Image, ImageDraw  # noqa: PLC0415

    width, height, left, top, bottom = 1000, 620, 80, 30, 60
    right = 330
    image = Image.new("RGB", (width, height), "white")
    pen = ImageDraw.Draw(image)
    low, high = -2.2, 0.5

    def place(k: float, value: float) -> tuple[float, float]:
        up = (min(max(math.log10(max(value, 1e-9)), low), high) - low) / (high - low)
        return left + (width - left - right) * k / STEPS, height - bottom - (height - top - bottom) * up

    for power in range(math.ceil(low), 1):
        pen.line([place(0, 10.0**power), place(STEPS, 10.0**power)], fill="#dddddd")
        pen.text((left - 50, place(0, 10.0**power)[1] - 6), f"{100 * 10.0**power:g}%", fill="black")
    for k in range(0, STEPS + 1, 5):
        pen.text((place(k, 1.0)[0] - 5, height - bottom + 8), str(k), fill="black")
    pen.text((left, height - 28), "force evaluations; upwards the gap to the least energy known", fill="black")
    for row, (name, gaps) in enumerate(lines.items()):
        colour = COLOURS[row % len(COLOURS)]
        points = [place(k, value) for k, value in enumerate(gaps) if math.isfinite(value)]
        pen.line(points, fill=colour, width=4 if name.startswith("physgraph") else 2)
        y = top + 22 * row
        pen.line([(width - right + 15, y + 6), (width - right + 45, y + 6)], fill=colour, width=4)
        pen.text((width - right + 52, y), name, fill="black")
    image.save(file)


COLOURS = (
    *("#9ecae1", "#6baed6", "#3182bd", "#08519c"),
    *("#fdd0a2", "#fdae6b", "#fd8d3c", "#a63603"),
    *("#74c476", "#807dba", "#54278f", "#e31a1c", "#000000"),
)


if __name__ == "__main__":
    with torch.no_grad():
        main()
