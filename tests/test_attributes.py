"""What rides on a refined mesh: values on vertices, faces and corners, and subsets."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import any_mesh, cube, faces_of, grid, mesh_of

from physgraph_usd.solver.mesh.attributes import (
    corner_values,
    edge_subset,
    face_subset,
    parent_faces,
    uniform_values,
    vertex_subset,
    vertex_values,
)
from physgraph_usd.solver.mesh.subdivide import compose, subdivide_times
from physgraph_usd.solver.mesh.topology import PolygonMesh, find_edges


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_linear_fields_are_reproduced_in_their_own_type(dtype: type):
    mesh, points = grid(4, 4, "mixed")
    refinements = subdivide_times(mesh, 2)
    fine = compose(refinements) @ points
    values = vertex_values(refinements, (points @ np.array([[1, 0.5], [2, -1], [0, 0]])).astype(dtype))
    assert values.dtype == dtype
    np.testing.assert_array_equal(values, (fine @ np.array([[1, 0.5], [2, -1], [0, 0]])).astype(dtype))


def test_values_of_any_shape():
    mesh, points = cube()
    refinements = subdivide_times(mesh, 1)
    assert vertex_values(refinements, points[:, 0]).shape == (26,)
    assert vertex_values(refinements, np.ones((8, 2, 3))).shape == (26, 2, 3)
    assert vertex_values(refinements, np.ones((8, 0))).shape == (26, 0)
    assert vertex_values(subdivide_times(mesh_of([], 0), 1), np.zeros((0, 2), int)).shape == (0, 2)
    assert vertex_values((), points) is points


def test_whole_numbers_and_words_come_from_the_nearest_parent():
    refinements = subdivide_times(mesh_of([[3, 1, 2, 0, 4]]), 2)
    numbers = vertex_values(refinements, np.array([10, 11, 12, 13, 14], np.int32))
    assert numbers.dtype == np.int32
    words = vertex_values(refinements, np.array(list("abcde")))
    assert [chr(ord("a") + number - 10) for number in numbers] == words.tolist()
    weights = compose(refinements).toarray()
    for row, number in zip(weights, numbers, strict=True):
        assert number - 10 == np.flatnonzero(row >= row.max() - 1e-12)[0]
    assert vertex_values(refinements, np.array([True] * 5)).all()


@given(any_mesh(repeats=True), st.integers(1, 3))
def test_uniform_values_and_face_subsets_follow_the_parent(mesh: PolygonMesh, levels: int):
    refinements = subdivide_times(mesh, levels)
    parents = parent_faces(refinements)
    for face in range(mesh.face_count):
        triangle, corners = mesh.counts[face] == 3, mesh.counts[face] if mesh.counts[face] >= 3 else 0
        assert np.sum(parents == face) == (4 if triangle else corners) * 4 ** (levels - 1)
    names = np.array([[face, -face] for face in range(mesh.face_count)]).reshape(-1, 2)
    assert np.array_equal(uniform_values(refinements, names), names[parents])
    even, odd = np.arange(0, mesh.face_count, 2), np.arange(1, mesh.face_count, 2)
    parts = [face_subset(refinements, even), face_subset(refinements, odd)]
    assert sorted(np.concatenate(parts).tolist()) == list(range(len(parents)))
    assert np.all(parents[parts[0]] % 2 == 0)


@given(any_mesh(repeats=True), st.integers(0, 2**16))
def test_corner_values_on_their_own_topology(mesh: PolygonMesh, seed: int):
    """Where corners share values as they share points, refined corners name what the point itself would get."""
    refinements = subdivide_times(mesh, 2)
    order = np.random.default_rng(seed).permutation(mesh.vertex_count)
    values = np.random.default_rng(seed).normal(size=(mesh.vertex_count, 2))
    indices, fine = corner_values(refinements, mesh.counts, order[mesh.indices], values)
    at_points = vertex_values(refinements, values[order])
    np.testing.assert_allclose(fine[indices], at_points[refinements[-1].mesh.indices], atol=1e-12)


def test_seams_stay_seams():
    mesh, _ = grid(2, 1)
    coordinates = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [5, 0], [6, 0], [6, 1], [5, 1]], np.float32)
    refinements = subdivide_times(mesh, 2)
    indices, fine = corner_values(refinements, mesh.counts, np.arange(8), coordinates)
    assert fine.dtype == np.float32
    assert len(fine) == 2 * 25
    faces = parent_faces(refinements)
    own = fine[indices].reshape(-1, 4, 2)
    assert own[faces == 0, :, 0].max() == 1
    assert own[faces == 1, :, 0].min() == 5
    x, y = own[..., 0], own[..., 1]
    area = 0.5 * np.sum(x * np.roll(y, -1, 1) - np.roll(x, -1, 1) * y, axis=1)
    np.testing.assert_allclose(area, 1 / 16)


def test_mistakes_are_named():
    mesh, points = cube()
    refinements = subdivide_times(mesh, 1)
    with pytest.raises(ValueError, match="7 values for 8 vertices"):
        vertex_values(refinements, points[:7])
    with pytest.raises(ValueError, match="3 values for 6 or more faces"):
        uniform_values(refinements, np.arange(3))
    with pytest.raises(ValueError, match="uses vertex 8"):
        corner_values(refinements, mesh.counts, mesh.indices + 1, points)
    with pytest.raises(ValueError, match="corner values for 5 faces do not fit"):
        corner_values(refinements, mesh.counts[:5], mesh.indices[:20], points)
    with pytest.raises(ValueError, match="names vertex 8, but the mesh has 8"):
        vertex_subset(refinements, np.array([8]))


def test_no_levels_change_nothing():
    mesh, points = cube()
    assert uniform_values((), np.arange(6)).tolist() == list(range(6))
    assert corner_values((), mesh.counts, mesh.indices, points)[1] is points
    assert face_subset((), np.array([2])).tolist() == vertex_subset((), np.array([2])).tolist() == [2]
    assert edge_subset((), np.array([[3, 1]])).tolist() == [[3, 1]]


@given(any_mesh(), st.integers(0, 2**16))
def test_vertex_subsets_have_all_parents_inside(mesh: PolygonMesh, seed: int):
    refinements = subdivide_times(mesh, 2)
    inside = np.random.default_rng(seed).random(mesh.vertex_count) < 0.6
    weights = compose(refinements).toarray()
    wanted = [vertex for vertex, row in enumerate(weights) if inside[np.flatnonzero(row)].all()]
    assert vertex_subset(refinements, np.flatnonzero(inside)).tolist() == wanted


def test_edge_subsets_are_chains_along_the_parent():
    mesh, points = grid(3, 2)
    refinements = subdivide_times(mesh, 2)
    fine = edge_subset(refinements, np.array([[2, 1], [5, 9], [0, 11]]))
    assert fine.shape == (8, 2)
    place = compose(refinements) @ points
    np.testing.assert_allclose(place[fine[:4, 0], 0], [2, 1.75, 1.5, 1.25])
    assert fine[1:4, 0].tolist() == fine[:3, 1].tolist()
    assert np.all(find_edges(refinements[-1].mesh.half_edges.edges, fine) >= 0)
    assert sorted(set(map(len, faces_of(refinements[-1].mesh)))) == [4]
