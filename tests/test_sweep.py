"""Passages of points through moving meshes, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import ball, flipped, tube

from physgraph_usd.solver.colliders.sweep import Sweep

rng = np.random.default_rng(7)


def through(soup: tuple, start: np.ndarray, end: np.ndarray, *, after: np.ndarray | None = None) -> np.ndarray:
    points, triangles = soup
    return Sweep(triangles).passages(points, points if after is None else after, start=start, end=end)[0]


def turn(angle: float) -> np.ndarray:
    """About x."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


class TestStraight:
    def test_a_ball_is_entered_and_left(self):
        """Segments along x: two passages where they are nearer to the axis than the radius, one if they end inside."""
        y = rng.uniform(-0.35, 0.35, (400, 2))
        away = np.linalg.norm(y, axis=1)
        clear = np.abs(away - 0.2) > 2e-3
        start = np.column_stack([np.full(400, -1.0), y])
        whole, half = np.column_stack([np.full(400, 1.0), y]), np.column_stack([np.zeros(400), y])
        soup = ball(level=4)
        np.testing.assert_array_equal(through(soup, start, whole)[clear], np.where(away < 0.2, 2, 0)[clear])
        np.testing.assert_array_equal(through(soup, start, half)[clear], np.where(away < 0.2, 1, 0)[clear])

    def test_only_relative_motion_counts(self):
        soup, start = ball(level=3), rng.uniform(-0.4, 0.4, (300, 3))
        move = np.array([5.0, -2.0, 1.0])
        end = rng.uniform(-0.4, 0.4, (300, 3))
        still = through(soup, start, end)
        moving = through(soup, start, end + move, after=soup[0] + move)
        assert still.sum() > 100
        assert (still != moving).mean() < 0.01  # rounding at an edge
        assert (through(soup, start, start + move, after=soup[0] + move) == 0).all()

    def test_the_body_may_be_the_one_that_moves(self):
        """A ball that passes five radii in one go over points at rest."""
        soup = ball(level=4)
        points = np.array([[0.5, 0.0, 0.03], [0.5, 0.25, 0.0], [1.0, 0.01, 0.02]])
        assert through(soup, points, points, after=soup[0] + np.array([1.0, 0.0, 0.0])).tolist() == [2, 0, 1]

    def test_winding_does_not_matter(self):
        start, end = rng.uniform(-0.4, 0.4, (2, 300, 3))
        np.testing.assert_array_equal(through(ball(), start, end), through(flipped(ball(), 0.5), start, end))

    def test_past_the_rim_of_an_open_tube_is_no_passage(self):
        soup = tube(0.1, 0.4, around=64)
        start = np.array([[0.2, 0.01, 0.0], [0.2, 0.01, 0.21], [0.02, 0.01, 0.5]])
        end = np.array([[0.0, 0.01, 0.0], [0.0, 0.01, 0.21], [0.02, 0.01, 0.0]])
        assert through(soup, start, end).tolist() == [1, 0, 0]

    def test_a_way_through_an_edge_is_one_passage(self):
        """The tube has a ring of edges at z = 0, and a vertex there at y = 0."""
        y = np.linspace(-0.05, 0.05, 21)
        start, end = (np.column_stack([np.full(21, x), y, np.zeros(21)]) for x in (0.2, 0.0))
        np.testing.assert_array_equal(through(tube(0.1, 0.4, around=64), start, end), 1)

    def test_far_from_the_origin_nothing_is_lost(self):
        start, end = rng.uniform(-0.4, 0.4, (2, 200, 3))
        points, triangles = ball()
        far = through((points + 1e5, triangles), start + 1e5, end + 1e5)
        assert (far != through((points, triangles), start, end)).mean() < 0.01


class TestTurning:
    @pytest.mark.parametrize("angle", [0.4, -0.7, 1.2])
    def test_a_triangle_that_turns_sweeps_the_points_between(self, angle: float):
        """Corners move along chords: the sheet is flat at every time, at the angle atan(s sin / (1 - s + s cos))."""
        points = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        triangles = np.array([[0, 1, 2], [0, 2, 3]])
        x = np.column_stack([rng.uniform(-0.9, 0.9, 400), rng.uniform(0.05, 0.5, 400), rng.uniform(-0.6, 0.6, 400)])
        direction = np.arctan2(x[:, 2], x[:, 1])
        swept = (direction > min(0.0, angle)) & (direction < max(0.0, angle))
        clear = (np.abs(direction) > 1e-3) & (np.abs(direction - angle) > 1e-3) & (np.abs(x[:, 0] - x[:, 1]) > 1e-3)
        found = through((points, triangles), x, x, after=points @ turn(angle).T)
        np.testing.assert_array_equal(found[clear], swept[clear].astype(int))

    def test_nothing_gives_nothing(self):
        none = np.zeros((0, 3))
        assert through(ball(), none, none).shape == (0,)
        found, _ = Sweep(np.zeros((0, 3), int)).passages(none, none, start=np.ones((2, 3)), end=np.zeros((2, 3)))
        assert found.tolist() == [0, 0]

    def test_the_next_pose_is_seen_as_if_it_were_the_first(self):
        """Also one with a corner that is not finite, whose faces nothing passes, and the one after it."""
        points, triangles = ball()
        kept = Sweep(triangles)
        x = rng.uniform(-1.0, 1.0, (2, 200, 3))
        broken = points + 0.4
        broken[triangles[0, 0]] = np.nan
        for after in (points, points @ turn(1.0).T + 0.3, broken, points - 0.2):
            whole = triangles[np.isfinite(after[triangles]).all(axis=(1, 2))]
            found, _ = kept.passages(points, after, start=x[0], end=x[1])
            np.testing.assert_array_equal(found, through((points, whole), x[0], x[1], after=after))
            assert found.any()
