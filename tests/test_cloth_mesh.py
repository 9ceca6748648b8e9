"""What lies beside what in cloth, also across its seams."""

from __future__ import annotations

import numpy as np
import torch
from brute import Soup, beside
from folds import fine, levels_of, named, square

from physgraph_usd.solver.contact.cloth_mesh import ClothMesh
from physgraph_usd.solver.level import Level

ALL = np.ones((2, 2), bool)
NONE = np.zeros((0, 2), np.int64)


def mesh_of(level: Level, sewn: np.ndarray = NONE) -> ClothMesh:
    return ClothMesh(level, ALL, sewn)


def two_sheets() -> tuple[Level, np.ndarray]:
    """Two sheets side by side, and which vertices of theirs are at one place."""
    cloth = square(3)
    levels = levels_of(named(cloth, "A"), named(cloth, "B"))
    x = fine(levels, cloth[1], cloth[1] + [np.ptp(cloth[1][:, 0]), 0.0, 0.0])
    return levels[-1], np.argwhere(np.triu((torch.cdist(x, x) < 1e-6).numpy(), 1))


def one_of(level: Level, vertex: int) -> torch.Tensor:
    out = torch.zeros(level.vertex_count, dtype=torch.bool)
    out[vertex] = True
    return out


def test_the_vertices_opposite_an_edge_are_those_of_its_faces():
    level = levels_of(named(square(2)))[-1]
    mesh = mesh_of(level)
    faces = level.triangles.numpy()
    for edge, opposite in zip(level.edges.numpy(), mesh.opposite.numpy(), strict=True):
        own = faces[np.isin(faces, edge).sum(axis=1) == 2]
        thirds = sorted(own[~np.isin(own, edge)].tolist())
        assert sorted(opposite[opposite >= 0].tolist()) == thirds
        assert opposite[0] >= 0


def test_rings_grow_by_edges():
    level = levels_of(named(square(4)))[-1]
    mesh = mesh_of(level)
    near: np.ndarray = beside(Soup.of(level, level.rest)).astype(int)
    start = one_of(level, 7)
    for rings in range(4):
        expected = np.linalg.matrix_power(near, rings)[7] > 0
        np.testing.assert_array_equal(mesh.grown(start, rings).numpy(), expected)
    assert not mesh.grown(torch.zeros_like(start), 3).any()


def test_rings_grow_across_seams():
    level, sewn = two_sheets()
    assert len(sewn) == 7
    one = one_of(level, int(sewn[3, 0]))
    half = level.vertex_count // 2
    assert not mesh_of(level).grown(one, 5)[half:].any()
    mesh = mesh_of(level, sewn)
    assert bool(mesh.grown(one, 1)[sewn[3, 1]])
    assert int(mesh.grown(one, 2)[half:].sum()) > 3


def test_the_mean_beside_a_vertex_is_that_of_its_neighbours():
    level, sewn = two_sheets()
    mesh, values = mesh_of(level, sewn), torch.randn((level.vertex_count, 3), dtype=torch.float64)
    beside = mesh.beside.toarray()
    expected = beside @ values.numpy() / beside.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.mean_beside(values).numpy(), expected, rtol=1e-12)
