"""Diagonals and rest matrices of the forces against finite differences of the forces."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from energies import evaluate
from probes import hessian
from sheets import KINDS, Sheet, equilateral, irregular, level_of, rotation
from test_forces import ELASTIC, INTERNAL, crumple, force_of
from torch import Tensor

from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.forces.base import Force, ForceModule
from physgraph_usd.solver.forces.bending import Bending, hinge_jacobian
from physgraph_usd.solver.forces.guide import Guide, GuideMap
from physgraph_usd.solver.forces.membrane import Membrane, in_plane_terms
from physgraph_usd.solver.forces.stretch import Stretch
from physgraph_usd.solver.integrate.metric import Metric
from physgraph_usd.solver.level import Level, build_levels, refine_garments

CORNERS = [0, 1, 2, 4]
"""Columns of hinges between triangles, without the corners that stand twice."""


def sheet(kind: str = "irregular") -> Sheet:
    points, triangles = KINDS[kind](0.5, 0.4, 0.1)
    return points @ rotation(5).T + 0.3, triangles


def tube() -> Sheet:
    """A polyhedral tube: an equilateral sheet rolled up, edges stiff."""
    points, triangles = equilateral(0.5, 0.4, 0.1)
    return rolled(points, 0.15), triangles


def rolled(points: np.ndarray, radius: float) -> np.ndarray:
    """A sheet bent along the rows of vertices at equal y, so that every triangle stays as it is."""
    height = np.sqrt(0.75) * 0.1
    turn = 2 * np.arcsin(height / (2 * radius))
    row = np.rint(points[:, 1] / height)
    return np.stack([points[:, 0], radius * np.sin(turn * row), radius * np.cos(turn * row)], axis=1)


def dense(force: Force, x: Tensor) -> np.ndarray:
    """Hessian by finite differences, shape (V, 3, V, 3)."""
    flat = plain_hessian(force, x)
    return flat.reshape(len(x), 3, len(x), 3)


def matrix_of(force: Force) -> np.ndarray:
    """The rest matrix of a term that has one."""
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


@pytest.mark.parametrize("name", [*ELASTIC, "guide", "tether"])
def test_diagonal_at_rest_is_a_third_of_the_trace(name: str):
    level = level_of(*tube(), bent=True)
    force = force_of(name, level)
    full = dense(force, level.rest)
    trace = np.einsum("vava->v", full)
    assert np.allclose(force.diagonal(level.rest).numpy(), trace / 3, rtol=1e-5, atol=1e-6 * np.abs(trace).max())


@pytest.mark.parametrize("length", [0.4, 0.9, 1.0, 1.7])
def test_spring_diagonal_is_the_trace_of_the_positive_part(length: float):
    level = level_of(np.eye(3) / np.sqrt(2), np.array([[0, 1, 2]]))
    force = force_of("stretch", level)
    assert isinstance(force, Stretch)
    force.stiffness.mul_(torch.tensor([1.0, 0.0, 0.0]))
    x = level.rest.clone()
    x[1] = x[0] + length * (level.rest[1] - level.rest[0])
    full = dense(force, x)
    for v in (0, 1):
        positive = np.linalg.eigvalsh(full[v, :, v]).clip(0).sum()
        assert float(force.diagonal(x)[v]) == pytest.approx(positive / 3, rel=1e-6)


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


def test_hinge_jacobian_is_the_derivative_of_the_angle():
    points, triangles = sheet()
    level = level_of(points, triangles)
    x = crumple(points, 0.02, 4)
    force = force_of("bending", level)
    assert isinstance(force, Bending)
    half, hinges = torch.zeros_like(x), level.hinges[:, CORNERS].long()
    jacobian = hinge_jacobian(x, hinges)
    force.add_force(x, half)
    angle = torch.sqrt(2 * force.split(x)[0] / force.weight)
    pull = -(jacobian * (force.weight * signed(angle, hinges, x))[:, None, None]).reshape(-1, 3)
    total = torch.zeros_like(x).index_add_(0, hinges.reshape(-1), pull)
    assert torch.allclose(total, half, rtol=1e-9, atol=1e-12)


def signed(angle: Tensor, hinges: Tensor, x: Tensor) -> Tensor:
    i, j, k, m = (x[hinges[:, n]] for n in range(4))
    volume = (torch.linalg.cross(j - i, k - i) * (m - i)).sum(dim=1)
    return -angle * volume.sign()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", INTERNAL)
def test_rest_matrix_is_the_trace_of_the_flat_hessian(name: str, kind: str):
    level = level_of(*sheet(kind))
    force = force_of(name, level)
    trace = np.einsum("vawa->vw", dense(force, level.rest))
    assert np.allclose(matrix_of(force), trace, atol=1e-6 * np.abs(trace).max())


@pytest.mark.parametrize("name", INTERNAL)
def test_rest_matrix_does_not_depend_on_how_the_sheet_is_rolled(name: str):
    flat = level_of(*equilateral(0.5, 0.4, 0.1))
    rolled_up = level_of(*tube())
    expected = matrix_of(force_of(name, flat))
    assert np.allclose(matrix_of(force_of(name, rolled_up)), expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("name", INTERNAL)
def test_rest_matrix_is_positive_and_constants_cost_nothing(name: str, bent: bool):
    rng = np.random.default_rng(2)
    points, triangles = sheet()
    matrix = matrix_of(
        force_of(name, level_of(points + rng.normal(scale=0.05, size=points.shape), triangles, bent=bent))
    )
    size = np.abs(matrix).max()
    assert np.abs(matrix - matrix.T).max() < 1e-12 * size
    assert np.abs(matrix.sum(axis=1)).max() < 1e-12 * size
    assert np.linalg.eigvalsh(matrix).min() > -1e-12 * size
    assert np.linalg.matrix_rank(matrix, tol=1e-9 * size) >= len(matrix) - 3


def test_bending_of_a_flat_sheet_costs_nothing_for_linear_functions():
    points, triangles = sheet()
    matrix = matrix_of(force_of("bending", level_of(points, triangles)))
    assert np.abs(matrix @ points).max() < 1e-9 * np.abs(matrix).max()


def test_membrane_and_springs_have_one_metric_on_equilateral_triangles():
    level = level_of(*sheet("equilateral"))
    springs, triangles = (in_plane_terms(level, [fabric])[0] for fabric in (Fabric(30.0), Fabric(30.0, shear=11.25)))
    expected = matrix_of(springs)
    assert np.allclose(matrix_of(triangles), expected, atol=1e-9 * np.abs(expected).max())


def test_tether_matrix_is_its_hessian():
    level = level_of(*sheet())
    force = force_of("tether", level)
    full = dense(force, level.rest)
    assert np.allclose(np.einsum("vawa->vw", full) / 3, matrix_of(force), atol=1e-7)


def refined() -> Level:
    from meshes import grid
    from sheets import garment_of

    mesh, points = grid(3, 2, "mixed")
    pin = np.where(np.arange(len(points)) == 4, 0.5, 0.0)
    garment = garment_of(mesh, points, pin=pin)
    return build_levels([garment], refine_garments([garment], [2]), dtype=torch.float64)[-1]


def test_guide_matrix_sums_its_hessian_onto_the_diagonal():
    level = refined()
    count = level.from_coarse.shape[1]
    coarse = torch.randn((count, 3), dtype=torch.float64)
    guide = Guide(level, GuideMap(level), torch.linspace(100.0, 200.0, count)).retarget(coarse)
    full = dense(guide, level.rest)[:, 0, :, 0]
    matrix = guide.rest_matrix()
    assert np.allclose(matrix.diagonal(), full.sum(axis=1), rtol=1e-6)
    assert np.allclose(guide.diagonal(level.rest).numpy(), np.diag(full), rtol=1e-6)
    assert np.linalg.eigvalsh(matrix.toarray() - full).min() > -1e-6 * full.max()


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


def test_coloured_differences_are_plain_differences():
    level = level_of(*irregular(0.5, 0.4, 0.1))
    for name in INTERNAL:
        force = force_of(name, level)
        plain = plain_hessian(force, level.rest)
        assert np.allclose(hessian(force, level.rest, [0, 1, 2]), plain, atol=1e-5 * np.abs(plain).max())


def test_metric_of_springs_and_of_triangles_solves_in_both_precisions():
    level = level_of(*sheet())
    f = torch.randn_like(level.rest)
    for fabric in (Fabric(), Fabric(shear=3.0)):
        terms = [*in_plane_terms(level, [fabric]), force_of("bending", level), force_of("tether", level)]
        matrix = ForceModule(terms).rest_matrix()
        assert (Membrane in {type(term) for term in terms}) == (fabric.shear is not None)
        for dtype, tolerance in ((torch.float64, 1e-5), (torch.float32, 1e-3)):
            move = Metric(matrix, free=level.free, dtype=dtype).solve(f.to(dtype)).double().numpy()
            assert np.abs(matrix @ move - f.numpy()).max() < tolerance * np.abs(f.numpy()).max()
