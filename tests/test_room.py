"""Room between the walls of one body, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from bodies import ball, box, surfaces, together

from physgraph_usd.solver.colliders.primitives import ShapeSurface
from physgraph_usd.solver.contact.room import room_above


@pytest.mark.parametrize("gap", [0.0005, 0.01, 0.05])
def test_between_two_boxes_it_is_their_gap(gap: float):
    points, triangles = box()
    (surface,) = surfaces(together((points, triangles), (points + np.array([0.0, 0.2 + gap, 0.0]), triangles)))
    foot = torch.tensor([[0.03, 0.1, 0.04], [-0.02, 0.1, 0.01]], dtype=torch.float64)
    up = torch.tensor([[0.0, 1.0, 0.0]] * 2, dtype=torch.float64)
    shift = torch.as_tensor(surface.origin)
    for reach, expected in ((0.1, gap), (0.5 * gap, float("inf"))):
        found = room_above(surface, foot - shift, up, reach=torch.full((2,), reach, dtype=torch.float64))
        assert found.tolist() == pytest.approx([expected] * 2, abs=3e-5)


def test_above_a_convex_body_there_is_no_end():
    (surface,) = surfaces(ball(0.1, level=2))
    up = torch.nn.functional.normalize(torch.randn((50, 3), dtype=torch.float64), dim=1)
    near = surface.closest(0.3 * up, torch.full((50,), torch.inf, dtype=torch.float64))
    reach = torch.ones(50, dtype=torch.float64)
    assert bool(room_above(surface, near.point, up, reach=reach).isinf().all())
    assert len(room_above(surface, near.point[:0], up[:0], reach=reach[:0])) == 0


def test_primitives_have_no_other_wall():
    from test_contact import up

    surface = ShapeSurface(up("sphere", (0.1, 0.1, 0.1)))
    one = torch.ones((1, 3), dtype=torch.float64)
    assert bool(room_above(surface, one, one, reach=one[:, 0]).isinf().all())
