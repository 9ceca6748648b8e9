"""Training: patches, gradients through forces, the record of a run, and going on after an interruption."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner, Result

from physgraph_usd.cli import main
from physgraph_usd.lab.methods.paper_network import PaperConfig
from physgraph_usd.lab.train import record
from physgraph_usd.lab.train.held_out import nested_gap
from physgraph_usd.lab.train.loop import TrainConfig, Trainer
from physgraph_usd.lab.train.patches import Patch, PatchConfig, describe, make_patches
from physgraph_usd.solver.integrate.network import PhysgraphConfig
from physgraph_usd.solver.integrate.weights import integrator_of, load_network

FEW = PatchConfig(count=3, levels=(1, 1), edges=(5, 6), reference_steps=20)
TINY = """
kind = "{kind}"
minutes = 5.0
iterations = {iterations}
batch = 2
unroll = 3
segments = 1
held_out = 1
[network]
{network}
[patches]
count = 2
levels = [1, 1]
edges = [5, 5]
reference_steps = 10
"""


@pytest.fixture(scope="module")
def patches() -> list[Patch]:
    return make_patches(FEW, seed=3)


def test_the_same_seed_makes_the_same_patches(patches: list[Patch]):
    again = make_patches(FEW, seed=3)
    assert describe(again) == describe(patches)
    for one, other in zip(patches, again, strict=True):
        assert np.array_equal(one.frame.points, other.frame.points)
        assert one.least == other.least
        assert one.frame.fabric == other.frame.fabric
    assert not np.array_equal(make_patches(FEW, seed=4)[0].frame.points, patches[0].frame.points)


@pytest.mark.slow
@pytest.mark.parametrize("through_forces", [False, True])
def test_training_lowers_the_loss(through_forces: bool):
    config = TrainConfig(
        network=PhysgraphConfig(width=8),
        patches=FEW,
        iterations=30,
        unroll=5,
        segments=1,
        raw=1.0,
        held_out=0,
        average=0.8,
        through_forces=through_forces,
    )
    trainer = Trainer(config)
    index = [len(patch.systems) - 1 for patch in trainer.patches]

    def mean_gap() -> float:
        integrator = integrator_of(trainer.averaged())
        return float(
            np.mean([nested_gap(p, integrator, (0,) * i + (5,)) for p, i in zip(trainer.patches, index, strict=True)])
        )

    before = mean_gap()
    trainer.train()
    assert trainer.iteration == 30
    assert mean_gap() < before


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["train", *map(str, arguments)])


def configured(folder: Path, *, kind: str = "physgraph", iterations: int = 4) -> Path:
    network = "width = 8" if kind == "physgraph" else "latent = 8\nrounds = 2"
    file = folder / f"{kind}-{iterations}.toml"
    file.write_text(TINY.format(kind=kind, iterations=iterations, network=network))
    return file


@pytest.mark.parametrize("kind", ["physgraph", pytest.param("physgraph-paper", marks=pytest.mark.slow)])
def test_a_run_leaves_weights_a_card_and_a_log(tmp_path: Path, kind: str):
    config = configured(tmp_path, kind=kind)
    result = run("--config", config, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    weights = tmp_path / "out" / f"{kind}.safetensors"
    assert result.stdout.strip() == str(weights)
    load_network(weights, kind=kind)
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["iterations"] == 4
    assert card["command"].startswith(f"physgraph-usd train --config {config}")
    assert card["config"]["seed"] == 1
    assert len(card["patches"]) == 2
    lines = (tmp_path / "out" / "log.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["iteration"] == 4


def test_a_run_goes_on_where_it_was(tmp_path: Path):
    """Four iterations, then four more, are eight: the same weights, bit for bit, when the schedule is the same."""
    config = TrainConfig(
        network=PhysgraphConfig(width=8), patches=FEW, minutes=60.0, iterations=8, unroll=3, batch=2, held_out=0
    )
    whole = Trainer(config)
    whole.train()
    half = Trainer(config)
    for _ in range(4):
        half.iterate()
    half.save(tmp_path / "checkpoint.pt")
    rest = Trainer(config)
    rest.resume(tmp_path / "checkpoint.pt")
    assert rest.iteration == 4
    rest.seconds = 0.0
    rest.train()
    assert rest.iteration == whole.iteration
    assert all(
        torch.equal(a, b) for a, b in zip(whole.averaged().parameters(), rest.averaged().parameters(), strict=True)
    )


def test_resume_and_fresh_runs_are_not_confused(tmp_path: Path):
    config = configured(tmp_path)
    assert "nothing to resume" in run("--config", config, "-o", tmp_path / "out", "--resume").stderr
    assert run("--config", config, "-o", tmp_path / "out").exit_code == 0
    again = run("--config", config, "-o", tmp_path / "out")
    assert again.exit_code == 2
    assert "holds a run" in again.stderr
    (tmp_path / "out" / record.CHECKPOINT).rename(tmp_path / record.CHECKPOINT)
    assert "holds a run" in run("--config", config, "-o", tmp_path / "out").stderr  # its weights are there
    (tmp_path / record.CHECKPOINT).rename(tmp_path / "out" / record.CHECKPOINT)
    assert run("--config", configured(tmp_path, iterations=6), "-o", tmp_path / "out", "--resume").exit_code == 0


class Crafted:
    """What makes a file when it is unpickled."""

    def __init__(self, made: Path) -> None:
        self.made = made

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (self.made,)  # pyright: ignore[reportReturnType]


@pytest.mark.parametrize("how", ["crafted", "plain pickle", "cut", "of another network"])
def test_a_checkpoint_that_is_not_ours_is_refused_and_runs_nothing(tmp_path: Path, how: str):
    config, out, made = configured(tmp_path), tmp_path / "out", tmp_path / "made"
    out.mkdir()
    checkpoint = out / record.CHECKPOINT
    if how == "plain pickle":
        checkpoint.write_bytes(pickle.dumps(Crafted(made)))
    elif how == "of another network":
        Trainer(replace(record.read_config(config), network=PhysgraphConfig(width=9))).save(checkpoint)
    else:
        torch.save({"network": Crafted(made) if how == "crafted" else torch.zeros(9)}, checkpoint)
    if how == "cut":
        checkpoint.write_bytes(checkpoint.read_bytes()[:-200])
    result = run("--config", config, "-o", out, "--resume")
    assert result.exit_code == 2, result.output
    assert str(checkpoint) in result.stderr
    assert not made.exists()


def test_the_committed_configurations_can_be_read():
    folder = Path(record.__file__).parent
    kinds = {record.read_config(file).kind for file in folder.glob("*.toml")}
    assert kinds == {"physgraph", "physgraph-paper"}
    paper = record.read_config(folder / "physgraph-paper.toml")
    assert isinstance(paper.network, PaperConfig)
    assert (paper.network.latent, paper.network.rounds, paper.unroll, paper.patches.elastic) == (128, 10, 5, True)
