"""Factors of symmetric positive definite matrices of one pattern, by cholespy on the CPU or CUDA, else by scipy."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from scipy.sparse.linalg import splu
from torch import Tensor

from .base import Solver

try:
    import cholespy
except ImportError:  # Linux on ARM has no wheel.
    cholespy = None

FACTOR = "scipy" if cholespy is None else "cholespy"
"""Library used for factors."""


class Factors:
    """Factors of the matrices of a pattern.

    Attributes:
        rows, columns: Row and column of each entry, shape (entries,).
        diagonal: Numbers of the diagonal's entries, shape (V,).
    """

    def __init__(self, pattern: sp.csr_matrix, *, dtype: torch.dtype, device: str) -> None:
        """Number the entries of a symmetric pattern with a full diagonal, shape (V, V); dtype is the forces'."""
        self._dtype = dtype
        pattern.sort_indices()
        self._count, columns = pattern.shape[0], pattern.indices.astype(np.int64)
        rows = np.repeat(np.arange(self._count), np.diff(pattern.indptr))
        self._keys = rows * self._count + columns
        self.rows, self.columns = (torch.as_tensor(indices, device=device) for indices in (rows, columns))
        self.diagonal = torch.as_tensor(np.flatnonzero(rows == columns), device=device)

    def places(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Numbers of the entries in given rows and columns."""
        return np.searchsorted(self._keys, rows.astype(np.int64) * self._count + columns)

    def taken(self, matrix: sp.csr_matrix) -> Float[np.ndarray, " entries"]:
        """Entries of a matrix with a smaller or equal pattern, in this pattern's order."""
        out, coo = np.zeros(len(self._keys)), sp.coo_matrix(matrix)
        out[self.places(coo.row, coo.col)] = coo.data
        return out

    def of(self, values: Float[Tensor, " entries"]) -> Solver:
        """The solve of a matrix with these entries, float64."""
        if not self._count:
            return torch.empty_like
        if cholespy is None:
            indices, shape = (self.rows.cpu().numpy(), self.columns.cpu().numpy()), (self._count, self._count)
            return _of_scipy(sp.coo_matrix((values.cpu().numpy(), indices), shape=shape))
        return _of_cholespy(cholespy, values, self.rows.int(), self.columns.int(), self._dtype)

    def inverse(self, values: Float[Tensor, " entries"]) -> Float[Tensor, "V V"]:
        """The inverse of a matrix with these entries, as a dense matrix."""
        matrix = torch.zeros((self._count, self._count), dtype=self._dtype, device=values.device)
        matrix[self.rows, self.columns] = values.to(self._dtype)
        return torch.cholesky_inverse(torch.linalg.cholesky_ex(matrix)[0]).contiguous()


def _of_cholespy(module: Any, values: Tensor, rows: Tensor, columns: Tensor, dtype: torch.dtype) -> Solver:
    kind = module.CholeskySolverD if dtype == torch.float64 else module.CholeskySolverF
    factor = [kind(int(rows.max()) + 1, rows, columns, values, module.MatrixType.COO)]
    solved = list[Tensor]()

    def solve(force: Tensor) -> Tensor:
        out = torch.empty_like(force)
        factor[0].solve(force.contiguous(), out)
        solved[:] = [force.new_empty(len(force), 0)] if force.device.type == "cpu" else []
        return out

    # Also at exit: cholespy complains on stderr about factors that a traceback or a thread still references.
    weakref.finalize(solve, _release, factor, solved)
    return solve


def _release(factor: list[Any], solved: list[Tensor]) -> None:
    """Free a factor, and on the CPU its copy of the last right-hand sides: 24 bytes a vertex.

    cholespy 2.2 frees the copy only in a solve with a different number of right-hand sides, not with the factor. A
    factor without a solve has no copy, and cannot solve an empty right-hand side.

    Args:
        factor: The factor alone.
        solved: No right-hand sides, shape (V, 0), if the factor has solved any; else empty.
    """
    for nothing in solved:
        factor[0].solve(nothing, nothing)
    factor.clear()


def _of_scipy(matrix: sp.coo_matrix) -> Solver:
    """The solve by an LU factor without pivoting, not needed for a positive definite matrix."""
    options = {"SymmetricMode": True}
    factor = splu(sp.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return lambda force: torch.as_tensor(factor.solve(force.double().cpu().numpy())).to(force)
