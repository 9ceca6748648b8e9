"""The laws that every force keeps; `stability/test_forces_gradients.py` holds them to their energies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from energies import (
    evaluate,
)
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from meshes import planar_mesh
from sheets import level_of, quality, rotation
from torch import Tensor

from physgraph_usd.solver.forces.base import Force, ForceModule
from physgraph_usd.solver.forces.bending import Bending
from physgraph_usd.solver.forces.gravity import Gravity
from physgraph_usd.solver.forces.guide import Guide, GuideMap
from physgraph_usd.solver.forces.membrane import Membrane
from physgraph_usd.solver.forces.stretch import Stretch
from physgraph_usd.solver.forces.tether import Tether
from physgraph_usd.solver.level import Level

DOWN = np.array([0.0, 0.0, -9.81])
INTERNAL = ("stretch", "membrane", "bending")
ELASTIC = (*INTERNAL, "gravity")


@dataclass(frozen=True, eq=False)
class Case:
    """A sheet and what was done to it. Levels are built in the tests: the shape checker draws random numbers."""

    rest: np.ndarray
    triangles: np.ndarray
    bent: bool
    noise: float
    seed: int

    def build(self, *, dtype: torch.dtype = torch.float64) -> Level:
        return level_of(self.rest, self.triangles, bent=self.bent, dtype=dtype)

    @property
    def x(self) -> Tensor:
        return crumple(self.rest, self.noise, self.seed)


def force_of(name: str, level: Level) -> Force:
    """A term with constants of everyday size."""

    def of(value: float) -> Tensor:
        return torch.full((len(level.spans),), value, dtype=torch.float64)

    makers: dict[str, Callable[[], Force]] = {
        "stretch": lambda: Stretch(level, of(30.0)),
        "membrane": lambda: Membrane(level, of(30.0), of(7.0)),
        "bending": lambda: Bending(level, of(0.05)),
        "gravity": lambda: Gravity(level, of(0.2), DOWN),
        "guide": lambda: guide_of(level),
        "tether": lambda: Tether(level, of(0.2), 400.0, level.rest * 1.1),
    }
    return makers[name]()


def guide_of(level: Level) -> Guide:
    stiffness = torch.full((level.from_coarse.shape[1],), 2000.0)
    return Guide(level, GuideMap(level), stiffness).retarget(1.1 * level.rest)


def crumple(rest: np.ndarray, amount: float, seed: int) -> Tensor:
    """The rest shape with noise, turned and moved."""
    rng = np.random.default_rng(seed)
    x = rest + rng.normal(scale=amount, size=rest.shape)
    return torch.as_tensor(x @ rotation(seed).T + rng.normal(size=3))


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """A crumpled sheet of jittered triangles with holes, on a bent rest shape in any position."""
    mesh, rest = draw(planar_mesh())
    triangles = mesh.triangulate(rest).triangles
    assume(len(triangles) > 0 and quality(rest, triangles).min() > 0.15)
    seed = draw(st.integers(0, 2**16))
    rest[:, 2] = 0.3 * np.sin(rest[:, 0] + seed)
    rest = rest @ rotation(seed + 1).T
    return Case(rest, triangles, draw(st.booleans()), draw(st.sampled_from([0.02, 0.2])), seed)


@settings(max_examples=25)
@given(case=cases(), seed=st.integers(0, 99))
def test_internal_forces_balance_and_turn_with_the_mesh(case: Case, seed: int):
    level, x = case.build(), case.x
    turn, shift = torch.as_tensor(rotation(seed)), torch.tensor([0.3, -2.0, 1.0])
    for name in INTERNAL:
        force = force_of(name, level)
        energy, f = evaluate(force, x)
        size = f.abs().sum() + 1e-30
        assert f.sum(dim=0).abs().max() < 1e-12 * size
        assert torch.linalg.cross(x, f).sum(dim=0).abs().max() < 1e-11 * size * x.abs().max()
        turned_energy, turned = evaluate(force, x @ turn.T + shift)
        assert turned_energy == pytest.approx(energy, rel=1e-9, abs=1e-15)
        assert (turned - f @ turn.T).abs().max() < 1e-9 * size


@settings(max_examples=15)
@given(case=cases())
def test_float32_agrees_with_float64_and_repeats_bit_for_bit(case: Case):
    level, x = case.build(), case.x
    single = case.build(dtype=torch.float32)
    for name in (*ELASTIC, "guide", "tether"):
        energy, f = evaluate(force_of(name, level), x)
        found, g = evaluate(force_of(name, single), x.float())
        again, h = evaluate(force_of(name, single), x.float())
        stiffness = float(force_of(name, level).diagonal(x).max()) * float(level.spacing.mean())
        size = max(float(f.abs().max()), stiffness)
        assert found == again
        assert torch.equal(g, h)
        assert abs(found - energy) < 1e-5 * max(abs(energy), size)
        assert (g - f).abs().max() < 3e-5 * size


class Counted:
    """A term that counts how often it is asked."""

    name = "counted"

    def __init__(self) -> None:
        self.asked = 0

    def add_force(self, x: Tensor, force: Tensor) -> Tensor:
        self.asked += 1
        force.add_(x)
        return 0.5 * x.square().sum(dtype=torch.float64)

    def diagonal(self, x: Tensor) -> Tensor:
        return torch.ones_like(x[:, 0])

    def rest_matrix(self) -> None:
        return None


def test_a_module_that_remembers_evaluates_its_own_terms_once_at_the_same_positions():
    own, more, x = Counted(), Counted(), torch.arange(6.0, dtype=torch.float64).reshape(2, 3)
    module = ForceModule([own], remembers=True)
    first = module.energy_and_force(x)
    joined = module.joined_by([more])
    energy, force = joined.energy_and_force(x)
    assert (own.asked, more.asked) == (1, 1)
    assert float(energy) == 2.0 * float(first[0])
    assert torch.equal(force, 2.0 * x)
    assert torch.equal(first[1], x)  # What was answered before is not written to.
    assert torch.equal(module.energy_and_force(x)[1], x)
    x += 1.0
    assert torch.equal(joined.energy_and_force(x)[1], 2.0 * x)
    assert torch.equal(module.energy_and_force(x.clone())[1], x)
    assert own.asked == 3
