"""Rays against triangles meet what the formula of Moeller and Trumbore (1997) says that they meet."""

from __future__ import annotations

import numpy as np
import pytest

from physgraph_usd.shot.page.rays import Rays


@pytest.fixture(scope="module")
def soup() -> tuple[np.ndarray, np.ndarray]:
    """60 triangles that lie anywhere in a unit cube."""
    rng = np.random.default_rng(4)
    return rng.random((180, 3)), np.arange(180).reshape(-1, 3)


def met(soup: tuple[np.ndarray, np.ndarray], origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, ...]:
    """For every triangle: how far along the ray it is, inf where it is missed, and the weights of its corners."""
    points, triangles = soup
    a, b, c = points[triangles].transpose(1, 0, 2)
    across = np.cross(direction, c - a)
    area = np.einsum("tk,tk->t", b - a, across)
    to = origin - a
    second = np.einsum("tk,tk->t", to, across) / area
    around = np.cross(to, b - a)
    third = around @ direction / area
    along = np.einsum("tk,tk->t", c - a, around) / area
    missed = (second < 0) | (third < 0) | (second + third > 1) | (along < 0)
    return np.where(missed, np.inf, along), np.stack([1 - second - third, second, third], axis=1)


def test_each_ray_meets_the_nearest_triangle_at_the_right_place(soup: tuple[np.ndarray, np.ndarray]):
    rng = np.random.default_rng(5)
    origins, directions = rng.random((2000, 3)), rng.normal(size=(2000, 3))
    rays = Rays(*soup)
    hits, free = rays.first(origins, directions), rays.free(origins, directions)
    wanted = [met(soup, *ray) for ray in zip(origins, directions, strict=True)]
    nearest = np.array([along.min() for along, _ in wanted])
    assert 0.1 < np.isfinite(nearest).mean() < 0.9
    np.testing.assert_array_equal(free, np.isinf(nearest))
    np.testing.assert_array_equal(hits.face, [a.argmin() if np.isfinite(a.min()) else -1 for a, _ in wanted])
    there = ~free
    np.testing.assert_allclose(hits.distance[there], nearest[there], rtol=1e-4, atol=1e-5)
    weights = np.array([each[along.argmin()] for along, each in wanted])
    np.testing.assert_allclose(hits.weights[there], weights[there], atol=1e-3)


def test_no_ray_is_no_hit(soup: tuple[np.ndarray, np.ndarray]):
    none = np.zeros((0, 3))
    assert len(Rays(*soup).free(none, none)) == len(Rays(*soup).first(none, none).face) == 0
