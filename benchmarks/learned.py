"""The learned integrators on garments that they were not trained on, beside nested quasi-Newton.

    python -m benchmarks.learned [FILE.safetensors ...] [--fabrics jersey,denim,silk] [--cache FILE.json] [--shots ...]
        [--gaps-only] [--short] [--device cuda]
    python -m benchmarks.learned --rounds [--scenes 32]      rounds with contact of unseen scenes, in place of shots

Two tables. The first has every shot and fabric: the gaps at two schedules, and the least energy known, against which
they are; where a method comes below that, it counts for all. The second has one row a candidate: its gap
over quasi-Newton's at the same number of force evaluations, the time of the same descents over quasi-Newton's, and the
time to a gap of 3% over quasi-Newton's, as medians over shots and fabrics; on the CPU time is that of all threads
together. Everything is guarded, without a spare integrator. Cards stand beside the weights (`physgraph-usd train`
writes them). Samples are always there; real shots where PHYSGRAPH_DATA names their folder. No body pushes, but in
rounds: there each weights' row has the force evaluations and the time to a gap of 3%, and the time of an evaluation,
over quasi-Newton's, as geometric means; a descent that does not come so far counts whole.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.rows import say
from physgraph_usd.lab import train
from physgraph_usd.lab.chart.reference import Reference
from physgraph_usd.lab.methods import PAPER
from physgraph_usd.lab.train.loop import HELD_OUT
from physgraph_usd.lab.train.record import read_config
from physgraph_usd.lab.train.rounds import Round, make_rounds, system_of
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.integrate.base import Integrator
from physgraph_usd.solver.integrate.guard import Guard
from physgraph_usd.solver.integrate.network import PhysgraphConfig
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.weights import NETWORKS, integrator_of, load_network

from .unseen import FABRICS, SHOTS, Case, cases, descend

SCHEDULES = ((5, 5, 5), (10, 10, 5))
FRONT = (
    *((n, n, n) for n in (1, 2, 3, 4, 5)),
    *((n, n, 5) for n in (7, 10, 14, 20, 28)),
    *((40, 28, 6), (40, 40, 8), (56, 56, 10), (80, 80, 12), (160, 160, 24)),
)
"""Schedules, cheapest first, among which the first to a gap of 3% is looked for; fine enough that one step counts."""
ENOUGH = 0.03
REPEATS = 2
MOST = 120
"""Most force evaluations in a round."""
TRAINING = Path(train.__file__).with_name("physgraph.toml")
"""Says what scenes the training measures on; here more of them, since scenes differ more than methods do."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    given = parsed(arguments)
    prepare_device(given.device)
    files = given.weights or [kind.file for kind in NETWORKS.values()]
    candidates = {file: load(file, given.device) for file in files}
    if given.rounds:
        return on_rounds(candidates, given.device, given.scenes)
    results: dict[Path, list[dict[str, float]]] = {file: [] for file in files}
    names = [f"{file.stem}" for file in files]
    say("| shot, fabric | vertices | quasi-Newton | " + " | ".join(names) + " | against |")
    say("|---|---|---|---|" + "---|" * len(names))
    options: dict[str, Any] = {"shots": given.shots.split(","), "fabrics": given.fabrics.split(",")}
    options |= {"device": given.device, "cache": given.cache, "short": given.short}
    for case in cases(**options):
        runs = {"quasi-Newton": Runs(case, QuasiNewton())}
        runs |= {file.stem: Runs(case, Guard(integrator_of(network))) for file, (network, _) in candidates.items()}
        known, (base, *others) = measured(case.reference, runs, front=not given.gaps_only)
        cells = []
        for file, found in zip(files, others, strict=True):
            row = compared(found, base)
            results[file].append(row)
            cells.append(", ".join(f"{row[f'gap {s}']:.2%}" for s in SCHEDULES) + f" ({row['corrected']:.0f})")
        gaps = ", ".join(f"{base[f'gap {s}']:.2%}" for s in SCHEDULES)
        size = case.group.levels[-1].vertex_count
        say(f"| {case.name} | {size} | {gaps} | " + " | ".join(cells) + f" | {known} |")
    say(f"\ngaps at {' and '.join(map(str, SCHEDULES))}; in brackets steps that the guard corrected")
    summary(candidates, results)


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command's options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path, nargs="*", help="weights; those that ship when none are named")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--fabrics", default=",".join(FABRICS))
    parser.add_argument("--shots", default=",".join(SHOTS))
    parser.add_argument("--rounds", action="store_true", help="measure on rounds with contact")
    parser.add_argument("--scenes", type=int, default=32, help="number of scenes of the rounds")
    parser.add_argument("--gaps-only", action="store_true", help="leave out the times")
    parser.add_argument("--short", action="store_true", help="look for the least energies from fewer starts")
    parser.add_argument("--cache", type=Path, default=None, help="file that keeps the least energies")
    return parser.parse_args(arguments)


