"""What training sees of contact: rounds of moving scenes, stepped alone and together."""

from dataclasses import replace

import pytest
import torch

from physgraph_usd.errors import UsageError
from physgraph_usd.lab.train.bundle import RoundBundle, deal
from physgraph_usd.lab.train.loop import TrainConfig, Trainer
from physgraph_usd.lab.train.patches import PatchConfig
from physgraph_usd.lab.train.rounds import Round, RoundConfig, make_rounds
from physgraph_usd.solver.integrate.network import PhysgraphConfig
from physgraph_usd.solver.integrate.weights import NETWORKS, shipped_network

FEW = RoundConfig(scenes=2, reference_steps=15, most_vertices=1)


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rounds() -> list[Round]:
    return make_rounds(FEW, seed=5)


def touching(rounds: list[Round]) -> list[Round]:
    return max(deal([each for each in rounds if each.touches], 8), key=len)


def test_the_energys_gradient_is_minus_the_force(rounds: list[Round]):
    some = touching(rounds)
    system = RoundBundle(some, device="cpu", through_forces=True).systems[0]
    x = torch.cat([torch.as_tensor(each.x) for each in some]).requires_grad_()
    system.energy_and_force(x)
    (gradient,) = torch.autograd.grad(system.energies[-1].sum(), x)
    force = system.energy_and_force(x.detach())[1]
    assert torch.allclose(gradient * system.free, -force, rtol=1e-5, atol=1e-7 * float(force.abs().max()))


def test_training_begins_with_the_weights_of_a_file(rounds: list[Round]):
    shipped, file = shipped_network("physgraph"), str(NETWORKS["physgraph"].file)
    config = shipped.config
    assert isinstance(config, PhysgraphConfig)
    vectors = torch.randn((50, len(config.vectors), 3), generator=torch.Generator().manual_seed(1))
    run = TrainConfig(network=config, patches=PatchConfig(count=0), held_out=0, start=file)
    network = Trainer(run, data=([], rounds, [], [])).network
    torch.testing.assert_close(network(vectors, 3), shipped(vectors, 3))
    with pytest.raises(UsageError, match="another size"):
        Trainer(replace(run, network=replace(config, width=2 * config.width)), data=([], rounds, [], []))


def test_iterations_on_rounds_change_the_weights(rounds: list[Round]):
    run = TrainConfig(
        network=PhysgraphConfig(width=8), held_out=0, iterations=2, unroll=2, segments=1, rounds=replace(FEW, share=1.0)
    )
    trainer = Trainer(run, data=([], rounds, [], rounds[:2]))
    before = [each.detach().clone() for each in trainer.network.parameters()]
    trainer.train()
    assert any(not torch.equal(a, b) for a, b in zip(before, trainer.network.parameters(), strict=True))
    assert all(value > 0.0 for value in trainer.held_out_ratios().values())
