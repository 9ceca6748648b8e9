"""S8 to S12 and S37 for the learned integrators, in reduced form: safety does not rest on training."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from cloth import FABRIC, GUIDE, Watched, finest_system, group_of, sheet, wave

from physgraph_usd.lab.methods.paper_network import PaperConfig
from physgraph_usd.lab.methods.random_networks import random_network
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.integrate.base import Carry, System
from physgraph_usd.solver.integrate.descend import solve_level
from physgraph_usd.solver.integrate.guard import Guard
from physgraph_usd.solver.integrate.network import VECTORS, PhysgraphConfig
from physgraph_usd.solver.integrate.stop import Budget
from physgraph_usd.solver.integrate.weights import integrator_of, shipped_network
from physgraph_usd.solver.scene import GarmentFrame

RANDOM = {
    "physgraph": PhysgraphConfig(width=16),
    "with everything": PhysgraphConfig(vectors=VECTORS, width=16),
    "physgraph-paper": PaperConfig(latent=16, rounds=3),
    "raw features": PaperConfig(latent=16, rounds=2, features="paper"),
}


def problem(
    *, factor: float = 1.0, edge: float = 0.05, level: int = 1, kind: str = "triangles", squeeze: float = 0.1
) -> tuple[System, torch.Tensor]:
    """A waved sheet whose elastic stiffness is multiplied."""
    mesh, rest = sheet(7, 5, edge, kind=kind)
    group = group_of(mesh, rest, level=level, dtype=torch.float32)
    fabric = Fabric(factor * FABRIC.stretch, factor * FABRIC.bend * (edge / 0.05) ** 2, FABRIC.density)
    systems, coarse = group.systems([GarmentFrame(wave(rest, squeeze=squeeze), fabric, GUIDE)])
    return systems[-1], group.levels[-1].base.apply(coarse)


def descent(integrator: Guard, system: System, x: torch.Tensor, *, steps: int = 10) -> list[Carry]:
    carries: list[Carry] = []
    solve_level(system, Watched(integrator, carries.append), x, level=0, budget=Budget(steps))
    return carries


def require_safe(carries: list[Carry]) -> None:
    assert all(bool(carry.x.isfinite().all()) and np.isfinite(carry.energy) for carry in carries)
    assert all(after.energy <= before.energy for before, after in pairwise(carries))


@pytest.mark.parametrize("scale", [0.3, 1e4])
@pytest.mark.parametrize("name", RANDOM)
def test_s37_random_weights_never_end_worse_than_the_input(name: str, scale: float):
    for seed in range(2):
        system, x = problem()
        guarded = Guard(integrator_of(random_network(RANDOM[name], seed=seed, scale=scale)))
        carries = descent(guarded, system, x, steps=5)
        require_safe(carries)
        assert carries[-1].energy == system.energy_and_force(carries[-1].x)[0]
        assert carries[-1].energy < carries[0].energy


@torch.no_grad()
@pytest.mark.parametrize("size", [(8, 6), (16, 12)])
def test_s33_rounding_does_not_decide_what_a_step_is(size: tuple[int, int]):
    """Eighteen guarded steps of two descents whose starts differ by a billionth of an edge.

    Quasi-Newton's differ 3 to 300 times as much then; where features jumped it was some hundred thousand times.
    """
    integrator = Guard(integrator_of(shipped_network("physgraph")))
    mesh, rest = sheet(*size)
    system, x = finest_system(group_of(mesh, rest, level=2), wave(rest))
    noise = 1e-9 * float(system.spacing.mean()) * torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    one, other = (integrator.start(system, start) for start in (x, x + noise))
    for _ in range(18):
        one, other = integrator.step(system, one), integrator.step(system, other)
    grown = float((other.x - one.x).norm() / noise.norm())
    assert grown < 1e4, grown
