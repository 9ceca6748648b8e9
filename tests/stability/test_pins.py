"""S17: pins. None, one, all, soft ones."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from cloth import base_of, rms, sheet, solved, wave

MESH, REST = sheet(6, 4)
POINTS = wave(REST) + np.array([3.3, 1.7, -5.1])
COUNT = len(REST)


def pins(which: list[int], value: float = 1.0) -> dict[str, np.ndarray]:
    pin = np.zeros(COUNT)
    pin[which] = value
    return {"pin": pin}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_s17_all_pinned_returns_the_input_to_the_bit(level: int, dtype: torch.dtype):
    out = solved(MESH, REST, POINTS, level=level, dtype=dtype, painted=pins(list(range(COUNT)))).points[0]
    assert np.array_equal(out[:COUNT], POINTS)
    assert np.allclose(out, base_of(MESH, POINTS, level), rtol=0, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("integrator", ["quasi-newton", "newton", "lbfgs", "adam", "gd"])
def test_s17_one_pin_keeps_its_bits_and_the_rest_moves(integrator: str, dtype: torch.dtype):
    out = solved(MESH, REST, POINTS, level=1, dtype=dtype, integrator=integrator, painted=pins([9])).points[0]
    assert np.array_equal(out[9], POINTS[9])
    others = np.delete(out - base_of(MESH, POINTS, 1), 9, axis=0)
    assert (np.abs(others).max(axis=1) > 0).all()


def test_s17_a_pinned_edge_holds_its_midpoints():
    top = list(range(COUNT - 7, COUNT))
    out = solved(MESH, REST, POINTS, level=2, painted=pins(top)).points[0]
    base = base_of(MESH, POINTS, 2)
    held = np.flatnonzero(base_of(MESH, np.repeat(pins(top)["pin"][:, None], 3, axis=1), 2)[:, 0] == 1.0)
    assert len(held) == 4 * 6 + 1
    assert np.allclose(out[held], base[held], rtol=0, atol=1e-14)


def test_s17_none_pinned_follows_the_animation_on_average():
    out = solved(MESH, REST, POINTS, level=1, steps=50).points[0]
    assert rms(out - base_of(MESH, POINTS, 1)) > 1e-3
    assert np.abs(out.mean(axis=0) - base_of(MESH, POINTS, 1).mean(axis=0)).max() < 0.2 * 0.05


def test_s17_soft_pins_hold_the_more_the_higher():
    def strays(value: float) -> float:
        out = solved(MESH, REST, POINTS, level=1, steps=200, tolerance=1e-6, painted=pins([9], value)).points[0]
        return float(np.linalg.norm(out[9] - POINTS[9]))

    found = [strays(value) for value in (0.0, 0.3, 0.9, 0.999, 1.0)]
    assert all(after < before for before, after in pairwise(found)), found
    assert found[-1] == 0.0
