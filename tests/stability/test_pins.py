"""S17: pinned edges and soft pins."""

from itertools import pairwise

import numpy as np
from cloth import base_of, sheet, solved, wave

MESH, REST = sheet(6, 4)
POINTS = wave(REST) + np.array([3.3, 1.7, -5.1])
COUNT = len(REST)


def pins(which: list[int], value: float = 1.0) -> dict[str, np.ndarray]:
    pin = np.zeros(COUNT)
    pin[which] = value
    return {"pin": pin}


def test_s17_a_pinned_edge_holds_its_midpoints():
    top = list(range(COUNT - 7, COUNT))
    out = solved(MESH, REST, POINTS, level=2, painted=pins(top)).points[0]
    base = base_of(MESH, POINTS, 2)
    held = np.flatnonzero(base_of(MESH, np.repeat(pins(top)["pin"][:, None], 3, axis=1), 2)[:, 0] == 1.0)
    assert len(held) == 4 * 6 + 1
    assert np.allclose(out[held], base[held], rtol=0, atol=1e-14)


def test_s17_soft_pins_hold_the_more_the_higher():
    def strays(value: float) -> float:
        out = solved(MESH, REST, POINTS, level=1, steps=200, tolerance=1e-6, painted=pins([9], value)).points[0]
        return float(np.linalg.norm(out[9] - POINTS[9]))

    found = [strays(value) for value in (0.0, 0.3, 0.9, 0.999, 1.0)]
    assert all(after < before for before, after in pairwise(found)), found
    assert found[-1] == 0.0
