"""S40: every potential's gradient by finite differences in float64, on either side of its kinks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from energies import apart, difference_force, evaluate
from sheets import KINDS, level_of
from test_forces import crumple, force_of

NAMES = ("stretch", "membrane", "bending", "gravity", "guide", "tether")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_s40_gradient(name: str, kind: str):
    points, triangles = KINDS[kind](0.4, 0.3, 0.1)
    force = force_of(name, level_of(points, triangles))
    x = crumple(points, 0.01, 8)
    assert apart(evaluate(force, x)[1], difference_force(force, x, 2e-4)) < 1e-6


@pytest.mark.parametrize("length", [1e-4, 1e-2, 0.999, 1.001, 10.0])
def test_s40_springs_near_collapse_and_on_either_side_of_rest(length: float):
    points = np.array([[0, 0, 0], [1, 0, 0], [0.6, 0.9, 0]])
    force = force_of("stretch", level_of(points, np.array([[0, 1, 2]])))
    points[1, 0] = length
    x = torch.as_tensor(points)
    assert apart(evaluate(force, x)[1], difference_force(force, x, 0.01 * min(length, 1e-2))) < 1e-6


@pytest.mark.parametrize("squeeze", [0.01, 0.3, -0.5])
def test_s40_membrane_collapsed_and_turned_inside_out(squeeze: float):
    """Smooth but where warp or weft vanishes, and there no more than a spring does."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0.6, 0.9, 0]])
    force = force_of("membrane", level_of(points, np.array([[0, 1, 2]])))
    x = torch.as_tensor(points * [1.1, squeeze, 1.0])
    assert apart(evaluate(force, x)[1], difference_force(force, x, 1e-3)) < 1e-6
