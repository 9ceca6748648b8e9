"""What the learned integrator gains from each of its parts: short trainings that differ in one thing.

    python -m benchmarks.ablations [--iterations 400] [--device cuda] [--only secant,no-secant] [-o DIR]

Every candidate starts from `train/physgraph.toml`, trains for the same number of iterations on the same patches and is
measured on the same held-out patches: gap over that of nested quasi-Newton at the same steps a level, geometric mean,
unguarded. With -o each candidate's weights and card are written, for `python -m benchmarks.learned`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from physgraph_usd.lab.train import record
from physgraph_usd.lab.train.loop import TrainConfig, Trainer
from physgraph_usd.shot.refine import prepare_device
from physgraph_usd.solver.integrate.network import PhysgraphConfig
from physgraph_usd.solver.integrate.weights import save_network

CONFIG = Path(record.__file__).parent / "physgraph.toml"
BASE = ("secant", "metric", "metric1", "move1", "diagonal")
PLAIN = ("metric", "metric1", "move1", "move2", "diagonal")


def candidates(base: TrainConfig) -> dict[str, TrainConfig]:
    """Runs by name; each differs from the first in what its name says."""

    def network(**changes: object) -> TrainConfig:
        assert isinstance(base.network, PhysgraphConfig)
        return replace(base, network=replace(base.network, **changes))

    named = {
        "as committed": base,
        "no secant": network(vectors=PLAIN),
        "secant and last move": network(vectors=("secant", "move1")),
        "short": network(vectors=("secant", "metric", "move1", "diagonal")),
        "long": network(vectors=(*BASE, "metric2", "move2", "diagonal1")),
        "normal": network(vectors=(*BASE, "metric.normal")),
        "strain": network(strain=True),
        "means": network(means=True),
        "one round": network(rounds=1, strain=True),
        "two rounds": network(rounds=2, strain=True),
        "four rounds": network(rounds=4, strain=True),
        "width 8": network(width=8),
        "width 16": network(width=16),
        "width 48": network(width=48),
        "displacements only": replace(base, through_forces=False),
        "ratio loss": replace(base, loss="ratio"),
        "unroll 5": replace(base, unroll=5),
        "unroll 20": replace(base, unroll=20, segments=2),
        "raw starts only": replace(base, raw=1.0, middle=0.0),
        "elastic only": replace(base, patches=replace(base.patches, elastic=True)),
        "another seed": replace(base, seed=base.seed + 1),
    }
    return named


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and print one row a candidate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--only", default="", help="names, separated by commas")
    parser.add_argument("-o", "--out", type=Path, default=None, help="folder for weights and cards")
    given = parser.parse_args(arguments)
    prepare_device(given.device)
    base = replace(record.read_config(CONFIG), iterations=given.iterations, minutes=1e6, average=0.95)
    wanted = [name.strip() for name in given.only.split(",") if name.strip()]
    say(
        "| candidate | loss | gap ratio (5, 5, 5) | gap ratio (10, 10, 5) | minutes | hash |\n|---|---|---|---|---|---|"
    )
    trainer: Trainer | None = None
    for name, config in candidates(base).items():
        if wanted and name not in wanted:
            continue
        trainer = Trainer(config, device=given.device, like=trainer)
        trainer.train(every=1e9)
        last = trainer.curve[-1]
        ratios = " | ".join(f"{ratio:.3f}" for ratio in last["held_out"].values())
        digest = keep(trainer, name, given.out) if given.out else "-"
        say(f"| {name} | {last['loss']:.3f} | {ratios} | {last['minutes']:.1f} | {digest[:8]} |")


def keep(trainer: Trainer, name: str, folder: Path) -> str:
    """Write a candidate's weights and card; returns the hash."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{name.replace(' ', '-')}.safetensors"
    digest = save_network(trainer.averaged(), file)
    card = record.card_of(trainer, digest, config_file=CONFIG, out=folder)
    command = f"python -m benchmarks.ablations --only '{name}' --iterations {trainer.config.iterations}"
    file.with_suffix(".json").write_text(json.dumps(card | {"command": command}, indent=2) + "\n", encoding="utf-8")
    return digest


def say(line: str) -> None:
    """Write a line to standard output."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
