"""Diagonals and rest matrices of the forces against finite differences; elements of quads."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from energies import apart, difference_force, evaluate
from meshes import grid, mesh_of
from sheets import KINDS, Sheet, garment_of, level_of, rotation
from test_forces import INTERNAL, crumple, force_of
from torch import Tensor

from physgraph_usd.solver.forces.base import Force
from physgraph_usd.solver.forces.bending import Bending, hinge_jacobian
from physgraph_usd.solver.forces.guide import Guide, GuideMap
from physgraph_usd.solver.level import Level, build_levels, refine_garments, triangle_areas
from physgraph_usd.solver.mesh.topology import PolygonMesh

CORNERS = [0, 1, 2, 4]
"""Columns of hinges between triangles, without the corners that stand twice."""


def sheet(kind: str = "irregular") -> Sheet:
    points, triangles = KINDS[kind](0.5, 0.4, 0.1)
    return points @ rotation(5).T + 0.3, triangles


def dense(force: Force, x: Tensor) -> np.ndarray:
    """Hessian by finite differences, shape (V, 3, V, 3)."""
    flat = plain_hessian(force, x)
    return flat.reshape(len(x), 3, len(x), 3)


def matrix_of(force: Force) -> np.ndarray:
    matrix = force.rest_matrix()
    assert matrix is not None
    return matrix.toarray()


def plain_hessian(force: Force, x: Tensor, step: float = 1e-6) -> np.ndarray:
    columns = []
    for v in range(len(x)):
        for axis in range(3):
            moved = x.clone()
            moved[v, axis] += step
            ahead = evaluate(force, moved)[1]
            moved[v, axis] -= 2 * step
            columns.append(((evaluate(force, moved)[1] - ahead) / (2 * step)).reshape(-1).numpy())
    return np.array(columns)


@pytest.mark.parametrize("name", ["membrane", "bending"])
def test_diagonal_away_from_rest(name: str):
    """The stretched membrane's block without the curvature of its sine; bending's without that of its angle."""
    points, triangles = sheet()
    level = level_of(points, triangles)
    force = force_of(name, level)
    if name == "membrane":
        x = 1.2 * level.rest + 0.01 * crumple(points, 0.2, 4)
        expected = np.einsum("vava->v", dense(force, x)) / 3
    else:
        assert isinstance(force, Bending)
        x = crumple(points, 0.02, 4)
        hinges = level.hinges[:, CORNERS]
        jacobian = hinge_jacobian(x, hinges)
        expected = np.zeros(len(x))
        for hinge, rows, weight in zip(hinges.tolist(), jacobian.numpy(), force.weight.tolist(), strict=True):
            for vertex, row in zip(hinge, rows, strict=True):
                expected[vertex] += weight * row @ row / 3
    assert np.allclose(force.diagonal(x).numpy(), expected, rtol=5e-3 if name == "membrane" else 1e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", INTERNAL)
def test_rest_matrix_is_the_trace_of_the_flat_hessian(name: str, kind: str):
    level = level_of(*sheet(kind))
    force = force_of(name, level)
    trace = np.einsum("vawa->vw", dense(force, level.rest))
    assert np.allclose(matrix_of(force), trace, atol=1e-6 * np.abs(trace).max())


def refined() -> Level:
    from meshes import grid
    from sheets import garment_of

    mesh, points = grid(3, 2, "mixed")
    pin = np.where(np.arange(len(points)) == 4, 0.5, 0.0)
    garment = garment_of(mesh, points, pin=pin)
    return build_levels([garment], refine_garments([garment], [2]), dtype=torch.float64)[-1]


def test_guide_is_at_rest_on_the_cage_and_blind_to_wrinkles():
    level = refined()
    guide_map = GuideMap(level)
    count = level.from_coarse.shape[1]
    coarse = torch.randn((count, 3), dtype=torch.float64)
    guide = Guide(level, guide_map, torch.full((count,), 100.0)).retarget(coarse)
    x = level.base.apply(coarse)
    energy, f = evaluate(guide, x)
    assert float(energy) == 0.0
    assert not f.any()
    matrix = guide_map.spread_matrix.T.toarray()
    wrinkle = torch.as_tensor(null_vector(matrix, (level.pin > 0).numpy()))[:, None] * torch.ones(3)
    assert float(evaluate(guide, x + wrinkle)[0]) == pytest.approx(0.0, abs=1e-12)
    off = torch.randn_like(x)
    lag = guide_map.average.apply(off)
    area = torch.as_tensor(guide_map.coarse_area)[:, None]
    expected = 0.5 * 100.0 * (area * lag**2).sum() + 0.5 * 10 * (soft(level, 100.0)[:, None] * off**2).sum()
    assert float(evaluate(guide, x + off)[0]) == pytest.approx(float(expected), rel=1e-9)


def soft(level: Level, stiffness: float) -> Tensor:
    return stiffness * level.vertex_area * level.pin / (1 - level.pin)


def null_vector(matrix: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """A unit vector that the averaging does not see and that leaves fixed vertices alone."""
    constraints = np.concatenate([matrix, np.eye(len(fixed))[fixed]])
    return np.linalg.svd(constraints)[2][-1]


def levels_of(mesh: PolygonMesh, rest: np.ndarray, depth: int = 0) -> tuple[Level, ...]:
    garment = garment_of(mesh, rest, bent=True)
    return build_levels([garment], refine_garments([garment], [depth]), dtype=torch.float64)


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


def test_a_flat_cage_of_triangles_rests_unstrained():
    """Smooth subdivision rounds its outline, and the cloth keeps its own."""
    mesh, points = grid(4, 3, "triangles")
    for level in levels_of(mesh, points, 2):
        for name in INTERNAL:
            assert evaluate(force_of(name, level), level.base.apply(torch.as_tensor(points)))[0] < 1e-12
