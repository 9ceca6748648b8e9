"""Meshes and element lists, against definitions spelled out in loops and against geometry."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from meshes import any_mesh, cube, faces_of, grid, mesh_of, planar_mesh, tetrahedron

from physgraph_usd.solver.mesh.elements import hinges_of
from physgraph_usd.solver.mesh.stencil import incidence
from physgraph_usd.solver.mesh.subdivide import subdivide
from physgraph_usd.solver.mesh.topology import PolygonMesh, edges_of, find_edges


def triangle_normals(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    a, b, c = points[triangles].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def test_corners_know_their_face_and_neighbours():
    mesh = mesh_of([[0, 1, 2], [], [2, 1, 3, 4]])
    assert mesh.starts.tolist() == [0, 3, 3, 7]
    assert mesh.corner_face.tolist() == [0, 0, 0, 2, 2, 2, 2]
    assert mesh.next_corner.tolist() == [1, 2, 0, 4, 5, 6, 3]
    assert mesh.previous_corner.tolist() == [2, 0, 1, 6, 3, 4, 5]
    assert not mesh.is_triangles
    assert tetrahedron()[0].is_triangles


def test_counts_must_sum_to_indices():
    with pytest.raises(ValueError, match="sum to 4 but there are 3"):
        PolygonMesh(np.array([4]), np.array([0, 1, 2]), 3)
    with pytest.raises(ValueError, match="face vertex counts"):
        PolygonMesh(np.array([4, -1]), np.array([0, 1, 2]), 3)


def test_range_check_names_face_and_vertex():
    with pytest.raises(ValueError, match="face 1 uses vertex 9, but the mesh has 4"):
        mesh_of([[0, 1, 2], [0, 2, 9]], 4).check_range()


@given(any_mesh(repeats=True))
def test_half_edges_match_a_loop(mesh: PolygonMesh):
    wanted = [tuple(sorted((face[i], face[(i + 1) % len(face)]))) for face in faces_of(mesh) for i in range(len(face))]
    half = mesh.half_edges
    assert [tuple(edge) for edge in half.edges.tolist()] == sorted(set(wanted))
    assert [tuple(half.edges[edge].tolist()) for edge in half.edge] == wanted
    assert half.count.tolist() == [wanted.count(edge) for edge in sorted(set(wanted))]


@given(any_mesh())
def test_edges_match_a_loop(mesh: PolygonMesh):
    triangles = mesh.triangulate().triangles
    sides: dict[tuple[int, int], int] = {}
    for a, b, c in triangles.tolist():
        for pair in ((a, b), (b, c), (c, a)):
            sides[min(pair), max(pair)] = sides.get((min(pair), max(pair)), 0) + 1
    edges = edges_of(triangles, mesh.vertex_count)
    assert [tuple(edge) for edge in edges.vertices.tolist()] == sorted(sides)
    assert edges.face_count.tolist() == [sides[edge] for edge in sorted(sides)]
    assert edges.vertices.dtype == np.int32


def test_triangles_that_repeat_a_vertex_have_edges_but_do_not_count():
    edges = edges_of(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 1], [4, 5, 5]]), 6)
    counts = {tuple(edge): int(n) for edge, n in zip(edges.vertices.tolist(), edges.face_count, strict=True)}
    assert counts[0, 1] == 2
    assert counts[4, 5] == 0
    assert len(hinges_of(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 1]]))) == 1


@given(any_mesh())
def test_find_edges_inverts_the_list(mesh: PolygonMesh):
    edges = mesh.half_edges.edges
    assert find_edges(edges, edges[:, ::-1]).tolist() == list(range(len(edges)))
    assert find_edges(edges, np.array([[0, 99], [-1, 2], [3, 3]])).tolist() == [-1, -1, -1]


def test_hinges_of_two_triangles():
    assert hinges_of(np.array([[0, 1, 2], [1, 0, 3]])).tolist() == [[0, 1, 2, 2, 3, 3]]
    assert hinges_of(np.array([[1, 2, 0], [3, 1, 0]])).tolist() == [[1, 0, 3, 3, 2, 2]]
    assert hinges_of(np.array([[0, 1, 2], [0, 1, 3]])).tolist() == [[0, 1, 2, 2, 3, 3]]
    assert hinges_of(np.array([[2, 1, 0], [0, 1, 3]])).tolist() == [[0, 1, 3, 3, 2, 2]]


def test_hinges_of_quads_have_both_opposite_corners():
    """Of a quad the corner next to the edge's second end comes first, and of two quads that are one none is left."""
    assert hinges_of(np.array([[1, 0, 4]]), np.array([[0, 1, 2, 3]])).tolist() == [[1, 0, 4, 4, 2, 3]]
    assert hinges_of(np.empty((0, 3)), np.array([[0, 1, 2, 3], [1, 0, 4, 5]])).tolist() == [[0, 1, 2, 3, 4, 5]]
    assert len(hinges_of(np.empty((0, 3)), np.array([[0, 1, 2, 3], [3, 2, 1, 0]]))) == 0


