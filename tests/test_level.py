"""Levels: rest shapes whose parts sum to the whole, and maps between resolutions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import any_mesh, grid, mesh_of, planar_mesh
from sheets import equilateral, garment_of, level_of, rotation
from test_forces import force_of

from physgraph_usd.solver.level import (
    HINGE_SHAPE_LIMIT,
    Level,
    build_levels,
    hinge_geometry,
    refine_garments,
    rest_shape,
    triangle_areas,
    triangle_inverse,
)
from physgraph_usd.solver.mesh.elements import hinges_of
from physgraph_usd.solver.mesh.topology import PolygonMesh, edges_of


def shape_of(rest: np.ndarray, triangles: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    edges, hinges = edges_of(triangles, len(rest)).vertices, hinges_of(triangles)
    shape = rest_shape(
        rest,
        edges,
        triangles,
        share=np.ones(len(triangles)),
        hinges=hinges,
        twists=np.zeros(len(hinges), bool),
        bent=np.ones(len(hinges), bool),
        size=np.ones(len(rest)),
    )
    return shape, edges, hinges


def areas(rest: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (rest[triangles[:, n]] for n in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


@given(mesh=any_mesh(), seed=st.integers(0, 2**16))
def test_areas_of_springs_and_of_vertices_sum_to_the_sheet(mesh: PolygonMesh, seed: int):
    rest = np.random.default_rng(seed).normal(size=(mesh.vertex_count, 3))
    triangles = mesh.triangulate(rest).triangles
    shape, edges, _ = shape_of(rest, triangles)
    total = areas(rest, triangles)
    assert shape["spring_area"].sum() == pytest.approx(total.sum())
    assert shape["vertex_area"].sum() == pytest.approx(total.sum())
    for edge, value in zip(edges, shape["spring_area"], strict=True):
        touching = np.isin(triangles, edge).sum(axis=1) == 2
        assert value == pytest.approx(total[touching].sum() / 3)


@given(mesh=any_mesh(), seed=st.integers(0, 2**16))
def test_lengths_and_spacing(mesh: PolygonMesh, seed: int):
    rest = np.random.default_rng(seed).normal(size=(mesh.vertex_count, 3))
    shape, edges, _ = shape_of(rest, mesh.triangulate(rest).triangles)
    assert np.allclose(shape["spring_length"], np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1))
    for vertex in np.unique(edges):
        mine = (edges == vertex).any(axis=1)
        assert shape["spacing"][vertex] == pytest.approx(shape["spring_length"][mine].mean())
    assert (shape["spacing"] > 0).all()


def test_equilateral_hinges_have_one_shape_and_slivers_are_capped():
    rest, triangles = equilateral(0.5, 0.4, 0.1)
    shape, _, hinges = shape_of(rest, triangles)
    assert np.allclose(shape["hinge_shape"], 2 / np.sqrt(3))
    assert not shape["rest_angle"].any()
    flat, _, _ = shape_of(rest * [1, 1e-4, 1], triangles)
    assert flat["hinge_shape"].max() == HINGE_SHAPE_LIMIT
    gone, _, _ = shape_of(rest * [1, 0, 1], triangles)
    assert all(np.isfinite(value).all() for value in gone.values())
    assert len(hinges)


@pytest.mark.parametrize("angle", [0.0, 0.3, -2.0, 3.1, -3.1])
def test_angle_of_a_hinge(angle: float):
    """Triangle 2 turns about x; lifting both wings along the normals' side is a negative angle."""
    wing = [0.5, -np.cos(angle), np.sin(angle)]
    points = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], wing]) @ rotation(3).T
    found, first, second, length = hinge_geometry(points, np.array([[0, 1, 2, 2, 3, 3]]))
    assert found[0] == pytest.approx(-angle, abs=1e-12)
    assert (first[0], second[0], length[0]) == pytest.approx((0.5, 0.5, 1.0))
    swapped = hinge_geometry(points, np.array([[1, 0, 3, 3, 2, 2]]))[0]
    assert swapped[0] == pytest.approx(-angle, abs=1e-12)


@settings(max_examples=40)
@given(case=planar_mesh(), seed=st.integers(0, 2**16))
def test_triangle_inverse_undoes_the_sides(case: tuple[PolygonMesh, np.ndarray], seed: int):
    mesh, rest = case
    rest = rest @ rotation(seed).T
    triangles = mesh.triangulate(rest).triangles
    inverse = triangle_inverse(rest, triangles)
    assert np.allclose(triangle_areas(rest, triangles), areas(rest, triangles))
    sides = rest[triangles[:, 1:]] - rest[triangles[:, :1]]
    frame = np.einsum("tsc,tsm->tcm", sides, inverse.reshape(-1, 2, 2))
    metric = np.einsum("tcm,tcn->tmn", frame, frame)
    assert np.allclose(metric, np.eye(2), atol=1e-9)


