"""The metric: one scalar symmetric positive definite matrix per level.

Free cloth is solved exactly, by a factor made on first use. Cloth in contact is solved level by level (BPX, after
Bramble, Pasciak and Xu 1990): the cage exactly, each finer level by its diagonal:

    P = c Z_0 A_0^-1 Z_0^T + sum_l Z_l diag(A_l)^-1 Z_l^T + r diag(A)^-1,   A_l = Z_l^T A Z_l,   A = H0 + K

| symbol | meaning |
|---|---|
| Z_l | linear map from level l; l = 0 is the cage, the sum has the levels between |
| K | contact stiffness, a diagonal |
| c, r | `coarse.COARSE`, `ROUGH`: such that a first step hardly needs shortening |
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..mesh.recorded import Work
from ..mesh.stencil import Stencil, three_columns
from .base import Solver
from .coarse import COARSE, REGULARISATION, CoarseLevels
from .factors import Factors

ROUGH = 2.0
"""Weight of the finest level's part of P."""


def laplacian(edges: np.ndarray, between: np.ndarray, fixed: np.ndarray) -> sp.csr_matrix:
    """The matrix of springs; springs with negative stiffness are left out.

    Args:
        edges: End vertices, shape (E, 2).
        between: Stiffness of a spring along each edge [N/m], shape (E,).
        fixed: Stiffness between each vertex and a fixed point [N/m], not below 0, shape (V,).

    Returns:
        Symmetric positive semi-definite [N/m], shape (V, V), of the same pattern for all stiffnesses.
    """
    count, between, (a, b) = len(fixed), np.maximum(between, 0.0), np.asarray(edges).T
    diagonal = fixed + np.bincount(a, between, count) + np.bincount(b, between, count)
    itself = np.arange(count, dtype=a.dtype)
    indices = np.concatenate([a, b, itself]), np.concatenate([b, a, itself])
    return sp.csr_matrix((np.concatenate([-between, -between, diagonal]), indices), shape=(count, count))


def _same(field: Tensor) -> Tensor:
    """The field itself: without merged vertices the matrix has a row for each vertex."""
    return field


