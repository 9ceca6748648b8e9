"""What of a shape is seen: normals, angles between them, and the amount of folds."""

import numpy as np
import pytest
from bodies import tube

from physgraph_usd.solver.seen import folding, normal_angles, vertex_normals

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [0.0, 2.0, 0.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
TUBE = tube(0.1, 1.0, around=64, rows=2)
"""An open tube of unit height, two triangles a side."""


def book(angle: float, length: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Two triangles that meet at an edge, turned from flat by an angle [rad]."""
    points = [[0, 0, 0], [length, 0, 0], [0, 1, 0], [0, -np.cos(angle), np.sin(angle)]]
    return np.array(points), np.array([[0, 1, 2], [1, 0, 3]])


def test_normals_are_unit_and_zero_where_there_are_no_triangles():
    normals = vertex_normals(np.vstack([SQUARE, [[5.0, 5.0, 5.0]]]), HALVES)
    assert normals[:4] == pytest.approx(np.tile([0.0, 0.0, 1.0], (4, 1)))
    assert not normals[4].any()


def test_normals_of_a_tube_point_outwards():
    points, triangles = TUBE
    assert vertex_normals(points, triangles)[:, :2] == pytest.approx(points[:, :2] / 0.1, abs=0.05)


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 5.0, 90.0, 179.0])
def test_turned_cloth_is_apart_by_the_angle_of_the_turn(degrees: float):
    angle = np.radians(degrees)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    assert normal_angles(SQUARE, SQUARE @ turn.T, HALVES) == pytest.approx(np.full(4, degrees), rel=1e-6, abs=1e-12)


def test_moved_and_scaled_cloth_is_not_apart():
    points, triangles = TUBE
    assert normal_angles(points, 3.0 * points + 7.0, triangles) == pytest.approx(0.0, abs=1e-6)


def test_vertices_without_triangles_are_not_apart():
    a, b = np.vstack([SQUARE, [[0.0, 0.0, 9.0]]]), np.vstack([SQUARE, [[9.0, 0.0, 0.0]]])
    assert not normal_angles(a, b, HALVES).any()


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 2])
def test_folding_is_the_angle_times_the_length_of_the_fold(angle: float):
    assert folding(*book(angle)) == pytest.approx(2.0 * angle)


def test_a_flat_sheet_has_no_folding_and_a_tube_a_full_turn_along_its_height():
    assert folding(SQUARE, HALVES) == 0.0
    assert folding(*TUBE) == pytest.approx(2.0 * np.pi, rel=1e-3)


def test_folding_sees_single_precision_positions_as_well():
    points, triangles = TUBE
    assert folding(points.astype(np.float32), triangles) == pytest.approx(folding(points, triangles), rel=1e-3)
