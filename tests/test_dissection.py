"""The dissected factor: its solve against a direct one, on meshes of every kind of connectedness."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spl
import torch
from meshes import grid

from physgraph_usd.errors import SolveError
from physgraph_usd.solver.integrate.factors import DeviceFactors, HostFactors
from physgraph_usd.solver.integrate.multifrontal import DissectedSolver, Elimination
from physgraph_usd.solver.mesh.topology import edges_of


def laplacian(columns: int, rows: int, rng: np.random.Generator) -> sp.csr_matrix:
    """Springs of random stiffness along a grid's edges, held a little everywhere."""
    mesh, points = grid(columns, rows, "triangles")
    edges = edges_of(mesh.triangulate(points).triangles, len(points)).vertices
    k = 10.0 ** rng.uniform(-1, 1, len(edges))
    i, j = edges.T
    count = len(points)
    off = sp.coo_matrix((k, (i, j)), shape=(count, count))
    off = off + off.T
    return sp.csr_matrix(sp.diags(np.asarray(off.sum(axis=1)).ravel() + 1e-3) - off)


def several(rng: np.random.Generator) -> sp.csr_matrix:
    """Pieces of different sizes, and vertices that touch nothing."""
    parts = [laplacian(*size, rng) for size in ((3, 3), (30, 4), (12, 13))] + [sp.identity(700, format="csr")]
    return sp.csr_matrix(sp.block_diag(parts))


@pytest.mark.parametrize("leaf", [4, 30])
@pytest.mark.parametrize("which", ["one sheet", "several pieces", "one vertex"])
def test_the_solve_is_the_direct_one(which: str, leaf: int):
    rng = np.random.default_rng(3)
    matrix = {"one sheet": lambda: laplacian(31, 23, rng), "several pieces": lambda: several(rng)}.get(
        which, lambda: sp.csr_matrix([[2.0]])
    )()
    elimination = Elimination(matrix, device="cpu", leaf=leaf)
    solver = DissectedSolver(elimination, torch.as_tensor(matrix.data), dtype=torch.float64)
    for _ in range(2):
        force = rng.normal(size=(matrix.shape[0], 3))
        expected = spl.spsolve(sp.csc_matrix(matrix), force).reshape(force.shape)
        found = solver(torch.as_tensor(force)).numpy()
        assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


def test_one_elimination_serves_all_matrices_of_its_pattern():
    """What CUDA factorises is what the host does: another diagonal, another scale; equal ones to the last bit."""
    rng = np.random.default_rng(4)
    matrix = several(rng)
    count = matrix.shape[0]
    host, device = HostFactors(matrix, torch.float64), DeviceFactors(matrix, torch.float64, "cpu")
    force = torch.as_tensor(rng.normal(size=(count, 3)))
    for scale, stiffness in ((1.0, 0.0), (0.03, 5.0)):
        values = torch.as_tensor(scale * host.taken(matrix + stiffness * sp.diags(rng.random(count))))
        both = [each.of(values)(force) for each in (host, device, device)]
        assert float((both[0] - both[1]).abs().max()) < 1e-9 * float(both[0].abs().max())
        assert torch.equal(both[1], both[2])


def test_a_matrix_that_is_not_positive_definite_is_refused():
    matrix = laplacian(12, 12, np.random.default_rng(5))
    values = torch.as_tensor(matrix.data)
    with pytest.raises(SolveError, match="not positive definite"):
        DissectedSolver(Elimination(matrix, device="cpu", leaf=9), -values, dtype=torch.float64)
