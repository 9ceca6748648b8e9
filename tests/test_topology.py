"""Meshes, element lists and defects, against definitions spelled out in loops and against geometry."""

import numpy as np
import pytest
from meshes import cube, grid, mesh_of, prism, tetrahedron

from physgraph_usd.solver.mesh.defects import defects, in_brief
from physgraph_usd.solver.mesh.subdivide import subdivide
from physgraph_usd.solver.mesh.topology import PolygonMesh


def triangle_normals(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    a, b, c = points[triangles].swapaxes(0, 1)
    return np.cross(b - a, c - a)


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


def kinds(mesh: PolygonMesh, points: np.ndarray | None = None) -> list[tuple[str, int]]:
    return [(defect.kind, defect.index) for defect in defects(mesh, points)]


@pytest.mark.parametrize("case", [cube(), tetrahedron(), prism(6), grid(4, 3, "mixed")])
def test_clean_meshes_have_none_and_stay_clean(case: tuple[PolygonMesh, np.ndarray]):
    mesh, points = case
    assert defects(mesh, points) == []
    refinement = subdivide(mesh)
    assert defects(refinement.mesh, refinement.linear @ points) == []


def test_each_kind():
    assert kinds(mesh_of([[0, 1, 2, 1], [3, 4]], 5))[:2] == [("degenerate-face", 0), ("degenerate-face", 1)]
    assert kinds(mesh_of([[0, 1, 2], [1, 2, 0]])) == [
        ("duplicate-face", 1),
        *(("inconsistent-winding", edge) for edge in range(3)),
    ]
    assert kinds(mesh_of([[0, 1, 2], [1, 0, 3], [0, 1, 4]])) == [("non-manifold-edge", 0)]
    assert kinds(mesh_of([[0, 1, 2], [0, 1, 3]])) == [("inconsistent-winding", 0)]
    assert kinds(mesh_of([[0, 1, 2], [0, 3, 4]])) == [("bow-tie-vertex", 0)]
    assert kinds(mesh_of([[0, 1, 2]], 4)) == [("isolated-point", 3)]


def test_defects_of_a_kind_are_one_line():
    mesh = mesh_of([[0, 1, 2], [0, 1, 3], [3, 4, 5], [3, 4, 6]], 8)
    assert in_brief(defects(mesh)) == [
        "both faces run through edge 0-1 the same way, and 1 more",
        "vertex 3 joins several fans of faces in a point",
        "no face uses vertex 7",
    ]
