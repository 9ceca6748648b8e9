"""Each defect is found by name and place, and clean meshes have none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from meshes import any_mesh, cube, grid, mesh_of, planar_mesh, prism, tetrahedron

from physgraph_usd.solver.mesh.defects import defects, in_brief
from physgraph_usd.solver.mesh.subdivide import subdivide
from physgraph_usd.solver.mesh.topology import PolygonMesh


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


def test_messages_name_vertices():
    (fin,) = defects(mesh_of([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert fin.message == "edge 0-1 has 3 faces"


def test_indices_out_of_range_do_not_hide_the_rest():
    mesh = mesh_of([[0, 1, 7], [0, 1, 2], [3, 0, -1], [2, 1, 1]], 4)
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], float)
    assert kinds(mesh, points) == [
        *(("index-out-of-range", 0), ("index-out-of-range", 2)),
        *(("degenerate-face", 3), ("isolated-point", 3)),
    ]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_zero_area_is_relative(scale: float):
    mesh = mesh_of([[0, 1, 2], [0, 1, 3], [4, 5, 6]])
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1e-3, 0], [9, 9, 9], [9, 9, 9], [9, 9, 9]])
    flat = [index for kind, index in kinds(mesh, scale * points) if kind == "zero-area-face"]
    assert flat == [0, 2]


@given(planar_mesh())
def test_planar_meshes_have_no_face_or_winding_defects(case: tuple[PolygonMesh, np.ndarray]):
    mesh, points = case
    assert {kind for kind, _ in kinds(mesh, points)} <= {"bow-tie-vertex", "isolated-point"}


@given(any_mesh(repeats=True))
def test_any_mesh_can_be_asked(mesh: PolygonMesh):
    points = np.random.default_rng(0).normal(size=(mesh.vertex_count, 3))
    used = set(mesh.indices.tolist())
    found = defects(mesh, points)
    assert {defect.index for defect in found if defect.kind == "isolated-point"} == set(range(len(points))) - used


def test_defects_of_a_kind_are_one_line():
    mesh = mesh_of([[0, 1, 2], [0, 1, 3], [3, 4, 5], [3, 4, 6]], 8)
    assert in_brief(defects(mesh)) == [
        "both faces run through edge 0-1 the same way, and 1 more",
        "vertex 3 joins several fans of faces in a point",
        "no face uses vertex 7",
    ]
