"""The metric: one scalar symmetric positive definite matrix per level, factorised once."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float
from scipy.sparse.linalg import splu
from torch import Tensor

from ..mesh.stencil import Stencil, add_at, three_columns
from .base import Solver
from .multifrontal import DissectedSolver, Elimination

try:
    import cholespy
except ImportError:  # Linux on ARM has no wheel.
    cholespy = None

FACTOR = "scipy" if cholespy is None else "cholespy"
"""Library used for factors on the CPU."""
REGULARISATION = 1e-7
"""Regularisation of the diagonal, relative to its mean: keeps loose parts without a guide definite."""


def on_edges(matrix: sp.csr_matrix, edges: np.ndarray) -> sp.csr_matrix:
    """A graph Laplacian with a matrix's negative couplings along edges and the same row sums.

    The rest form of bending also couples vertices across two triangles. Including the additional couplings doubles the
    time of a solve and hardly lowers the energy at equal steps.

    Args:
        matrix: Symmetric, positive semi-definite [N/m], shape (V, V).
        edges: End vertices, shape (E, 2).

    Returns:
        Symmetric positive semi-definite [N/m], shape (V, V).
    """
    count = matrix.shape[0]
    ends = np.asarray(edges, dtype=np.int64)
    pattern = sp.csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    couplings = sp.csr_matrix(-(matrix.multiply(pattern + pattern.T)).minimum(0.0))
    excess = np.asarray(matrix.sum(axis=1)).ravel() + np.asarray(couplings.sum(axis=1)).ravel()
    return sp.csr_matrix(sp.diags(excess) - couplings)


class Metric:
    """H0, factorised: the same matrix for x, y and z.

    Attributes:
        diagonal: Diagonal of H0 [N/m], float64; 1 at fixed vertices, shape (V,).
        entries: Number of the matrix's entries.
    """

    def __init__(
        self,
        matrix: sp.csr_matrix,
        *,
        free: Bool[Tensor, "vertices 1"],
        dtype: torch.dtype,
        like: Metric | None = None,
    ) -> None:
        """Factorise a scalar Hessian at rest.

        Args:
            matrix: Symmetric positive semi-definite [N/m], shape (V, V).
            free: False at fixed vertices, whose rows become identity rows.
            dtype: Scalar type of the right-hand sides.
            like: A metric whose order of elimination serves again on CUDA if its matrix has the same pattern; or None.
        """
        self._free, self._matrix = free.squeeze(1), matrix
        self._mask = three_columns(self._free.to(dtype))
        self._merged: MergedMetric | None = None
        keep = sp.diags(self._free.cpu().numpy().astype(np.float64))
        couplings = sp.csr_matrix(keep @ (matrix - sp.diags(matrix.diagonal())) @ keep)
        couplings.eliminate_zeros()
        self.entries, device = couplings.nnz + couplings.shape[0], str(free.device)
        known = None if like is None else like._factors
        self._factors = (
            DeviceFactors(couplings, dtype, device, like=known) if free.is_cuda else HostFactors(couplings, dtype)
        )
        self._hold(torch.as_tensor(matrix.diagonal(), device=free.device))

    def plus(self, springs: Float[Tensor, " vertices"]) -> Metric:
        """The metric of the same cloth held by springs of given stiffness [N/m], factorised anew."""
        other = copy.copy(self)
        other._hold(self._stiffness + springs.double())
        return other

    def scaled(self, stiffer: Float[Tensor, " vertices"]) -> Metric:
        """R H0 R, R a diagonal, solved by the Cholesky factor of H0; its diagonal is that of H0 times given numbers.

        Args:
            stiffer: R^2 at each vertex, positive.
        """
        other, root = copy.copy(self), three_columns(stiffer.to(self._mask).rsqrt())
        other._scaled, other._mask = self._scaled * root, self._mask * root
        other.diagonal = torch.where(self._free, self.diagonal * stiffer.double(), 1.0)
        return other

    def merged(self, label: np.ndarray) -> MergedMetric:
        """The metric of the same cloth with all vertices of equal label merged; cached while the labels stay the same.

        Args:
            label: A number for each vertex, shape (V,).
        """
        if self._merged is None or not np.array_equal(self._merged.label, label):
            self._merged = MergedMetric(self._matrix, label, free=self._free.unsqueeze(1), dtype=self._mask.dtype)
        return self._merged

    def _hold(self, stiffness: Float[Tensor, " vertices"]) -> None:
        """Factorise with a diagonal [N/m]."""
        self._stiffness = stiffness
        moved = stiffness[self._free].cpu().numpy()
        # A unit mean diagonal keeps float32 pivots in range whatever the fabric and the level.
        scale = 1.0 / float(moved.mean()) if (moved > 0).any() else 1.0
        diagonal = torch.where(self._free, scale * stiffness + REGULARISATION, 1.0)
        self._solver = self._factors.factorised(scale, diagonal)
        self._scaled = scale * self._mask
        self.diagonal = torch.where(self._free, diagonal / scale, 1.0)

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m]; zero at fixed vertices."""
        return self._solver(force * self._scaled).mul_(self._mask)

    def between(self, factor: Float[Tensor, "vertices 1"]) -> Solver:
        """The solve of R H0^-1 R F [m], R a diagonal, in as few passes as for H0^-1 F."""
        return Between(self._solver, self._scaled * factor, self._mask * factor)

    def stiffened(self, stiffness: Float[Tensor, " vertices"]) -> Solver:
        """R H0^-1 R, as in `Preconditioner`."""
        diagonal = self.diagonal.to(stiffness)
        return self.between((diagonal / torch.maximum(diagonal, stiffness)).sqrt().unsqueeze(1))


