"""S37: whatever an integrator proposes, the guard's result is not worse than the input."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import torch
from cloth import Watched, finest_system, group_of, sheet, wave

from physgraph_usd.solver.integrate.base import Carry, System
from physgraph_usd.solver.integrate.descend import solve_level
from physgraph_usd.solver.integrate.guard import Guard
from physgraph_usd.solver.integrate.stop import Budget

Proposal = Callable[[Carry, torch.Generator], torch.Tensor]


def noise(carry: Carry, generator: torch.Generator) -> torch.Tensor:
    return torch.randn(carry.x.shape, generator=generator, dtype=carry.x.dtype)


def one_nan(carry: Carry, _: torch.Generator) -> torch.Tensor:
    x = carry.x.clone()
    x[3, 1] = torch.nan
    return x


PROPOSALS: dict[str, Proposal] = {
    "random": lambda carry, g: carry.x + 0.05 * noise(carry, g),
    "tiny random": lambda carry, g: carry.x + 1e-5 * noise(carry, g),
    "huge": lambda carry, g: carry.x + 1e6 * noise(carry, g),
    "overflowing": lambda carry, g: carry.x + 1e30 * noise(carry, g),
    "NaN": lambda carry, _: torch.full_like(carry.x, torch.nan),
    "one NaN": one_nan,
    "infinite": lambda carry, _: torch.full_like(carry.x, torch.inf),
    "collapsed": lambda carry, _: torch.zeros_like(carry.x),
    "uphill": lambda carry, _: carry.x - 1e-4 * carry.force / carry.force.abs().max(),
    "overshooting": lambda carry, _: carry.x + 1e3 * carry.force,
    "still": lambda carry, _: carry.x.clone(),
}


class Adversary:
    """Proposes what it is told to, like a network with wrong weights."""

    name = "adversary"

    def __init__(self, propose: Proposal, *, seed: int = 0) -> None:
        self._propose, self._generator = propose, torch.Generator().manual_seed(seed)

    def start(self, system: System, x: torch.Tensor) -> Carry:
        energy, force = system.energy_and_force(x)
        return Carry(x, energy, force, mover=self.name)

    def step(self, system: System, carry: Carry) -> Carry:
        x = self._propose(carry, self._generator)
        energy, force = system.energy_and_force(x)
        return Carry(x, energy, force, mover=self.name)


def problem(dtype: torch.dtype = torch.float64) -> tuple[System, torch.Tensor]:
    mesh, rest = sheet(6, 4)
    return finest_system(group_of(mesh, rest, level=1, dtype=dtype), wave(rest))


def descent(system: System, x: torch.Tensor, propose: Proposal, *, seed: int = 0, steps: int = 15) -> list[Carry]:
    carries: list[Carry] = []
    solve_level(system, Watched(Guard(Adversary(propose, seed=seed)), carries.append), x, level=0, budget=Budget(steps))
    return carries


@pytest.mark.parametrize("name", PROPOSALS)
def test_s37_energy_never_rises(name: str):
    system, x = problem(torch.float32)
    carries = descent(system, x, PROPOSALS[name])
    assert all(bool(carry.x.isfinite().all()) and np.isfinite(carry.energy) for carry in carries)
    assert all(after.energy <= before.energy for before, after in pairwise(carries))
    # The energy that it reports is that of the positions that it returns.
    assert carries[-1].energy == system.energy_and_force(carries[-1].x)[0]
    # Where the proposals are worthless, the fallback has worked.
    if name != "still":
        assert carries[-1].energy < carries[0].energy