@dataclass(frozen=True)
class Walk:
    """A descent of a round: energies [J] after each step, with the force evaluations and milliseconds so far."""

    energies: list[float]
    evaluations: list[int]
    milliseconds: list[float]

    def reach(self, aim: float) -> tuple[int, float, bool]:
        """Evaluations and milliseconds to an energy [J], or all of them; and whether it came so far."""
        place = next((k for k, energy in enumerate(self.energies) if energy <= aim), -1)
        return self.evaluations[place], self.milliseconds[place], self.energies[place] <= aim


def on_rounds(candidates: dict[Path, tuple[Any, dict[str, Any]]], device: str, scenes: int) -> None:
    """Print the table of rounds with contact."""
    config = replace(read_config(TRAINING).rounds, scenes=scenes)
    made = make_rounds(config, seed=HELD_OUT, workers=os.cpu_count() or 1)
    rounds = [each for each in made if each.touches]
    theirs = [walked(each, QuasiNewton(), device) for each in rounds]
    say("| weights | evaluations to 3% | time to 3% | time of an evaluation | rounds | come so far | quasi-Newton |")
    say("|---|---|---|---|---|---|---|")
    for file, (network, _) in candidates.items():
        integrator = Guard(integrator_of(network))
        pairs = [(walked(each, integrator, device), own) for each, own in zip(rounds, theirs, strict=True)]
        found = [[way.reach(aim_of(each, pair)) for way in pair] for each, pair in zip(rounds, pairs, strict=True)]
        counts, times = (statistics.geometric_mean(a[k] / b[k] for a, b in found) for k in (0, 1))
        far = [sum(pair[side][2] for pair in found) for side in (0, 1)]
        cells = f"{counts:.2f} | {times:.2f} | {times / counts:.2f} | {len(rounds)} | {far[0]} | {far[1]}"
        say(f"| {file.stem} | {cells} |")


def aim_of(each: Round, walks: Sequence[Walk]) -> float:
    """The energy at a gap of 3% to the least that is known or was reached [J]."""
    least = min(each.least, *(way.energies[-1] for way in walks))
    return least + ENOUGH * (each.start - least)


def walked(each: Round, integrator: Integrator, device: str) -> Walk:
    """A descent of a round; on the CPU its time is that of all threads."""
    system, x = system_of([each], device=device), torch.as_tensor(each.x, device=device)
    integrator.step(system, integrator.start(system, x))  # Kernels are compiled.
    clock = time.process_time if device == "cpu" else time.perf_counter
    made, before, began = Walk([], [], []), system.evaluations, clock()
    carry = integrator.start(system, x)
    while system.evaluations - before <= MOST and carry.mover != "stayed":
        carry = integrator.step(system, carry)
        made.energies.append(carry.energy)
        made.evaluations.append(system.evaluations - before - 1)
        made.milliseconds.append(1e3 * (clock() - began))
    return made


def load(file: Path, device: str) -> tuple[Any, dict[str, Any]]:
    """Weights and their card."""
    card = file.with_suffix(".json")
    about = json.loads(card.read_text(encoding="utf-8")) if card.exists() else {}
    kind = about.get("kind") or (PAPER if "paper" in file.stem else "physgraph")
    return load_network(file, kind=kind, device=device), about


