"""The coarser levels of a metric, with the Galerkin projection of the finest level's contact stiffness.

    A_l = Z_l^T (H + K) Z_l = H_l + Z_l^T K Z_l

| symbol | meaning |
|---|---|
| H | metric of the level that is solved, shape (V, V) |
| Z_l | linear map from level l; l = 0 is the cage |
| K | contact stiffness, a diagonal |

For the levels between, only the diagonal of A_l is needed; for the cage, all entries. Both are linear in K, so one
sparse product gives all, and the cage's pattern does not depend on the contact.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from torch import Tensor

from ..mesh.recorded import Recordings
from ..mesh.stencil import Stencil, three_columns
from .base import Solver
from .factors import Factors

COARSE = 0.7
"""Weight of the cage's part of P."""
MOST_DENSE = 6000
"""Most vertices of a cage that is solved by its inverse matrix, on a card: a dense factor needs no host."""
REGULARISATION = 1e-7
"""Regularisation of a factorised diagonal, relative to its mean: keeps loose parts without a guide definite."""


class CoarseLevels:
    """The coarser levels of a metric, with any contact stiffness.

    Attributes:
        ups: Linear map to each level from the next coarser one, finest first; for the cage, from itself.
        dense: Whether the cage is solved by its inverse matrix.
        recordings: Recorded moves, on a card.
    """

    def __init__(
        self, matrix: sp.csr_matrix, ups: Sequence[Stencil], onto: sp.csr_matrix, *, dtype: torch.dtype, device: str
    ) -> None:
        """Take a metric to its coarser levels.

        Args:
            matrix: H [N/m], any at fixed vertices, with a full diagonal, shape (V, V).
            ups: Linear map to each level from the next coarser one, finest first.
            onto: Projection of moves of the finest level, zero at fixed vertices, shape (V, V).
            dtype: Scalar type of forces.
            device: "cpu" or a CUDA device.
        """
        first = ups[0].alike(onto @ ups[0].matrix) if ups else Stencil(onto, dtype=dtype, device=device)
        self.ups = [first, *ups[1:]]
        basis, weights = sp.identity(matrix.shape[0], format="csr"), list[sp.csr_matrix]()
        pattern = sp.csr_matrix((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape)
        for up in self.ups:
            basis = sp.csr_matrix(basis @ up.matrix)
            pattern = abs(up.transposed.matrix) @ pattern @ abs(up.matrix)
            weights.append(sp.csr_matrix(basis.multiply(basis).T))
        self._factors = Factors(sp.csr_matrix(pattern + sp.identity(basis.shape[1])), dtype=dtype, device=device)
        weights[-1] = _squares(basis, self._factors)
        self._sizes, self._plain_entries = [table.shape[0] for table in weights], self._entries(matrix)
        self._weights = Stencil(sp.csr_matrix(sp.vstack(weights)), dtype=torch.float64, device=device)
        self._dtype, self.dense = dtype, device != "cpu" and 0 < basis.shape[1] <= MOST_DENSE
        self.recordings = Recordings()

    def of(self, matrix: sp.csr_matrix) -> CoarseLevels:
        """The levels of another matrix H [N/m] of the same pattern, shape (V, V)."""
        levels = copy.copy(self)
        levels._plain_entries = self._entries(matrix)
        return levels

    def _entries(self, matrix: sp.csr_matrix) -> Float[Tensor, " entries"]:
        """Diagonals of all H_l, finest first, of the cage all entries [N/m]."""
        entries = list[np.ndarray]()
        for up in self.ups:
            matrix = sp.csr_matrix(up.transposed.matrix @ (matrix @ up.matrix))
            entries.append(matrix.diagonal())
        apart = sp.diags((entries[-1] <= 0).astype(np.float64))  # Identity rows where nothing moves.
        entries[-1] = self._factors.taken(sp.csr_matrix(matrix + apart))
        return torch.as_tensor(np.concatenate(entries), device=self._factors.rows.device)

    def held(self, stiff: Float[Tensor, " vertices"]) -> tuple[list[Tensor], Solver | Float[Tensor, "cage cage"]]:
        """Diagonals of the levels between [N/m], finest first, and the solve of the cage, given K [N/m].

        The solve is the inverse matrix if `dense`, else a function.
        """
        entries = self._plain_entries + self._weights.apply(three_columns(stiff.double()))[:, 0]
        *between, cage = entries.split(self._sizes)
        scale = cage[self._factors.diagonal].mean().reciprocal()
        cage = cage * scale
        cage[self._factors.diagonal] += REGULARISATION
        scale, between = scale.to(stiff), [diagonal.to(stiff) for diagonal in between]
        if self.dense:
            return between, self._factors.inverse(cage).mul_(scale)
        solver = self._factors.of(cage)
        return between, lambda force: solver(force * scale)

    def move(
        self, force: Float[Tensor, "vertices 3"], cage: Any, rough: Float[Tensor, "vertices 3"], *middle: Tensor
    ) -> Float[Tensor, "vertices 3"]:
        """P F [m], as in `metric`.

        Args:
            force: F [N].
            cage: The solve of the cage.
            rough: Factor of the finest level's part [m/N].
            middle: Factors of the parts of the levels between, finest first.
        """
        *finer, low = self.forces(force)
        move = (cage @ low if isinstance(cage, Tensor) else cage(low)).mul_(COARSE)
        for up, part, factor in zip(self.ups[::-1], finer[::-1], [rough, *middle][::-1], strict=True):
            move = up.apply(move).addcmul_(part, factor)
        return move

    def forces(self, force: Float[Tensor, "vertices 3"]) -> list[Float[Tensor, "_ 3"]]:
        """Z_l^T F of all levels, finest first [N]."""
        out = [force]
        for up in self.ups:
            out.append(up.transposed.apply(out[-1]))
        return out

    def scaled(self, stiffer: Float[Tensor, " vertices"]) -> CoarseLevels:
        """Approximation of the levels of R H R, R^2 the given numbers: R^2 is averaged at each coarse vertex."""
        levels, ones = copy.copy(self), torch.ones_like(stiffer)
        sums = (self.forces(three_columns(values.to(self._dtype))) for values in (stiffer, ones))
        means = [(total[:, 0] / weight[:, 0]).nan_to_num(nan=1.0).double() for total, weight in zip(*sums, strict=True)]
        entries = (means[-1][self._factors.rows] * means[-1][self._factors.columns]).sqrt()
        levels._plain_entries = self._plain_entries * torch.cat([*means[1:-1], entries])
        return levels


def _squares(basis: sp.csr_matrix, cage: Factors) -> sp.csr_matrix:
    """The linear map from a diagonal K to the entries of Z^T K Z, shape (entries, V)."""
    counts = np.diff(basis.indptr)
    vertex = np.repeat(np.arange(basis.shape[0]), counts)
    first = np.repeat(np.arange(basis.nnz), counts[vertex])
    second = ranges(basis.indptr[vertex], counts[vertex])
    entry = cage.places(basis.indices[first], basis.indices[second])
    products = basis.data[first] * basis.data[second]
    return sp.csr_matrix((products, (entry, vertex[first])), shape=(len(cage.rows), basis.shape[0]))


def ranges(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Concatenation of the ranges starts[i], starts[i] + 1, ..., each with counts[i] numbers."""
    before = np.cumsum(counts) - counts
    return np.repeat(starts - before, counts) + np.arange(int(counts.sum()))
