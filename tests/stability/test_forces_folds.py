"""S14: hinges folded flat and past it."""

import numpy as np
import pytest
import torch
from energies import apart, difference_force, evaluate
from sheets import level_of, rotation

from physgraph_usd.solver.forces.bending import Bending
from physgraph_usd.solver.level import Level

TRIANGLES = np.array([[0, 1, 2], [1, 0, 3]])
REST_ANGLES = (0.0, 1.0, -2.5, 3.0)


def hinge(angle: float, *, turn: int = 0) -> np.ndarray:
    """Two unequal triangles whose hinge has this angle [rad]."""
    wing = [0.2, -0.7 * np.cos(angle), -0.7 * np.sin(angle)]
    points = np.array([[0, 0, 0], [1, 0, 0], [0.6, 0.9, 0], wing])
    return points @ rotation(turn).T if turn else points


def resting_at(angle: float, dtype: torch.dtype = torch.float64) -> tuple[Level, Bending]:
    level = level_of(hinge(angle), TRIANGLES, bent=True, dtype=dtype)
    return level, Bending(level, torch.tensor([2.0]))


@pytest.mark.parametrize("turn", [0, 4])
@pytest.mark.parametrize("rest", REST_ANGLES)
@pytest.mark.parametrize("angle", [np.pi - 1e-6, -np.pi + 1e-6, np.pi - 1e-3, 1e-6, 1e-9])
def test_s14_gradient_of_a_fold(angle: float, rest: float, turn: int):
    _, bending = resting_at(rest)
    x = torch.as_tensor(hinge(angle, turn=turn))
    energy, f = evaluate(bending, x)
    bent = (angle - rest + np.pi) % (2.0 * np.pi) - np.pi
    assert energy == pytest.approx(float(bending.weight[0]) * bent**2 / 2.0, rel=1e-6, abs=1e-18)
    if abs(bent) > 1e-3:
        assert apart(f, difference_force(bending, x, 2e-7)) < 1e-6
