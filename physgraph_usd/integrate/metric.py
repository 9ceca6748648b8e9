"""The metric: one scalar symmetric positive definite matrix per level, factorised once (DESIGN 4.3)."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from cholespy import CholeskySolverD, CholeskySolverF, MatrixType  # pyright: ignore[reportAttributeAccessIssue]
from jaxtyping import Bool, Float
from torch import Tensor

from .dissection import DissectedSolver, Dissection, dissect

REGULARISATION = 1e-7
"""Added to the diagonal, relative to its mean: keeps loose parts without a guide definite."""


def kept_to_edges(matrix: sp.csr_matrix, edges: np.ndarray) -> sp.csr_matrix:
    """A graph Laplacian with a matrix's negative couplings along the edges and its row sums.

    The rest form of bending also couples vertices across two triangles. Those entries double the time of a solve, and
    take the gap at equal steps from 6.9% to 6.1% at best: on a sleeve, elsewhere by nothing (benchmarks/metric.py).

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
    """H0, factorised: the same matrix for x, y and z."""

    def __init__(
        self,
        matrix: sp.csr_matrix,
        *,
        free: Bool[Tensor, "vertices 1"],
        dtype: torch.dtype,
        dissection: Dissection | None = None,
    ) -> None:
        """Factorise a scalar Hessian at rest.

        Args:
            matrix: Symmetric positive semi-definite [N/m], shape (V, V).
            free: False where a vertex may not move: its row becomes the identity's.
            dtype: Scalar type of the right-hand sides.
            dissection: For CUDA: an order that suits the matrix, where one is known.
        """
        self._plain, self._dtype = matrix, dtype
        mask = free.cpu().numpy().ravel()
        diagonal = matrix.diagonal()
        mean = float(diagonal[mask].mean()) if mask.any() else 1.0
        # A unit mean diagonal keeps float32 pivots in range whatever the fabric and the level.
        self._scale = 1.0 / mean if mean > 0 else 1.0
        keep = sp.diags(mask.astype(np.float64))
        shift = sp.diags(np.where(mask, REGULARISATION, 1.0))
        self.matrix = sp.csr_matrix(self._scale * (keep @ matrix @ keep) + shift)
        self._dissection, self._mask = None, free
        self._kept = free.to(dtype)
        self._scaled = self._scale * self._kept
        if free.is_cuda:
            self._dissection = dissection or dissect(self.matrix)
            self._solver = DissectedSolver(self.matrix, self._dissection, dtype=dtype, device=str(free.device))
            return
        coo = self.matrix.tocoo()
        solver = CholeskySolverD if dtype == torch.float64 else CholeskySolverF
        rows, columns = (torch.as_tensor(of.astype(np.int32)) for of in (coo.row, coo.col))
        values = torch.as_tensor(coo.data.astype(np.float64))
        self._solver = solver(matrix.shape[0], rows, columns, values, MatrixType.COO) if len(mask) else None

    def plus(self, diagonal: Float[Tensor, " vertices"]) -> Metric:
        """The metric of the same cloth held by springs of given stiffness [N/m], factorised anew."""
        springs = sp.diags(diagonal.double().cpu().numpy())
        matrix = sp.csr_matrix(self._plain + springs)
        return Metric(matrix, free=self._mask, dtype=self._dtype, dissection=self._dissection)

    @property
    def diagonal(self) -> Float[Tensor, " vertices"]:
        """Diagonal of H0 [N/m], float64 on the CPU; 1 where a vertex may not move."""
        diagonal = torch.as_tensor(self.matrix.diagonal() / self._scale)
        return torch.where(self._mask.cpu().squeeze(1), diagonal, 1.0)

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m]; zero where a vertex may not move."""
        if isinstance(self._solver, DissectedSolver):
            return self._solver.solve(force * self._scaled) * self._kept
        out = torch.empty_like(force)
        if self._solver is None:
            return out
        self._solver.solve((force * self._scaled).contiguous(), out)
        return out.mul_(self._kept)
