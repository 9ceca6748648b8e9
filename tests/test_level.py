"""Levels: rest shapes whose parts sum to the whole, and maps between resolutions."""

import numpy as np
import pytest
import torch
from meshes import grid
from sheets import equilateral, garment_of, level_of
from test_forces import force_of

from physgraph_usd.solver.level import build_levels, hinge_geometry, refine_garments


@pytest.mark.parametrize("name", ["stretch", "membrane"])
def test_uniform_strain_costs_the_same_at_every_level(name: str):
    """A stiffness means the same at every level; of triangles smooth subdivision rounds the corners off."""
    mesh, points = grid(3, 2)
    garment = garment_of(mesh, points)
    strain = torch.tensor([[1.1, 0.05, 0.0], [0.0, 0.95, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    energies = []
    for level in build_levels([garment], refine_garments([garment], [2]), dtype=torch.float64):
        energies.append(float(force_of(name, level).add_force(level.rest @ strain, torch.zeros_like(level.rest))))
    assert energies == pytest.approx([energies[0]] * 3, rel=1e-12)


@pytest.mark.parametrize("bent", [True, False])
def test_cloth_rests_at_its_own_angles_or_flat(bent: bool):
    points, triangles = equilateral(0.4, 0.3, 0.1)
    rolled = np.stack([0.2 * np.sin(5 * points[:, 0]), points[:, 1], 0.2 * np.cos(5 * points[:, 0])], axis=1)
    level = level_of(rolled, triangles, bent=bent)
    angle = hinge_geometry(rolled, level.hinges.numpy())[0]
    assert np.abs(angle).max() > 0.1
    np.testing.assert_allclose(level.rest_angle.numpy(), angle if bent else 0 * angle, atol=1e-12)


def test_triangles_without_area_and_those_that_repeat_are_no_cloth():
    points, triangles = equilateral(0.4, 0.3, 0.1)
    more = np.vstack([points, points[:2].mean(axis=0)])
    extra = np.array([[0, len(points), 1], triangles[3], triangles[5][::-1]])
    level = level_of(more, np.vstack([triangles, extra]))
    assert len(level.triangles) == len(triangles)
    assert not bool(level.free[len(points)])


@pytest.mark.parametrize("kind", ["quads", "triangles"])
@pytest.mark.parametrize("turn", [0.4, 0.8, 1.2])
def test_a_folded_cage_keeps_its_lengths(kind: str, turn: float):
    """Along the fold and across it; cloth that is too long along a fold crumples there."""
    mesh, flat = grid(8, 8, kind)
    away = flat[:, 0] - 0.5 * (flat[:, 0].min() + flat[:, 0].max())
    rest = np.stack([np.cos(turn) * away, flat[:, 1], -np.sin(turn) * np.abs(away)], axis=1)
    garments = [garment_of(mesh, rest)]
    level = build_levels(garments, refine_garments(garments, [2]), dtype=torch.float64)[-1]
    ends, length = level.rest[level.springs.long()], level.spring_length  # Of the cage, flat between its edges.
    along, row = (ends[:, :, 0].abs() < 1e-9).all(dim=1), ends[:, 0, 1].sub(ends[:, 1, 1]).abs() < 1e-9
    assert float(length[along].sum()) == pytest.approx(np.ptp(flat[:, 1]), rel=0.02)
    assert float(length[row].sum()) == pytest.approx(float((ends[:, 1] - ends[:, 0]).norm(dim=1)[row].sum()), rel=0.02)
    assert float(level.membrane_area.sum()) == pytest.approx(float(np.prod(np.ptp(flat[:, :2], axis=0))), rel=0.01)
