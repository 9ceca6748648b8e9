"""S40: every potential's gradient by finite differences in float64, on either side of its kinks."""

import numpy as np
import pytest
import torch
from energies import apart, difference_force, evaluate
from sheets import KINDS, level_of
from test_forces import crumple, force_of
from test_forces_needles import needle_sheet

NAMES = ("stretch", "membrane", "bending", "gravity", "guide", "tether")


@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("kind", [*KINDS, "needles"])
@pytest.mark.parametrize("name", NAMES)
def test_s40_gradient(name: str, kind: str, *, bent: bool):
    """Of sheets that rest flat or rolled up, and of needles whose aspect is 30."""
    points, triangles = needle_sheet(30.0) if kind == "needles" else KINDS[kind](0.4, 0.3, 0.1)
    noise = 0.001 if kind == "needles" else 0.01
    if bent:
        points[:, 2] = 0.1 * np.sin(9.0 * points[:, 0])
    force = force_of(name, level_of(points, triangles, bent=bent))
    x = crumple(points, noise, 8)
    assert apart(evaluate(force, x)[1], difference_force(force, x, 0.02 * noise)) < 1e-6


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