@dataclass(frozen=True, eq=False)
class Between:
    """A solve between two diagonals [m]: after * (solver of before * F).

    Attributes:
        solver: The solve between.
        before, after: The diagonals, shape (V, 3).
    """

    solver: Solver
    before: Float[Tensor, "vertices 3"]
    after: Float[Tensor, "vertices 3"]

    def __call__(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """The solution [m]."""
        return self.solver(force * self.before).mul_(self.after)


class MergedMetric(Metric):
    """The metric of cloth with merged vertices: the first vertex of each label represents all.

    Attributes:
        label: A number for each vertex, shape (V,).
    """

    def __init__(
        self, matrix: sp.csr_matrix, label: np.ndarray, *, free: Bool[Tensor, "vertices 1"], dtype: torch.dtype
    ) -> None:
        """Add up the rows and columns of each label, and factorise.

        Args:
            matrix: As in `Metric`.
            label: A number for each vertex, shape (V,).
            free: False at fixed vertices; one fixed vertex fixes the whole label.
            dtype: Scalar type of the right-hand sides.
        """
        _, first, group = np.unique(label, return_index=True, return_inverse=True)
        representative, count = first[group], len(label)
        members = np.bincount(group)
        joined = sp.csr_matrix((np.ones(count), (representative, np.arange(count))), shape=(count, count))
        held = np.bincount(group, ~free[:, 0].cpu().numpy())[group] > 0
        device, moves = free.device, (representative == np.arange(count)) & ~held
        self.label = label
        self._representative = torch.as_tensor(representative, device=device)
        self._sum = Stencil(joined, dtype=dtype, device=str(device))
        self._members = torch.as_tensor(members[group], device=device).double()
        super().__init__(
            sp.csr_matrix(joined @ matrix @ joined.T),
            free=torch.as_tensor(moves, device=device).unsqueeze(1),
            dtype=dtype,
        )

    def plus(self, springs: Float[Tensor, " vertices"]) -> Metric:
        """The metric with added springs [N/m]; a spring on one vertex of a label holds all."""
        return super().plus(add_at(torch.zeros_like(springs), self._representative, springs))

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 of each label's total force [m], the same move for all vertices of the label."""
        return super().solve(self._sum.apply(force))[self._representative]

    def between(self, factor: Float[Tensor, "vertices 1"]) -> Solver:
        """The solve of R H0^-1 R F [m], with the forces of each label summed."""
        return lambda force: self.solve(force * factor).mul_(factor)

    def _hold(self, stiffness: Float[Tensor, " vertices"]) -> None:
        """Factorise with a diagonal [N/m], shared between the vertices of each label."""
        super()._hold(stiffness)
        self.diagonal = self.diagonal[self._representative] / self._members


class HostFactors:
    """Factors, on the CPU, of matrices with common couplings up to a factor and different diagonals."""

    def __init__(self, couplings: sp.csr_matrix, dtype: torch.dtype) -> None:
        """Keep the off-diagonal couplings, shape (V, V)."""
        self._couplings, self._dtype = couplings, dtype

    def factorised(self, scale: float, diagonal: Float[Tensor, " vertices"]) -> Solver:
        """The solve of scale * couplings + diagonal."""
        if not len(diagonal):
            return torch.empty_like
        matrix = sp.coo_matrix(scale * self._couplings + sp.diags(diagonal.numpy()))
        return _of_scipy(matrix) if cholespy is None else _of_cholespy(cholespy, matrix, self._dtype)


def _of_cholespy(module: Any, matrix: sp.coo_matrix, dtype: torch.dtype) -> Solver:
    """The solve by a Cholesky factor."""
    kind = module.CholeskySolverD if dtype == torch.float64 else module.CholeskySolverF
    rows, columns = (torch.as_tensor(of.astype(np.int32)) for of in (matrix.row, matrix.col))
    solver = kind(matrix.shape[0], rows, columns, torch.as_tensor(matrix.data), module.MatrixType.COO)

    def solve(force: Tensor) -> Tensor:
        out = torch.empty_like(force)
        solver.solve(force.contiguous(), out)
        return out

    return solve


def _of_scipy(matrix: sp.coo_matrix) -> Solver:
    """The solve by an LU factor without pivoting, not needed for a positive definite matrix."""
    options = {"SymmetricMode": True}
    factor = splu(sp.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return lambda force: torch.as_tensor(factor.solve(force.double().numpy()), dtype=force.dtype)


class DeviceFactors:
    """Factors of such matrices on CUDA; only the first factorisation passes through the host."""

    def __init__(
        self,
        couplings: sp.csr_matrix,
        dtype: torch.dtype,
        device: str,
        *,
        like: HostFactors | DeviceFactors | None = None,
    ) -> None:
        """Find the positions of the off-diagonal couplings, shape (V, V); the order is that of a like pattern."""
        count, each = couplings.shape[0], sp.coo_matrix(couplings)
        rows, columns = (np.concatenate([ends, np.arange(count)]) for ends in (each.row, each.col))
        order = np.lexsort((columns, rows))
        starts = np.searchsorted(rows[order], np.arange(count + 1))
        pattern = sp.csr_matrix((np.ones(len(order)), columns[order], starts), shape=(count, count))
        values = np.concatenate([each.data, np.zeros(count)])[order]
        self._values = torch.as_tensor(values, device=device)
        self._diagonal = torch.as_tensor(np.flatnonzero(rows[order] == columns[order]), device=device)
        self._rows, self._dtype = (pattern.indptr, pattern.indices), dtype
        known = like if isinstance(like, DeviceFactors) else None
        same = known is not None and all(map(np.array_equal, known._rows, self._rows))
        self._elimination = known._elimination if known is not None and same else Elimination(pattern, device=device)

    def factorised(self, scale: float, diagonal: Float[Tensor, " vertices"]) -> Solver:
        """The solve of scale * couplings + diagonal."""
        values = scale * self._values
        values[self._diagonal] = diagonal
        return DissectedSolver(self._elimination, values, dtype=self._dtype).solve