class Metric:
    """H0: the same matrix for x, y and z.

    Attributes:
        diagonal: Diagonal of H0 [N/m], float64; 1 at fixed vertices, shape (V,).
        gathered: Gives the forces on the matrix's rows, given those on vertices [N], shape (V, 3).
        spread: Gives the moves of vertices, given those of the matrix's rows [m], shape (V, 3).
    """

    def __init__(
        self,
        matrix: sp.csr_matrix,
        *,
        free: Bool[Tensor, "vertices 1"],
        dtype: torch.dtype,
        ups: Sequence[Stencil] = (),
        last: Metric | None = None,
    ) -> None:
        """Take a scalar Hessian at rest.

        Args:
            matrix: Symmetric positive semi-definite [N/m], shape (V, V).
            free: False at fixed vertices, whose rows become identity rows.
            dtype: Scalar type of the right-hand sides.
            ups: Linear map to each level from the next coarser one, finest first.
            last: A metric of the same cloth with a matrix of the same pattern, to reuse its coarse levels; or None.
        """
        self._alike: CoarseLevels | None = None if last is None else last.__dict__.get("coarse", last._alike)
        self._free, self._matrix, self._ups, device = free.squeeze(1), matrix, tuple(ups), str(free.device)
        self._mask = three_columns(self._free.to(dtype))
        self.gathered: Solver = _same
        self.spread: Solver = _same
        self._merged: MergedMetric | None = None
        self._unscaled: tuple[Metric, Tensor] | None = None
        self._keep = sp.diags(self._free.cpu().numpy().astype(np.float64))
        stiffness = torch.as_tensor(matrix.diagonal(), device=device)
        moved = stiffness[self._free].cpu().numpy()
        # A unit mean diagonal keeps float32 pivots in range whatever the fabric and the level.
        self._scale = 1.0 / float(moved.mean()) if (moved > 0).any() else 1.0
        self._scaled = self._scale * self._mask
        self.diagonal = torch.where(self._free, stiffness + REGULARISATION / self._scale, 1.0)

    @cached_property
    def _solver(self) -> Solver:
        """The solve by the Cholesky factor of H0."""
        if self._unscaled is not None:
            return self._unscaled[0]._solver
        moving = sp.csr_matrix(self._keep @ self._matrix @ self._keep)
        moving.eliminate_zeros()
        pattern = sp.csr_matrix(abs(moving) + sp.identity(moving.shape[0]))
        factors = Factors(pattern, dtype=self._mask.dtype, device=str(self._mask.device))
        values = torch.as_tensor(self._scale * factors.taken(moving), device=self._mask.device)
        values[factors.diagonal] += torch.where(self._free, REGULARISATION, 1.0)
        return factors.of(values)

    @cached_property
    def coarse(self) -> CoarseLevels:
        """The coarser levels."""
        if self._unscaled is not None:
            metric, stiffer = self._unscaled
            return metric.coarse.scaled(stiffer)
        if self._alike is not None:
            return self._alike.of(self._matrix)
        dtype, device = self._mask.dtype, str(self._mask.device)
        return CoarseLevels(self._matrix, self._ups, self._onto, dtype=dtype, device=device)

    @property
    def _onto(self) -> sp.csr_matrix:
        """Map from the level's vertices to the matrix's rows, for moves, shape (V, V)."""
        return sp.csr_matrix(self._keep)

    def scaled(self, stiffer: Float[Tensor, " vertices"]) -> Metric:
        """R H0 R, R a diagonal, solved by the Cholesky factor of H0; its diagonal is that of H0 times given numbers.

        Args:
            stiffer: R^2 at each vertex, positive.
        """
        metric, root = copy.copy(self), three_columns(stiffer.to(self._mask).rsqrt())
        for name in ("coarse", "_solver", "_of_free"):
            metric.__dict__.pop(name, None)
        metric._scaled, metric._mask = self._scaled * root, self._mask * root
        metric.diagonal = torch.where(self._free, self.diagonal * stiffer.double(), 1.0)
        metric._unscaled = self, stiffer
        return metric

    def merged(self, label: np.ndarray) -> MergedMetric:
        """The metric of the same cloth with all vertices of equal label merged; cached while the labels stay the same.

        Args:
            label: A number for each vertex, shape (V,).
        """
        if self._merged is None or not np.array_equal(self._merged.label, label):
            free, dtype = self._free.unsqueeze(1), self._mask.dtype
            self._merged = MergedMetric(self._matrix, label, free=free, dtype=dtype, ups=self._ups)
        return self._merged

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 F [m]; zero at fixed vertices."""
        return self._solver(force * self._scaled).mul_(self._mask)

    def stiffened(self, stiffness: Float[Tensor, " vertices"]) -> Solver:
        """R H0^-1 R, as in `Preconditioner`."""
        diagonal = self.diagonal.to(stiffness)
        factor = (diagonal / torch.maximum(diagonal, stiffness)).sqrt().unsqueeze(1)
        return lambda force: self.solve(force * factor).mul_(factor)

    def by_levels(self, stiff: Float[Tensor, " vertices"]) -> Work:
        """P F [m] of F, given K [N/m]; zero at fixed vertices, provided that the force is zero there."""
        tiny = torch.finfo(stiff.dtype).tiny  # Rows without stiffness have no force.
        rough = ROUGH / self.gathered(three_columns(self.diagonal.to(stiff) + stiff)).clamp_min(tiny)
        between, cage = self.coarse.held(self.gathered(three_columns(stiff))[:, 0])
        middle = [three_columns(1.0 / diagonal.clamp_min(tiny)) for diagonal in between]
        move, gathered, spread = self.coarse.move, self.gathered, self.spread

        def product(force: Tensor, *arrays: Any) -> tuple[Tensor]:  # Holds no metric: metrics hold products.
            return (spread(move(gathered(force), *arrays)),)

        return Work(self.coarse.ups[0], product, (cage, rough, *middle))

    @cached_property
    def _of_free(self) -> Work:
        """P F [m] without contact stiffness."""
        return self.by_levels(torch.zeros_like(self._mask[:, 0]))

    def estimate(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """An estimate of H0^-1 F [m], without a factor: P F / c, since errors are smooth after a few steps."""
        return self._of_free.run(self.coarse.recordings, force)[0].mul_(1.0 / COARSE)


class MergedMetric(Metric):
    """The metric of cloth with merged vertices: the first vertex of each label represents all.

    Attributes:
        label: A number for each vertex, shape (V,).
    """

    def __init__(
        self,
        matrix: sp.csr_matrix,
        label: np.ndarray,
        *,
        free: Bool[Tensor, "vertices 1"],
        dtype: torch.dtype,
        ups: Sequence[Stencil],
    ) -> None:
        """Add up the rows and columns of each label, and factorise.

        Args:
            matrix: As in `Metric`.
            label: A number for each vertex, shape (V,).
            free: False at fixed vertices; one fixed vertex fixes the whole label.
            dtype: Scalar type of the right-hand sides.
            ups: As in `Metric`.
        """
        _, first, group = np.unique(label, return_index=True, return_inverse=True)
        representative, count = first[group], len(label)
        members = np.bincount(group)
        joined = sp.csr_matrix((np.ones(count), (representative, np.arange(count))), shape=(count, count))
        fixed = np.bincount(group, ~free[:, 0].cpu().numpy())[group] > 0
        device, moves = free.device, (representative == np.arange(count)) & ~fixed
        self.label, self._joined = label, joined
        first_of = torch.as_tensor(representative, device=device)
        merged, free = sp.csr_matrix(joined @ matrix @ joined.T), torch.as_tensor(moves, device=device).unsqueeze(1)
        super().__init__(merged, free=free, dtype=dtype, ups=ups)
        self.diagonal = self.diagonal[first_of] / torch.as_tensor(members[group], device=device)
        self.gathered = Stencil(joined, dtype=dtype, device=str(device)).apply
        self.spread = lambda move: move[first_of]

    @property
    def _onto(self) -> sp.csr_matrix:
        """The mean over each label."""
        members = sp.diags(1.0 / np.maximum(np.asarray(self._joined.sum(axis=1)).ravel(), 1.0))
        return sp.csr_matrix(self._keep @ members @ self._joined)

    def solve(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """H0^-1 of each label's total force [m], the same move for all vertices of the label."""
        return self.spread(super().solve(self.gathered(force)))