def test_no_hinge_at_boundaries_fins_and_duplicates():
    assert len(hinges_of(np.array([[0, 1, 2]]))) == 0
    assert len(hinges_of(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))) == 0
    assert len(hinges_of(np.array([[0, 1, 2], [0, 2, 1]]))) == 0
    assert hinges_of(np.empty((0, 3), np.int32)).shape == (0, 6)


@given(st.integers(0, 2**16))
def test_flat_hinges_are_flat_whatever_the_winding(seed: int):
    mesh, points = grid(4, 3, "triangles")
    triangles = mesh.triangulate().triangles.copy()
    flips = np.random.default_rng(seed).random(len(triangles)) < 0.5
    triangles[flips] = triangles[flips, ::-1]
    i, j, k, other = (points[column] for column in hinges_of(triangles).T[[0, 1, 2, 4]])
    one, two = np.cross(j - i, k - i), np.cross(other - i, j - i)
    assert len(i) == np.sum(edges_of(triangles, len(points)).face_count == 2)
    assert np.all(np.einsum("hx,hx->h", one, two) > 0.9)


def test_a_closed_surface_has_a_hinge_at_each_edge():
    mesh, points = tetrahedron()
    hinges = hinges_of(mesh.triangulate().triangles)
    assert len(hinges) == 6
    assert sorted(hinges[0].tolist()) == [0, 1, 2, 2, 3, 3]
    i, j, k, other = (points[column] for column in hinges.T[[0, 1, 2, 4]])
    one, two = np.cross(j - i, k - i), np.cross(other - i, j - i)
    cosine = np.einsum("hx,hx->h", one, two) / np.linalg.norm(one, axis=1) / np.linalg.norm(two, axis=1)
    np.testing.assert_allclose(cosine, -1 / 3)


@given(any_mesh())
def test_incidence_matches_a_loop(mesh: PolygonMesh):
    triangles = mesh.triangulate().triangles
    starts, slots = incidence(torch.as_tensor(triangles), mesh.vertex_count)
    for vertex in range(mesh.vertex_count):
        wanted = [3 * t + c for t, triangle in enumerate(triangles.tolist()) for c in range(3) if triangle[c] == vertex]
        assert slots[starts[vertex] : starts[vertex + 1]].tolist() == wanted
    assert starts.dtype == slots.dtype == torch.int32


@given(planar_mesh())
def test_triangles_keep_area_winding_and_face(case: tuple[PolygonMesh, np.ndarray]):
    mesh, points = case
    for split in (mesh.triangulate(), mesh.triangulate(points)):
        assert split.face.tolist() == np.repeat(np.arange(mesh.face_count), np.maximum(mesh.counts - 2, 0)).tolist()
        areas = np.bincount(split.face, triangle_normals(split.triangles, points)[:, 2] / 2, mesh.face_count)
        for face, area in zip(faces_of(mesh), areas, strict=True):
            x, y, _ = points[face].T
            assert np.isclose(area, 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def test_quads_split_along_the_shorter_diagonal_that_lies_inside():
    mesh = mesh_of([[0, 1, 2, 3]])
    wide = np.array([[0, 0, 0], [2, 0, 0], [3, 1, 0], [1, 1, 0]], float)
    assert mesh.triangulate(wide).triangles.tolist() == [[1, 2, 3], [1, 3, 0]]
    assert mesh.triangulate(wide[[1, 2, 3, 0]]).triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    dart = np.array([[0, 0, 0], [1, -3, 0], [0, 9, 0], [-1, -3, 0]], float)
    assert mesh.triangulate(dart).triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.triangulate(dart[[3, 0, 1, 2]]).triangles.tolist() == [[1, 2, 3], [1, 3, 0]]


def test_a_concave_polygon_fans_from_where_it_is_seen_whole():
    arrow = np.array([[2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 0], [0, 0, 0]], float)
    normals = triangle_normals(mesh_of([[0, 1, 2, 3, 4]]).triangulate(arrow).triangles, arrow)
    assert np.all(normals[:, 2] > 0)


def test_diagonals_of_refined_quads_alternate():
    refinement = subdivide(grid(3, 2)[0])
    fine = refinement.mesh
    drawn = {tuple(edge) for edge in fine.half_edges.edges.tolist()}
    edges = edges_of(fine.triangulate().triangles, fine.vertex_count).vertices.tolist()
    diagonals = [edge for edge in edges if tuple(edge) not in drawn]
    assert len(diagonals) == fine.face_count
    centres = fine.vertex_count - 6
    assert all(low < 12 and high >= centres for low, high in diagonals)


def test_fans():
    bow_tie = mesh_of([[0, 1, 2], [0, 3, 4]], 6)
    assert bow_tie.fan_counts.tolist() == [2, 1, 1, 1, 1, 0]
    assert set(cube()[0].fan_counts.tolist()) == {1}
    cones = mesh_of([[0, 1, 2], [0, 2, 3], [0, 3, 1], [0, 4, 5], [0, 5, 6], [0, 6, 4]])
    assert cones.fan_counts.tolist() == [2, 1, 1, 1, 1, 1, 1]
    twisted = mesh_of([[0, 1, 2], [0, 1, 3]])
    assert twisted.fan_counts.tolist() == [1, 1, 1, 1]
    assert mesh_of([], 2).fan_counts.tolist() == [0, 0]
