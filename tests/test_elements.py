"""Elastic elements of quads: without a preferred corner or diagonal, isotropic, and of the cage's area."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from energies import apart, difference_force, evaluate
from meshes import cube, grid, mesh_of
from probes import cylinder_rigidity
from sheets import garment_of
from test_force_hessians import dense, matrix_of
from test_forces import INTERNAL, crumple, force_of

from physgraph_usd.solver.level import Level, build_levels, refine_garments, triangle_areas
from physgraph_usd.solver.mesh.topology import PolygonMesh


def levels_of(mesh: PolygonMesh, rest: np.ndarray, depth: int = 0) -> tuple[Level, ...]:
    garment = garment_of(mesh, rest, bent=True)
    return build_levels([garment], refine_garments([garment], [depth]), dtype=torch.float64)


def tube(sides: int, rows: int) -> tuple[PolygonMesh, np.ndarray]:
    """An open tube of quads, a unit in radius, its quads about square."""
    faces = [
        [sides * row + n, sides * row + (n + 1) % sides, sides * (row + 1) + (n + 1) % sides, sides * (row + 1) + n]
        for row in range(rows)
        for n in range(sides)
    ]
    turn, rise = 2 * np.pi * np.arange(sides) / sides, 2 * np.sin(np.pi / sides) * np.arange(rows + 1)
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    return mesh_of(faces), (ring + rise[:, None, None] * [0.0, 0.0, 1.0]).reshape(-1, 3)


def test_no_corner_of_a_quad_is_the_first():
    """Small twists are the same round either diagonal; stretch is the mean of both splits."""
    mesh, flat = grid(4, 3)
    rest = flat * [1.0, 0.7, 0.0]
    x = torch.as_tensor(rest + 1e-4 * np.random.default_rng(0).normal(size=rest.shape))
    energies = []
    for turn in range(4):
        rolled = PolygonMesh(mesh.counts, np.roll(mesh.indices.reshape(-1, 4), turn, axis=1).ravel(), len(rest))
        level = levels_of(rolled, rest)[0]
        energies.append([evaluate(force_of(name, level), x)[0] for name in INTERNAL])
    np.testing.assert_allclose(energies, np.broadcast_to(energies[0], (4, 3)), rtol=1e-3)


@pytest.mark.parametrize("name", INTERNAL)
def test_forces_of_triangles_beside_quads_are_minus_the_gradient(name: str):
    mesh, flat = grid(4, 2, "mixed")
    level = levels_of(mesh, flat + np.random.default_rng(0).normal(scale=0.05, size=flat.shape))[0]
    force, x = force_of(name, level), crumple(flat, 0.1, 2)
    assert apart(evaluate(force, x)[1], difference_force(force, x, 1e-3)) < 1e-6


@pytest.mark.parametrize("name", INTERNAL)
def test_the_rest_matrix_of_triangles_beside_quads_is_the_trace_of_the_hessian(name: str):
    mesh, flat = grid(4, 2, "mixed")
    level = levels_of(mesh, flat + np.random.default_rng(0).uniform(-0.1, 0.1, flat.shape) * [1.0, 1.0, 0.0])[0]
    force = force_of(name, level)
    trace = np.einsum("vawa->vw", dense(force, level.rest))
    assert np.allclose(matrix_of(force), trace, atol=1e-6 * np.abs(trace).max())


def test_a_grid_of_rectangles_bends_alike_in_every_direction():
    mesh, points = grid(24, 12)
    level = levels_of(mesh, points * [0.01, 0.02, 0.0])[0]
    found = [cylinder_rigidity(level, 0.3, angle) for angle in np.linspace(0.0, np.pi, 9)[:-1]]
    assert found == pytest.approx([1.0] * 8, abs=0.05)


@pytest.mark.parametrize(
    "corners", [[[0, 0], [1, -3], [0, 9], [-1, -3]], [[0, 0], [1, 0], [1, 0], [0, 1]], [[0, 0], [1, 0], [2, 0], [0, 1]]]
)
def test_quads_that_are_not_convex_count_as_triangles(corners: list[list[float]]):
    """A dart, a quad with a side without length, and a quad with a straight corner."""
    rest = np.column_stack([np.array(corners, float), np.zeros(4)])
    level = levels_of(mesh_of([[0, 1, 2, 3]]), rest)[0]
    assert torch.equal(level.membrane, level.triangles)
    assert torch.equal(level.springs, level.edges)
    split = mesh_of([[0, 1, 2, 3]]).triangulate(rest).triangles
    assert float(level.membrane_area.sum()) == pytest.approx(triangle_areas(rest, split).sum())


@pytest.mark.parametrize("case", [cube(), tube(8, 6)], ids=["ball", "tube"])
def test_subdivided_cloth_has_the_area_of_its_cage(case: tuple[PolygonMesh, np.ndarray]):
    cage, *finer = levels_of(*case, depth=2)
    for level in finer:
        assert float(level.membrane_area.sum()) == pytest.approx(float(cage.membrane_area.sum()), rel=0.01)


def test_flat_squares_keep_their_lengths():
    mesh, points = grid(4, 3)
    for level in levels_of(mesh, points, 2):
        length = np.linalg.norm(np.diff((level.from_coarse @ points)[level.springs.numpy()], axis=1)[:, 0], axis=1)
        np.testing.assert_allclose(level.spring_length.numpy(), length, rtol=1e-12)


def test_a_flat_cage_of_triangles_rests_unstrained():
    """Smooth subdivision rounds its outline, and the cloth keeps its own."""
    mesh, points = grid(4, 3, "triangles")
    for level in levels_of(mesh, points, 2):
        for name in INTERNAL:
            assert evaluate(force_of(name, level), level.base.apply(torch.as_tensor(points)))[0] < 1e-12
