"""The contact force against one plane: nothing above it, a spring below it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sheets import equilateral, level_of

from physgraph_usd.solver.forces.contact import Contact, Planes

STIFFNESS = 50.0
POINTS, TRIANGLES = equilateral(0.3, 0.2, 0.1)
LEVEL = level_of(POINTS, TRIANGLES)


def force_at(height: float) -> tuple[float, np.ndarray]:
    """Energy and force of a flat sheet at a height over a plane z = 0 that the first four vertices see."""
    vertex = torch.arange(4, dtype=torch.int32)
    normal = torch.tensor([[0.0, 0.0, 1.0]] * 4, dtype=torch.float64)
    planes = Planes(vertex, normal, torch.zeros(4, dtype=torch.float64))
    x = torch.as_tensor(POINTS + np.array([0.0, 0.0, height]))
    force = torch.zeros_like(x)
    energy = Contact(LEVEL, [planes], STIFFNESS).add_force(x, force)
    return float(energy), force.numpy()


@pytest.mark.parametrize("height", [0.0, 1e-6, 0.3])
def test_cloth_on_or_above_a_plane_feels_nothing(height: float):
    energy, force = force_at(height)
    assert energy == 0.0
    assert not force.any()


@pytest.mark.parametrize("depth", [1e-4, 0.02])
def test_cloth_below_it_is_pushed_by_a_spring_per_area(depth: float):
    energy, force = force_at(-depth)
    area = LEVEL.vertex_area.numpy()[:4]
    np.testing.assert_allclose(force[:4, 2], STIFFNESS * area * depth, rtol=1e-12)
    assert not force[4:].any()
    assert not force[:, :2].any()
    assert energy == pytest.approx(0.5 * STIFFNESS * area.sum() * depth**2)
