"""Points bound to a surface follow it: as one body, through bends, and without its facets."""

from __future__ import annotations

import numpy as np
import pytest

from physgraph_usd.usd.mesh.bind import Binding, closest

TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
TURN = TURN * np.sign(np.linalg.det(TURN))


def sheet(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """A unit square in triangles: positions [m] and corners."""
    line = np.linspace(0.0, 1.0, cells + 1)
    y, x = (each.ravel() for each in np.meshgrid(line, line, indexing="ij"))
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
    a, b, c, d = (each.ravel() for each in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack([x, y, 0.0 * x], axis=1), triangles


def rolled(points: np.ndarray, curvature: float = 2.0) -> np.ndarray:
    """A flat sheet and what lies beside it, rolled without stretch."""
    angle, radius = curvature * points[:, 0], 1.0 / curvature - points[:, 2]
    return np.stack([radius * np.sin(angle), points[:, 1], 1.0 / curvature - radius * np.cos(angle)], axis=1)


def cloud(count: int, depth: float) -> np.ndarray:
    """Points beside the sheet, away from its border."""
    return np.random.default_rng(1).uniform([0.1, 0.1, -depth], [0.9, 0.9, depth], (count, 3))


def test_what_is_closest_is_found_inside_on_edges_and_beyond_the_border():
    points, triangles = sheet(4)
    asked = np.array([[0.3, 0.4, 0.2], [-0.3, 0.5, 0.4], [1.3, 1.4, 0.0], [0.25, 0.25, -0.1]])
    found = closest(asked, points, triangles)
    assert found.distance == pytest.approx([0.2, 0.5, 0.5, 0.1])
    places = np.einsum("nk,nkx->nx", found.weights, points[triangles[found.triangle]])
    np.testing.assert_allclose(np.linalg.norm(places - asked, axis=1), found.distance, atol=1e-12)
    assert (found.weights >= 0.0).all()


def test_points_stay_in_the_bind_pose_and_move_as_one_body_with_the_surface():
    points, triangles = sheet(8)
    bound = Binding.of(cloud(200, 0.1), points, triangles)
    np.testing.assert_allclose(bound.at(points).points, bound.bind, atol=1e-12)
    moved = bound.at(points @ TURN.T + 3.0)
    np.testing.assert_allclose(moved.points, bound.bind @ TURN.T + 3.0, atol=1e-9)
    every = np.arange(200)
    np.testing.assert_allclose(moved.turned(np.tile([0.0, 0.0, 1.0], (200, 1)), every), np.tile(TURN[:, 2], (200, 1)))


def test_a_stretched_surface_stretches_what_lies_along_it_and_keeps_its_distance():
    points, triangles = sheet(8)
    bound = Binding.of(cloud(200, 0.02), points, triangles)
    np.testing.assert_allclose(bound.at(points * [1.3, 1.0, 1.0]).points, bound.bind * [1.3, 1.0, 1.0], atol=1e-9)


def test_facets_do_not_print_through_and_thickness_is_kept():
    """A sheet rolled in chords: their middles lie 2.5 mm within the arc; what is bound to them lies on the arc."""
    points, triangles = sheet(10)
    chord = 0.5 * (1.0 - np.cos(0.1))
    flat = cloud(2000, 0.0)
    up = np.array([0.0, 0.0, 1e-3])
    thick = Binding.of(np.concatenate([flat + up, flat - up]), points, triangles)
    outer, inner = np.split(thick.at(rolled(points)).points, 2)
    radius = np.hypot(outer[:, 0], 0.5 - outer[:, 2])
    assert chord > 2.4e-3
    assert np.abs(radius - 0.499).max() < 0.05 * chord
    np.testing.assert_allclose(np.linalg.norm(outer - inner, axis=1), 2e-3, rtol=1e-6)


def test_normals_turn_with_the_surface():
    points, triangles = sheet(20)
    bound = Binding.of(cloud(500, 0.01), points, triangles)
    turned = bound.at(rolled(points)).turned(np.tile([0.0, 0.0, 1.0], (500, 1)), np.arange(500))
    angle = 2.0 * bound.bind[:, 0]
    expected = np.stack([-np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1)
    assert np.degrees(np.arccos(np.einsum("nx,nx->n", turned, expected).clip(-1, 1))).max() < 1.0
