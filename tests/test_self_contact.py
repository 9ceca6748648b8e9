"""Forces between parts of the cloth: minus the gradient, no net force or moment, nothing beyond their reach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from energies import apart, difference_force, evaluate
from sheets import irregular, level_of, rotation
from test_forces import crumple

from physgraph_usd.solver.forces.self_contact import PairConstraints, SelfContact

POINTS, TRIANGLES = irregular(0.4, 0.3, 0.1)
LEVEL = level_of(POINTS, TRIANGLES)
X = crumple(POINTS, 0.05, 8)


def gaps_of(x: torch.Tensor, count: int = 40, *, lack: float | None = None, seed: int = 0) -> PairConstraints:
    """Random pairs, vertex-face ones first; all short of their offset by the same, or by anything between +-2 cm."""
    rng = np.random.default_rng(seed)
    corners = torch.as_tensor(np.array([rng.choice(len(x), 4, replace=False) for _ in range(count)]), dtype=torch.int32)
    b, st = rng.dirichlet(np.ones(3), count), rng.uniform(0, 1, (count, 2))
    face = np.arange(count)[:, None] < count // 2
    weight = np.where(
        face,
        np.column_stack([np.ones(count), -b]),
        np.column_stack([1 - st[:, 0], st[:, 0], st[:, 1] - 1, -st[:, 1]]),
    )
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    none = torch.zeros(count, dtype=x.dtype)
    made = PairConstraints(corners, torch.as_tensor(weight), torch.as_tensor(normal), none, none)
    offset = (made.vectors(x) * made.normal).sum(dim=1)
    short = torch.as_tensor(rng.uniform(-0.02, 0.02, count)) if lack is None else torch.full_like(none, lack)
    return replace(made, offset=offset + short, stiffness=torch.as_tensor(rng.uniform(10, 1000, count)))


TERMS = {
    "gaps": lambda: SelfContact(LEVEL, gaps_of(X)),
    "gaps, just open": lambda: SelfContact(LEVEL, gaps_of(X, lack=-1e-5)),
    "gaps, just short": lambda: SelfContact(LEVEL, gaps_of(X, lack=1e-3)),
}
OPEN = ("gaps, just open",)


@pytest.mark.parametrize("name", TERMS)
def test_the_force_is_minus_the_gradient(name: str):
    term = TERMS[name]()
    energy, force = evaluate(term, X)
    assert (energy == 0.0) == (name in OPEN)
    assert bool(force.any()) == (name not in OPEN)
    difference = difference_force(term, X, 2e-7)
    assert float((force - difference).abs().max()) < 1e-6 * max(float(difference.abs().max()), 1e-3)


def test_they_turn_with_the_cloth():
    turn, shift = torch.as_tensor(rotation(4)), torch.tensor([0.3, -0.2, 5.0], dtype=X.dtype)
    moved = X @ turn.T + shift
    gaps = gaps_of(X)
    energy, force = evaluate(SelfContact(LEVEL, gaps), X)
    turned = SelfContact(LEVEL, replace(gaps, normal=gaps.normal @ turn.T))
    energy_there, force_there = evaluate(turned, moved)
    assert energy_there == pytest.approx(energy, rel=1e-9)
    assert apart(force_there, force @ turn.T) < 1e-9


class TestRoom:
    """Constraints on one vertex 1 mm above a floor that wants 3 mm."""

    X = torch.tensor([[0.0, 1e-3, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)

    def depths(self, normal: list[float], offset: float, *, side: float = 1.0) -> list[float]:
        """Depths of the floor's constraint and of another once both share the room [m]."""
        normals = torch.tensor([[0.0, 1.0, 0.0], normal], dtype=torch.float64)
        offsets, one = torch.tensor([3e-3, offset], dtype=torch.float64), torch.ones(2, dtype=torch.float64)
        corners, weight = torch.zeros((2, 4), dtype=torch.int32), torch.zeros((2, 4), dtype=torch.float64)
        weight[:, 0] = torch.tensor([1.0, side])
        both = PairConstraints(corners, weight, normals, offsets, one).sharing_room(self.X)
        return (both.offset - (both.normal * both.vectors(self.X)).sum(dim=1)).tolist()

    def test_a_ceiling_too_low_leaves_the_vertex_the_middle(self):
        """The ceiling at 2 mm wants 3 mm, too: the vertex is in the middle and nothing pushes."""
        assert self.depths([0.0, -1.0, 0.0], 1e-3) == pytest.approx([0.0, 0.0], abs=1e-12)

    def test_the_vertex_may_be_the_second_point(self):
        """A vertex of the ceiling over the cloth: the vector between them points up."""
        assert self.depths([0.0, 1.0, 0.0], 1e-3, side=-1.0) == pytest.approx([0.0, 0.0], abs=1e-12)
        assert self.depths([0.0, -1.0, 0.0], 5e-3, side=-1.0)[0] == pytest.approx(2e-3, abs=1e-12)

    def test_whichever_side_the_vertex_is_on(self):
        """The ceiling at 1 mm below the floor: the middle is 1.5 mm lower, and only the ceiling pushes."""
        assert self.depths([0.0, -1.0, 0.0], 4e-3) == pytest.approx([-1.5e-3, 1.5e-3], abs=1e-12)

    @pytest.mark.parametrize(("normal", "offset"), [([0.0, -1.0, 0.0], -4e-3), ([0.6, 0.8, 0.0], 5e-3)])
    def test_what_does_not_contradict_stays(self, normal: list[float], offset: float):
        """A high ceiling, and a wall that leans the same way."""
        assert self.depths(normal, offset)[0] == pytest.approx(2e-3, abs=1e-12)
