"""Linear subdivision and smooth placement: libigl, trimesh, Blender's OpenSubdiv, and values worked out by hand."""

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from meshes import any_mesh, cube, faces_of, grid, mesh_of, tetrahedron
from scipy.spatial import KDTree

from physgraph_usd.solver.mesh.subdivide import Refinement, compose, smooth, subdivide, subdivide_times
from physgraph_usd.solver.mesh.topology import PolygonMesh, find_edges
from physgraph_usd.usd.mesh.attributes import edge_subset


def dense(mesh: PolygonMesh) -> tuple[Refinement, np.ndarray]:
    refinement = subdivide(mesh)
    return refinement, smooth(mesh, refinement).toarray()


@given(any_mesh(repeats=True), st.integers(0, 2**16))
def test_affine_maps_commute(mesh: PolygonMesh, seed: int):
    rng = np.random.default_rng(seed)
    points, matrix, shift = rng.normal(size=(mesh.vertex_count, 3)), rng.normal(size=(3, 3)), rng.normal(size=3)
    stencil = smooth(mesh, subdivide(mesh))
    np.testing.assert_allclose(stencil.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(stencil @ (points @ matrix + shift), (stencil @ points) @ matrix + shift, atol=1e-11)


@pytest.mark.parametrize("points_and_mesh", [tetrahedron(), grid(5, 4, "triangles")])
def test_loop_matches_libigl_where_it_uses_the_same_weights(points_and_mesh: tuple[PolygonMesh, np.ndarray]):
    """Valence 3 and 6, edges and boundaries; at other valences libigl has Warren's weights, OpenSubdiv Loop's."""
    mesh, points = points_and_mesh
    points = points + np.random.default_rng(1).normal(size=points.shape)
    other, faces = map(np.asarray, igl.loop(points, mesh.indices.reshape(-1, 3).astype(np.int64), 1))
    refinement, stencil = dense(mesh)
    fixed = np.bincount(mesh.indices, minlength=mesh.vertex_count) == 1
    assert len(faces) == refinement.mesh.face_count
    distance, _ = KDTree(other).query((stencil @ points)[~np.pad(fixed, (0, len(stencil) - len(fixed)))])
    assert np.max(distance) < 1e-14


def test_loop_matches_trimesh_at_other_valences():
    shape = trimesh.creation.icosahedron()
    mesh = mesh_of(np.asarray(shape.faces).tolist())
    points = np.asarray(shape.vertices) + np.random.default_rng(2).normal(scale=0.1, size=(12, 3))
    other, faces = trimesh.remesh.subdivide_loop(points, np.asarray(shape.faces), iterations=1)
    refinement, stencil = dense(mesh)
    assert same_surface(refinement.mesh, stencil @ points, other, faces.tolist()) < 1e-14


def test_catmull_clark_cube():
    mesh, points = cube()
    _, stencil = dense(mesh)
    fine = np.abs(stencil @ points)
    np.testing.assert_allclose(fine[:8], 5 / 9)
    np.testing.assert_allclose(np.sort(fine[8:20], axis=1), np.tile([0, 0.75, 0.75], (12, 1)), atol=1e-15)
    np.testing.assert_allclose(np.sort(fine[20:], axis=1), np.tile([0, 0, 1], (6, 1)), atol=1e-15)


def test_where_triangles_meet_quads_the_rule_is_stam_and_loops():
    """Their scheme is linear subdivision, then a mean over the faces by angle; valid at corners of two quads, three
    triangles, here at (3, 2) of a grid whose triangles on the left meet quads on the right."""
    mesh, points = grid(6, 4, "mixed")
    refinement, stencil = dense(mesh)
    vertex = 2 * 7 + 3
    total, weight = np.zeros(len(points)), 0.0
    for face in faces_of(refinement.mesh):
        if vertex not in face:
            continue
        rows = refinement.linear[face].toarray()
        masks = np.array([0.25] * 4 if len(face) == 4 else [0.25 if v == vertex else 0.375 for v in face])
        angle = 1 / 4 if len(face) == 4 else 1 / 6
        total, weight = total + angle * masks @ rows, weight + angle
    assert np.isclose(weight, 1.0)
    np.testing.assert_allclose(stencil[vertex], total, atol=1e-15)
    seam = len(points) + refinement.edges.tolist().index([vertex, vertex + 7])
    wanted = dict.fromkeys([vertex, vertex + 7], 3 / 16 + 1 / 8 + 1 / 16) | {vertex - 1: 1 / 8}
    wanted |= {vertex + 1: 1 / 16, vertex + 8: 1 / 16}
    assert {int(v): stencil[seam, v] for v in np.flatnonzero(stencil[seam])} == wanted


def test_boundaries_are_cubic_splines_and_lone_corners_stay():
    mesh, _ = grid(3, 2)
    _, stencil = dense(mesh)
    assert stencil[1, [0, 1, 2]].tolist() == [1 / 8, 3 / 4, 1 / 8]
    assert stencil[0, 0] == stencil[3, 3] == stencil[8, 8] == 1.0
    assert stencil[12, [0, 1]].tolist() == [0.5, 0.5]


def test_non_manifold_places_stay():
    fin = mesh_of([[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 2, 5], [1, 6, 2]])
    refinement, stencil = dense(fin)
    assert stencil[0, 0] == stencil[1, 1] == 1.0
    assert stencil[7 + refinement.edges.tolist().index([0, 1]), [0, 1]].tolist() == [0.5, 0.5]
    cones = mesh_of([[0, 1, 2], [0, 2, 3], [0, 3, 1], [0, 4, 5], [0, 5, 6], [0, 6, 4]], 8)
    _, stencil = dense(cones)
    assert stencil[0, 0] == stencil[7, 7] == 1.0


def oriented(faces: list[list[int]]) -> list[tuple[int, ...]]:
    """Faces turned to start at their lowest vertex, sorted."""
    return sorted(tuple(face[face.index(min(face)) :] + face[: face.index(min(face))]) for face in faces)


def same_surface(fine: PolygonMesh, points: np.ndarray, other: np.ndarray, other_faces: list[list[int]]) -> float:
    """Largest distance between matching points, after checking that points and faces match one to one."""
    distance, match = map(np.asarray, KDTree(other).query(points))
    assert sorted(match.tolist()) == list(range(len(other)))
    assert oriented([match[face].tolist() for face in faces_of(fine)]) == oriented(other_faces)
    return float(distance.max())


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


@pytest.mark.parametrize("case", [tetrahedron(), grid(5, 3, "triangles")])
def test_triangles_match_libigl(case: tuple[PolygonMesh, np.ndarray]):
    mesh, points = case
    other, faces = map(np.asarray, igl.upsample(points, mesh.indices.reshape(-1, 3).astype(np.int64), 2))
    refinements = subdivide_times(mesh, 2)
    assert same_surface(refinements[-1].mesh, compose(refinements) @ points, other, faces.tolist()) < 1e-15
