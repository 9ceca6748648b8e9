"""The surface around each vertex: normal and neighbours.

From a vector v of a vertex, further vectors are derived. All rotate with the cloth like v, so a network may combine
them:

| name | vector | purpose |
|---|---|---|
| ``v.normal`` | (v . n) n | cloth is soft across the surface and stiff along the surface |
| ``v.smooth`` | mean of v over the neighbours | coarse and fine waves need steps of different lengths |
"""

from __future__ import annotations

from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from ..mesh.stencil import Stencil, add_at, incidence

PARTS = ("normal", "smooth")


class VertexFrame:
    """The surroundings of every vertex at positions x; each part is computed on first use."""

    def __init__(self, level: Level, x: Float[Tensor, "vertices 3"]) -> None:
        """Take positions x [m]; no gradients flow through the normals."""
        self._x, self._level = x.detach(), level
        if level not in _TABLES:
            _TABLES[level] = _Tables(level)
        self._tables = _TABLES[level]

    def part(self, vector: Float[Tensor, "vertices 3"], name: str) -> Float[Tensor, "vertices 3"]:
        """One of `PARTS` of a vector."""
        if name == "normal":
            return (vector * self.normal).sum(dim=1, keepdim=True) * self.normal
        return self._tables.smooth(vector)

    @cached_property
    def normal(self) -> Float[Tensor, "vertices 3"]:
        """Area-weighted unit normals; zero at triangles without area."""
        area = self._level.normals(self._x).repeat_interleave(3, dim=0)
        total = add_at(torch.zeros_like(self._x), self._level.triangles.long().reshape(-1), area)
        return torch.nn.functional.normalize(total, dim=1, eps=torch.finfo(total.dtype).tiny)

    @property
    def mesh(self) -> tuple[wp.array, ...]:
        """Arrays of the kernel, by vertex: row starts and corners of triangles, row starts and far ends of edges."""
        return self._tables.mesh


class _Tables:
    """Triangles, edges and neighbours of each vertex of a level, prepared for the kernels."""

    def __init__(self, level: Level) -> None:
        count, device, dtype = len(level.rest), str(level.rest.device), level.rest.dtype
        triangles, edges = level.triangles.cpu().numpy(), level.edges.cpu().numpy()
        (corner_starts, corner), (end_starts, end) = (
            [rows.cpu().numpy() for rows in incidence(elements, count)] for elements in (level.triangles, level.edges)
        )
        turned = np.take_along_axis(
            triangles[corner // 3], (corner[:, None] % 3 + np.array([1, 2], np.int32)) % 3, axis=1
        )
        far = edges[end // 2, 1 - end % 2].astype(np.int32)

        def ints(values: np.ndarray, kind: Any = wp.int32) -> wp.array:
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=kind, device=device)

        self.mesh = (ints(corner_starts), ints(turned, wp.vec2i), ints(end_starts), ints(far))
        degree = np.diff(end_starts)
        weights = 1.0 / np.repeat(np.maximum(degree, 1), degree)
        mean = sp.csr_matrix((weights, far, end_starts), shape=(count, count))
        self._mean = Stencil(mean, dtype=dtype, device=device, threads=level.threads)

    def smooth(self, vector: Tensor) -> Tensor:
        """Mean over the neighbours; gradients flow through."""
        return _Smooth.apply(vector, self) if vector.requires_grad else self._mean.apply(vector.contiguous())


class _Smooth(torch.autograd.Function):
    """The mean over the neighbours and its transpose."""

    @staticmethod
    def forward(ctx: Any, vector: Tensor, tables: _Tables) -> Tensor:
        ctx.tables = tables
        return tables._mean.apply(vector.contiguous())

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None]:  # type: ignore[override]
        return ctx.tables._mean.transposed.apply(gradients[0].contiguous()), None


_TABLES: WeakKeyDictionary[Level, _Tables] = WeakKeyDictionary()
