"""Training: patches, gradients through forces, the record of a run, and going on after an interruption."""

from __future__ import annotations

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
from physgraph_usd.lab.train.bundle import Bundle, JointSystem, deal
from physgraph_usd.lab.train.held_out import nested_gap
from physgraph_usd.lab.train.loop import TrainConfig, Trainer
from physgraph_usd.lab.train.patches import Patch, PatchConfig, describe, make_patches
from physgraph_usd.solver.integrate.network import PhysgraphConfig
from physgraph_usd.solver.integrate.weights import integrator_of, load_network, random_network

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


@pytest.fixture(scope="module")
def resting() -> list[Patch]:
    """Patches on bodies."""
    return make_patches(replace(FEW, touched=1.0), seed=3)


def test_the_same_seed_makes_the_same_patches(patches: list[Patch]):
    again = make_patches(FEW, seed=3)
    assert describe(again) == describe(patches)
    for one, other in zip(patches, again, strict=True):
        assert np.array_equal(one.frame.points, other.frame.points)
        assert one.least == other.least
        assert one.frame.fabric == other.frame.fabric
    assert not np.array_equal(make_patches(FEW, seed=4)[0].frame.points, patches[0].frame.points)


def joint(patches: list[Patch], *, through_forces: bool = True) -> tuple[JointSystem, torch.Tensor]:
    bundle = Bundle(patches, device="cpu", through_forces=through_forces)
    return bundle.systems[-1], torch.cat([p.begin(len(p.systems) - 1) for p in patches])


def calm(patches: list[Patch]) -> list[Patch]:
    """Those that gravity pulls, or those that it does not: as many as can be stepped as one."""
    return max(deal(patches, 8), key=len)


@pytest.mark.parametrize(
    "config",
    [
        PhysgraphConfig(width=8),
        PhysgraphConfig(("secant", "metric", "metric.normal", "move1.smooth", "diagonal.smooth"), 8),
    ],
)
@pytest.mark.parametrize("which", ["patches", "resting"])
def test_patches_side_by_side_move_as_they_do_alone(
    config: PhysgraphConfig, which: str, request: pytest.FixtureRequest
):
    patches: list[Patch] = request.getfixturevalue(which)
    integrator = integrator_of(random_network(config, seed=1, scale=0.1))
    patches = calm(patches)
    system, x = joint(patches)
    together = integrator.start(system, x)
    for _ in range(3):
        together = integrator.step(system, together)
    assert system.level is not None
    spans = system.level.spans
    for number, (patch, span) in enumerate(zip(patches, spans, strict=True)):
        carry = integrator.start(patch.systems[-1], x[span])
        for _ in range(3):
            carry = integrator.step(patch.systems[-1], carry)
        spacing = float(patch.systems[-1].spacing.mean())
        assert float((carry.x - together.x[span]).abs().max()) < 1e-3 * spacing
        assert float(system.energies[-1][number]) == pytest.approx(carry.energy, rel=1e-4)


@pytest.mark.parametrize("which", ["patches", "resting"])
def test_the_energys_gradient_is_minus_the_force(which: str, request: pytest.FixtureRequest):
    system, x = joint(calm(request.getfixturevalue(which)))
    x.requires_grad_()
    system.energy_and_force(x)
    (gradient,) = torch.autograd.grad(system.energies[-1].sum(), x)
    _, force = system.energy_and_force(x.detach())
    assert torch.allclose(gradient * system.free, -force, rtol=1e-5, atol=1e-7 * float(force.abs().max()))


def test_the_forces_gradient_is_a_product_with_the_hessian(patches: list[Patch]):
    """u . H w by the gradient of u . F against a difference quotient of it along w, for smooth u and w."""
    system, x = joint(patches[:1])
    generator = torch.Generator().manual_seed(1)
    u, w = (system.apply_metric_inverse(torch.randn(x.shape, generator=generator)) * system.free for _ in range(2))
    w = 0.01 * w / (w.norm(dim=1) / system.spacing).max()
    there = x.clone().requires_grad_()
    _, force = system.energy_and_force(there)
    (gradient,) = torch.autograd.grad((u * force).sum(), there)
    quotient = 0.5 * float((u * (system.energy_and_force(x + w)[1] - system.energy_and_force(x - w)[1])).sum())
    assert float((gradient * w).sum()) == pytest.approx(quotient, rel=0.03)


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


@pytest.mark.parametrize("kind", ["physgraph", "physgraph-paper"])
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