class Runs:
    """Descents of a method on a case, each made once."""

    def __init__(self, case: Case, integrator: Integrator) -> None:
        """Make none yet."""
        self._case, self._integrator = case, integrator
        self._made: dict[tuple[int, ...], tuple[float, float, float]] = {}

    def __call__(self, steps: tuple[int, ...]) -> tuple[float, float, float]:
        """Energy [J], milliseconds, and steps that the guard corrected."""
        if steps not in self._made:
            case, mover = self._case, self._integrator
            runs = [descend(case.group, case.systems, case.coarse, mover, steps=steps) for _ in range(REPEATS)]
            corrected = sum(n for name, n in runs[0].movers.items() if name != mover.name)
            self._made[steps] = runs[0].energy, statistics.median(run.milliseconds for run in runs), corrected
        return self._made[steps]

    @property
    def least(self) -> tuple[float, tuple[int, ...]]:
        """The least energy that any of them came to [J], and with which steps."""
        return min((made[0], steps) for steps, made in self._made.items())


def measured(
    known: Reference, runs: dict[str, Runs], *, front: bool = True
) -> tuple[Reference, list[dict[str, float]]]:
    """Gaps, times and corrections of methods on a case; without ``front`` at the two schedules only.

    Where a method comes below the reference, that is lowered, and all is counted from there.

    Returns:
        The reference in the end, and the figures of each method.
    """
    while True:
        found = [figures(known, each, front=front) for each in runs.values()]
        before = known
        for name, each in runs.items():
            energy, steps = each.least
            known = known.lowered({"all": energy}, f"{name}, {steps} steps")
        if known is before:
            return known, found


def figures(known: Reference, run: Runs, *, front: bool) -> dict[str, float]:
    """What a method comes to, counted from a reference."""
    found: dict[str, float] = {"corrected": 0.0, "reached": float("inf")}
    for steps in FRONT if front else ():
        energy, spent, _ = run(steps)
        if known.gap(energy) <= ENOUGH:
            found["reached"] = spent
            break
    for steps in SCHEDULES:
        energy, spent, corrected = run(steps)
        found |= {f"gap {steps}": known.gap(energy), f"ms {steps}": spent}
        found["corrected"] += corrected
    return found


def compared(ours: dict[str, float], theirs: dict[str, float]) -> dict[str, float]:
    """Our figures with their ratios to another's."""
    ratios = {
        f"{kind} ratio {s}": ours[f"{kind} {s}"] / theirs[f"{kind} {s}"] for kind in ("gap", "ms") for s in SCHEDULES
    }
    return ours | ratios | {"reach ratio": ours["reached"] / theirs["reached"]}


def summary(candidates: dict[Path, tuple[Any, dict[str, Any]]], results: dict[Path, list[dict[str, float]]]) -> None:
    """Print one row a candidate."""
    head = ["weights", "hash", "network", "seed", "minutes", "patches"]
    head += [f"gap ratio {s}" for s in SCHEDULES] + [f"ms ratio {s}" for s in SCHEDULES] + ["ms to 3%, ratio"]
    say("\n| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for file, (network, card) in candidates.items():
        rows = results[file]
        if not rows:
            continue
        config = card.get("config", {})
        cells = [file.stem, str(card.get("sha256", "-"))[:8], in_words(network), str(config.get("seed", "-"))]
        cells += [str(card.get("minutes", "-")), str(config.get("patches", {}).get("count", "-"))]
        cells += [
            f"{statistics.median(row[f'{kind} ratio {s}'] for row in rows):.2f}"
            for kind in ("gap", "ms")
            for s in SCHEDULES
        ]
        reached = [row["reach ratio"] for row in rows if row["reach ratio"] == row["reach ratio"]]
        cells.append(f"{statistics.median(reached):.2f} ({len(reached)})" if reached else "-")
        say("| " + " | ".join(cells) + " |")
    say(f"\nmedians over {max(map(len, results.values()), default=0)} shots and fabrics")


def in_words(network: Any) -> str:
    """Vectors and size."""
    config = network.config
    if isinstance(config, PhysgraphConfig):
        return f"{' '.join(config.vectors)}; W={config.width}"
    return f"latent {config.latent}, M={config.rounds}, H={config.history}, {config.features} features"


if __name__ == "__main__":
    main()