def test_material_axes_follow_the_rest_frame_and_not_the_triangles():
    """A sheet in a coordinate plane, or rolled about a coordinate axis, has its frame's axes up to quarter turns."""
    flat, triangles = equilateral(0.5, 0.4, 0.1)
    roll = np.stack([flat[:, 0], 0.2 * np.sin(flat[:, 1] / 0.2), 0.2 * np.cos(flat[:, 1] / 0.2)], axis=1)
    for rest in (flat, flat[:, [2, 0, 1]], roll, roll[:, [1, 2, 0]]):
        inverse = triangle_inverse(rest, triangles)
        sides = rest[triangles[:, 1:]] - rest[triangles[:, :1]]
        frame = np.einsum("tsc,tsm->tmc", sides, inverse.reshape(-1, 2, 2))
        along = np.abs(frame).max(axis=1).max(axis=1)
        assert along.min() > 1 - 1e-9


def test_triangles_without_area_are_marked():
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0.0]])
    triangles = np.array([[0, 1, 2], [0, 1, 3], [0, 0, 1]])
    inverse = triangle_inverse(points, triangles)
    assert triangle_areas(points, triangles) == pytest.approx([0, 0.5, 0])
    assert inverse.any(axis=1).tolist() == [False, True, False]


def two_garments(depths: tuple[int, ...], *, only: slice = slice(2)) -> tuple[Level, ...]:
    """Levels of two garments, the second of which has paint, pins and a loose point."""
    first, points = grid(3, 2, "mixed")
    second = mesh_of([[0, 1, 2], [1, 3, 2], [1, 4, 5, 3]], 7)
    other = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 0, 0.5], [2, 1, 0.5], [9, 9, 9.0]])
    paint = np.linspace(0.5, 2.0, 7)
    garments = [
        garment_of(first, points),
        garment_of(second, other, stretch_scale=paint, bend_scale=paint, pin=paint / 2),
    ]
    garments, depths = garments[only], depths[only]
    return build_levels(garments, refine_garments(garments, depths), dtype=torch.float64)


def test_garments_side_by_side_are_what_they_are_alone():
    level, alone = two_garments((1, 1))[1], two_garments((1, 1), only=slice(1, 2))[1]
    start = level.spans[1].start
    assert level.spans[1].stop == level.vertex_count == start + alone.vertex_count
    assert torch.equal(level.triangles[-len(alone.triangles) :] - start, alone.triangles)
    for owner, names in (
        ("spring", ("springs", "spring_area", "spring_length", "spring_scale")),
        ("membrane", ("membrane", "membrane_area", "membrane_inverse", "membrane_scale")),
        ("hinge", ("hinges", "hinge_shape", "rest_angle", "bend_scale")),
        ("vertex", ("rest", "vertex_area", "pin")),
    ):
        mine = getattr(level, f"{owner}_garment") == 1
        for name in names:
            values, expected = getattr(level, name)[mine], getattr(alone, name)
            assert torch.allclose(values if values.is_floating_point() else values - start, expected), name
    used = alone.vertex_area > 0
    assert torch.allclose(level.spacing[start:][used], alone.spacing[used])


def test_paint_is_the_mean_of_the_vertices():
    level = two_garments((0, 0))[0]
    paint = torch.cat([torch.ones(level.spans[0].stop, dtype=torch.float64), torch.linspace(0.5, 2.0, 7).double()])
    assert torch.allclose(level.spring_scale, paint[level.springs.long()].mean(dim=1))
    assert torch.allclose(level.membrane_scale, paint[level.membrane.long()].mean(dim=1))
    assert torch.allclose(level.bend_scale, paint[level.hinges[:, :2].long()].mean(dim=1))


def test_pins_and_loose_points_are_not_free():
    level = two_garments((0, 0))[0]
    fixed = torch.nonzero(~level.free.squeeze(1)).squeeze(1)
    isolated_and_pinned = level.vertex_count - 1
    assert fixed.tolist() == [isolated_and_pinned]
    assert level.pin[isolated_and_pinned] == 1.0


@pytest.mark.parametrize("depths", [(2, 2), (2, 0), (0, 1)])
def test_maps_between_levels_compose(depths: tuple[int, int]):
    levels = two_garments(depths)
    assert len(levels) == max(depths) + 1
    cage = torch.randn((levels[0].vertex_count, 3), dtype=torch.float64)
    x = cage
    for level in levels[1:]:
        assert level.from_below is not None
        x = level.from_below.apply(x)
        assert torch.allclose(x, level.base.apply(cage))
        assert torch.allclose(level.smooth_base.apply(torch.ones_like(cage)), torch.ones_like(level.rest))
    assert levels[0].from_below is None


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


def test_level_of_nothing():
    level = build_levels([garment_of(mesh_of([], 0), np.zeros((0, 3)))], [()])[0]
    assert level.vertex_count == 0
    assert level.dtype == torch.float32
    assert level.device == "cpu"


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
