"""Smooth vertex normals."""

from __future__ import annotations

import numpy as np
import pytest
from layers import grid

from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.usd.write.normals import VertexNormals


def sphere() -> tuple[np.ndarray, PolygonMesh]:
    """A fine closed sphere of quads and triangles, wound counter-clockwise from outside."""
    rings, steps = 40, 80
    theta = np.linspace(0.0, np.pi, rings + 1)[1:-1, None]
    phi = np.linspace(0.0, 2 * np.pi, steps, endpoint=False)
    ring = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], -1)
    points = np.concatenate([ring.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    ids = np.arange((rings - 1) * steps).reshape(rings - 1, steps)
    right = np.roll(ids, -1, axis=1)
    quads = np.stack([ids[:-1], ids[1:], right[1:], right[:-1]], -1).reshape(-1, 4)
    north, south = ids.size, ids.size + 1
    caps = [(north, a, b) for a, b in zip(ids[0], right[0], strict=True)]
    caps += [(south, b, a) for a, b in zip(ids[-1], right[-1], strict=True)]
    counts = np.array([4] * len(quads) + [3] * len(caps), np.int32)
    indices = np.concatenate([quads.reshape(-1), np.reshape(caps, -1)]).astype(np.int32)
    return points, PolygonMesh(counts, indices, len(points))


def test_a_sphere_has_its_own_points_as_normals() -> None:
    points, mesh = sphere()
    assert np.einsum("ij,ij->i", VertexNormals(mesh)(points), points).min() > 0.9995
    assert np.einsum("ij,ij->i", VertexNormals(mesh, left_handed=True)(points), points).max() < -0.9995


@pytest.mark.parametrize("quads", [True, False])
def test_they_follow_area(quads: bool) -> None:
    points, counts, indices = grid(3, 2, quads=quads)
    points = points + np.random.default_rng(1).normal(size=points.shape) * 0.1
    expected = np.zeros_like(points)
    start = 0
    for count in counts:
        face = indices[start : start + count]
        start += count
        area = sum(np.cross(points[face[i]], points[face[(i + 1) % count]]) for i in range(count))
        expected[face] += area
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    normals = VertexNormals(PolygonMesh(counts, indices, len(points)))(points)
    assert normals.dtype == np.float32
    np.testing.assert_allclose(normals, expected, atol=1e-6)


def test_a_polygon_of_many_corners() -> None:
    angle = np.linspace(0, 2 * np.pi, 7, endpoint=False)
    points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    mesh = PolygonMesh(np.array([7], np.int32), np.arange(7, dtype=np.int32), 7)
    np.testing.assert_allclose(VertexNormals(mesh)(points), np.tile([0, 0, 1], (7, 1)), atol=1e-6)


def test_no_area_takes_the_neighbours_and_stays_unit() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [9, 9, 9]], float)
    mesh = PolygonMesh(np.array([3, 3], np.int32), np.array([0, 1, 2, 0, 1, 3], np.int32), 5)
    normals = VertexNormals(mesh)(points)
    np.testing.assert_allclose(normals[:4], np.tile([0, 0, 1], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)


def test_scale_does_not_matter() -> None:
    points, counts, indices = grid()
    normals = VertexNormals(PolygonMesh(counts, indices, len(points)))
    np.testing.assert_allclose(normals(points * 1e-6), normals(points), atol=1e-6)
    np.testing.assert_allclose(normals(points * 1e6), normals(points), atol=1e-6)
