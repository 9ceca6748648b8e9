"""Linear subdivision: properties of random meshes, and libigl on triangles."""

from __future__ import annotations

import igl
import numpy as np
import pytest
from hypothesis import given
from meshes import any_mesh, faces_of, grid, mesh_of, planar_mesh, prism, tetrahedron
from scipy.spatial import KDTree

from physgraph_usd.solver.mesh.attributes import edge_subset
from physgraph_usd.solver.mesh.subdivide import compose, subdivide, subdivide_times
from physgraph_usd.solver.mesh.topology import PolygonMesh, find_edges


def signed_areas(mesh: PolygonMesh, points: np.ndarray) -> np.ndarray:
    x, y = points[mesh.indices, 0], points[mesh.indices, 1]
    following = mesh.next_corner
    return np.bincount(mesh.corner_face, (x * y[following] - x[following] * y) / 2, mesh.face_count)


def oriented(faces: list[list[int]]) -> list[tuple[int, ...]]:
    """Faces turned to start at their lowest vertex, sorted."""
    return sorted(tuple(face[face.index(min(face)) :] + face[: face.index(min(face))]) for face in faces)


def same_surface(fine: PolygonMesh, points: np.ndarray, other: np.ndarray, other_faces: list[list[int]]) -> float:
    """Largest distance between matching points, after checking that points and faces match one to one."""
    distance, match = map(np.asarray, KDTree(other).query(points))
    assert sorted(match.tolist()) == list(range(len(other)))
    assert oriented([match[face].tolist() for face in faces_of(fine)]) == oriented(other_faces)
    return float(distance.max())


def test_children_of_a_triangle_and_a_quad():
    refinement = subdivide(mesh_of([[0, 1, 2], [2, 1, 3, 4]], 6))
    assert refinement.edges.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 4], [3, 4]]
    assert faces_of(refinement.mesh) == [
        *([0, 6, 7], [6, 1, 8], [7, 8, 2], [6, 8, 7]),
        *([2, 8, 12, 10], [1, 9, 12, 8], [3, 11, 12, 9], [4, 10, 12, 11]),
    ]
    assert refinement.parent_face.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert refinement.linear[12].toarray().tolist() == [[0, 0.25, 0.25, 0.25, 0.25, 0]]
    assert refinement.linear[8].toarray().tolist() == [[0, 0.5, 0.5, 0, 0, 0]]


@given(any_mesh(repeats=True))
def test_counts_and_rows(mesh: PolygonMesh):
    for refinement in subdivide_times(mesh, 2):
        polygons = mesh.counts[mesh.counts >= 4]
        fine = refinement.mesh
        assert fine.vertex_count == mesh.vertex_count + len(mesh.half_edges.edges) + len(polygons)
        assert fine.face_count == 4 * np.sum(mesh.counts == 3) + polygons.sum() == len(refinement.parent_face)
        fine.check_range()
        assert refinement.linear.shape == (fine.vertex_count, mesh.vertex_count)
        np.testing.assert_allclose(refinement.linear.sum(axis=1), 1.0, atol=1e-14)
        assert refinement.linear.nnz == 0 or refinement.linear.data.min() > 0
        assert np.array_equal(refinement.linear[: mesh.vertex_count].toarray(), np.eye(mesh.vertex_count))
        assert np.all(np.diff(refinement.parent_face) >= 0)
        mesh = fine


@given(any_mesh(duplicates=False))
def test_children_conform_and_boundaries_stay_boundaries(mesh: PolygonMesh):
    """Half a parent edge has the parent's faces, any other child edge exactly two: no T-junction, no new boundary."""
    refinement = subdivide(mesh)
    fine = refinement.mesh.half_edges
    halves = find_edges(fine.edges, edge_subset([refinement], refinement.edges))
    assert np.all(halves >= 0)
    assert fine.count[halves].tolist() == np.repeat(mesh.half_edges.count, 2).tolist()
    others = np.delete(fine.count, halves)
    assert np.all(others == 2)


@given(any_mesh(duplicates=False))
def test_winding_agreement_is_kept(mesh: PolygonMesh):
    """An edge's half-edges run as the parent's do; inside a face they run in opposite directions."""
    refinement = subdivide(mesh)
    fine, parent = refinement.mesh.half_edges, mesh.half_edges
    forward = np.bincount(fine.edge, fine.forward, len(fine.edges))
    along = np.bincount(parent.edge, parent.forward, len(parent.edges))
    first, second = find_edges(fine.edges, edge_subset([refinement], refinement.edges)).reshape(-1, 2).T
    assert np.array_equal(forward[first], along)
    assert np.array_equal(forward[second], parent.count - along)
    assert np.all(np.delete(forward, np.concatenate([first, second])) == 1)


@given(planar_mesh())
def test_planar_faces_keep_their_area(case: tuple[PolygonMesh, np.ndarray]):
    mesh, points = case
    refinement = subdivide(mesh)
    fine = signed_areas(refinement.mesh, refinement.linear @ points)
    children = np.bincount(refinement.parent_face, fine, mesh.face_count)
    np.testing.assert_allclose(children, signed_areas(mesh, points), rtol=1e-12)


def test_repeated_vertices_short_faces_and_empty_meshes():
    refinement = subdivide(mesh_of([[0, 1, 1, 2], [0, 0, 0], [1, 2], [3]], 5))
    assert refinement.parent_face.tolist() == [0] * 4 + [1] * 4
    np.testing.assert_allclose(refinement.linear.sum(axis=1), 1.0)
    empty = subdivide(mesh_of([], 3))
    assert (empty.mesh.face_count, empty.mesh.vertex_count) == (0, 3)
    assert subdivide(mesh_of([], 0)).linear.shape == (0, 0)


def test_an_index_out_of_range_is_named():
    with pytest.raises(ValueError, match="face 0 uses vertex 7, but the mesh has 3"):
        subdivide(mesh_of([[0, 1, 7]], 3))


def test_levels_compose():
    mesh, points = prism(5)
    refinements = subdivide_times(mesh, 3)
    step_by_step = points
    for refinement in refinements:
        step_by_step = refinement.linear @ step_by_step
    np.testing.assert_allclose(compose(refinements) @ points, step_by_step, atol=1e-14)
    assert refinements[1].mesh.is_triangles is False
    assert subdivide_times(mesh, 0) == ()
    with pytest.raises(ValueError, match="no refinements"):
        compose(())
    with pytest.raises(ValueError, match="levels is -1"):
        subdivide_times(mesh, -1)


@pytest.mark.parametrize("case", [tetrahedron(), grid(5, 3, "triangles")])
def test_triangles_match_libigl(case: tuple[PolygonMesh, np.ndarray]):
    mesh, points = case
    other, faces = map(np.asarray, igl.upsample(points, mesh.indices.reshape(-1, 3).astype(np.int64), 2))
    refinements = subdivide_times(mesh, 2)
    assert same_surface(refinements[-1].mesh, compose(refinements) @ points, other, faces.tolist()) < 1e-15
