"""S14: hinges folded flat and past it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from energies import apart, autograd_force, bending_energy, difference_force, evaluate
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


def moment(points: np.ndarray, f: torch.Tensor) -> float:
    """Moment that turns the second triangle towards larger angles."""
    return float(np.cross(points[3], f[3].double().numpy())[0])


@pytest.mark.parametrize("turn", [0, 4])
@pytest.mark.parametrize("rest", REST_ANGLES)
@pytest.mark.parametrize("angle", [np.pi - 1e-6, -np.pi + 1e-6, np.pi - 1e-3, 1e-6, 1e-9])
def test_s14_gradient_of_a_fold(angle: float, rest: float, turn: int):
    level, bending = resting_at(rest)
    x = torch.as_tensor(hinge(angle, turn=turn))
    energy, f = evaluate(bending, x)
    expected, g = autograd_force(bending_energy(level.rest, TRIANGLES, 2.0, bent=True), x)
    assert energy == pytest.approx(expected, rel=1e-6, abs=1e-18)
    assert apart(f, g) < 1e-6
    if abs(angle) > 1e-3:
        assert apart(f, difference_force(bending, x, 2e-7)) < 1e-6


@pytest.mark.parametrize("rest", REST_ANGLES)
def test_s14_angle_is_continuous_through_two_turns(rest: float):
    """The moment gives the angle from rest; unwrapped, it follows the hinge all the way round."""
    _, bending = resting_at(rest)
    weight = float(bending.weight[0])
    angles = np.linspace(-2 * np.pi, 2 * np.pi, 601)
    found, energies = [], []
    for angle in angles:
        points = hinge(angle)
        energy, f = evaluate(bending, torch.as_tensor(points))
        found.append(-moment(points, f) / weight)
        energies.append(energy)
    assert np.allclose(np.abs(found), np.sqrt(2 * np.array(energies) / weight), atol=1e-7)
    assert np.abs(found).max() <= np.pi + 1e-9
    unwrapped = np.unwrap(found)
    drift = unwrapped - (angles - rest)
    assert np.allclose(drift, drift[0], atol=1e-7)
    assert drift[0] / (2 * np.pi) == pytest.approx(round(drift[0] / (2 * np.pi)), abs=1e-7)


@pytest.mark.parametrize("rest", REST_ANGLES)
def test_s14_energy_has_no_jump_anywhere(rest: float):
    _, bending = resting_at(rest)
    angles = np.linspace(-2 * np.pi, 2 * np.pi, 1201)
    energies = np.array([evaluate(bending, torch.as_tensor(hinge(angle)))[0] for angle in angles])
    steepest = float(bending.weight[0]) * np.pi
    assert np.abs(np.diff(energies)).max() <= steepest * (angles[1] - angles[0]) * (1 + 1e-6)


def test_s14_a_pressed_hem_stays_shut_on_either_side_of_the_fold():
    """At rest at 3 rad, a hinge at -3 rad is 0.28 rad away, not 6."""
    _, bending = resting_at(3.0)
    energy, f = evaluate(bending, torch.as_tensor(hinge(-3.0)))
    away = 2 * np.pi - 6
    assert energy == pytest.approx(0.5 * float(bending.weight[0]) * away**2)
    assert moment(hinge(-3.0), f) < 0


@pytest.mark.parametrize("angle", [np.pi - 1e-6, -np.pi + 1e-6, np.pi])
def test_s14_single_precision_folds_are_finite_and_close(angle: float):
    _, single = resting_at(0.0, torch.float32)
    _, double = resting_at(0.0)
    points = hinge(angle, turn=4)
    energy, f = evaluate(single, torch.as_tensor(points, dtype=torch.float32))
    expected, g = evaluate(double, torch.as_tensor(points))
    assert energy == pytest.approx(expected, rel=1e-5)
    assert min(apart(f.double(), g), apart(-f.double(), g)) < 1e-4
