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


TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0.6, 0.9, 0]])
SPRINGS = [
    ("stretch", [[0, 0, 0], [x, 0, 0], [0.6, 0.9, 0]], 0.01 * min(x, 1e-2)) for x in (1e-4, 0.01, 0.999, 1.001, 10)
]
MEMBRANES = [("membrane", TRIANGLE * [1.1, squeeze, 1.0], 1e-3) for squeeze in (0.01, 0.3, -0.5)]


@pytest.mark.parametrize(("name", "points", "step"), SPRINGS + MEMBRANES)
def test_s40_near_collapse_turned_inside_out_and_on_either_side_of_rest(name: str, points: np.ndarray, step: float):
    """Membranes are smooth but where warp or weft vanishes, and there no more than a spring does."""
    force, x = force_of(name, level_of(TRIANGLE, np.array([[0, 1, 2]]))), torch.as_tensor(np.array(points, float))
    assert apart(evaluate(force, x)[1], difference_force(force, x, step)) < 1e-6
