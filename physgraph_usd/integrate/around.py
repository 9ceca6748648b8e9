"""What a vertex sees of the surface around it: its normal, the strain of its edges, its neighbours.

A vector v of a vertex gives others that turn with the cloth as v does, and that a network may combine:

| name | vector | what for |
|---|---|---|
| ``v.normal`` | (v . n) n | cloth is soft across itself and stiff along itself |
| ``v.strain`` | E v, E = mean of asinh(e / `STRAIN`) u u^T over the edges | it folds along what is compressed |
| ``v.smooth`` | mean of v over the neighbours | coarse and fine waves want steps of different lengths |
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false
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

from ..mesh.lanes import Launch
from ..mesh.stencil import SCALAR, VECTOR, Stencil, vectors
from ..mesh.topology import incidence
from .base import Surface

PARTS = ("normal", "strain", "smooth")
SHOWN = 30.0
"""What strains are multiplied by before a network sees their asinh."""
FLOOR = 1e-9
"""Added to mean squares before their root."""
STRAIN = 0.03
"""Strain that counts as one: cloth that folds is compressed by some per cent."""


class Around:
    """The surroundings of every vertex at positions x; each part is found when it is asked for first."""

    def __init__(self, level: Surface, x: Float[Tensor, "vertices 3"]) -> None:
        """Look from positions x [m]; no gradients flow through what is seen."""
        self._x = x.detach()
        if level not in _KNOWN:
            _KNOWN[level] = _Tables(level)
        self._tables = _KNOWN[level]

    def part(self, vector: Float[Tensor, "vertices 3"], name: str) -> Float[Tensor, "vertices 3"]:
        """One of `PARTS` of a vector."""
        if name == "normal":
            return (vector * self.normal).sum(dim=1, keepdim=True) * self.normal
        if name == "strain":
            return (self.strain @ vector.unsqueeze(2)).squeeze(2)
        return self._tables.smooth(vector)

    @cached_property
    def normal(self) -> Float[Tensor, "vertices 3"]:
        """Area-weighted unit normals; zero where triangles have no area."""
        out = torch.empty_like(self._x)
        self._tables.normals({2: vectors(self._x), 3: vectors(out)})
        return out

    @cached_property
    def strain(self) -> Float[Tensor, "vertices 3 3"]:
        """E of each vertex."""
        along, amount = self._edges
        out = self._x.new_empty(len(self._x), 3, 3)
        wide = wp.types.matrix(shape=(3, 3), dtype=SCALAR[self._x.dtype])
        shown = torch.asinh(amount / STRAIN)
        self._tables.strains({3: vectors(along), 4: wp.from_torch(shown), 5: wp.from_torch(out, dtype=wide)})
        return out

    @cached_property
    def stretch(self) -> Float[Tensor, "vertices 3"]:
        """Mean, mean compression and root mean square of the strain of each vertex's edges, as networks see them."""
        out = torch.empty_like(self._x)
        self._tables.stretches({3: wp.from_torch(self._edges[1]), 4: vectors(out)})
        return torch.asinh(SHOWN * out)

    @cached_property
    def _edges(self) -> tuple[Float[Tensor, "edges 3"], Float[Tensor, " edges"]]:
        """Direction and strain of each edge."""
        along = self._x.new_empty(self._tables.edges, 3)
        amount = self._x.new_empty(self._tables.edges)
        self._tables.spans({2: vectors(self._x), 3: vectors(along), 4: wp.from_torch(amount)})
        return along, amount


class _Tables:
    """What lies around each vertex of a level, ready for the kernels."""

    def __init__(self, level: Surface) -> None:
        count, device, dtype = len(level.rest), str(level.rest.device), level.rest.dtype
        triangles, edges = level.triangles.cpu().numpy(), level.edges.cpu().numpy()
        corner, end = incidence(triangles, count), incidence(edges, count)
        others = triangles[corner.element]
        turned = np.take_along_axis(others, (corner.corner[:, None] + [1, 2]) % 3, axis=1).astype(np.int32)
        far = edges[end.element, 1 - end.corner].astype(np.int32)
        self.edges = len(edges)
        x = vectors(torch.zeros_like(level.rest))
        wide = wp.zeros(count, dtype=wp.types.matrix(shape=(3, 3), dtype=SCALAR[dtype]), device=device)

        def ints(values: np.ndarray, kind: Any = wp.int32) -> wp.array:
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=kind, device=device)

        given = {"device": device, "lanes": level.lanes}
        self.normals = Launch(_NORMALS[dtype], count, [ints(corner.starts), ints(turned, wp.vec2i), x, x], **given)
        rest = wp.array(level.rest_length.double().cpu().numpy(), dtype=SCALAR[dtype], device=device)
        along, amount = vectors(level.rest.new_zeros(self.edges, 3)), wp.from_torch(level.rest.new_zeros(self.edges))
        pairs = ints(edges, wp.vec2i)
        self.spans = Launch(_SPANS[dtype], self.edges, [pairs, rest, x, along, amount], **given)
        around = [ints(end.starts), ints(end.element)]
        self.strains = Launch(_STRAINS[dtype], count, [*around, rest, along, amount, wide], **given)
        self.stretches = Launch(_STRETCHES[dtype], count, [*around, rest, amount, x], **given)
        degree = np.diff(end.starts)
        weights = 1.0 / np.repeat(np.maximum(degree, 1), degree)
        mean = sp.csr_matrix((weights, far, end.starts), shape=(count, count))
        self._mean = Stencil(mean, dtype=dtype, device=device, lanes=level.lanes)
        self._back = Stencil(sp.csr_matrix(mean.T), dtype=dtype, device=device, lanes=level.lanes)

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
        return ctx.tables._back.apply(gradients[0].contiguous()), None


_KNOWN: WeakKeyDictionary[Surface, _Tables] = WeakKeyDictionary()


@wp.kernel
def _normals(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    others: wp.array(dtype=wp.vec2i),
    x: wp.array(dtype=Any),
    out: wp.array(dtype=Any),
):
    i = first + wp.tid()
    total = x[i] - x[i]
    for k in range(starts[i], starts[i + 1]):
        total += wp.cross(x[others[k][0]] - x[i], x[others[k][1]] - x[i])
    out[i] = wp.normalize(total)


@wp.kernel
def _spans(
    first: wp.int32,
    ends: wp.array(dtype=wp.vec2i),
    rest: wp.array(dtype=Any),
    x: wp.array(dtype=Any),
    along: wp.array(dtype=Any),
    amount: wp.array(dtype=Any),
):
    e = first + wp.tid()
    span = x[ends[e][1]] - x[ends[e][0]]
    length = wp.max(wp.length(span), rest[e] * rest.dtype(1.0e-6))
    along[e] = span / length
    amount[e] = length / rest[e] - rest.dtype(1.0)


@wp.kernel
def _strains(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    edges: wp.array(dtype=wp.int32),
    rest: wp.array(dtype=Any),
    along: wp.array(dtype=Any),
    amount: wp.array(dtype=Any),
    out: wp.array(dtype=Any),
):
    i = first + wp.tid()
    zero = along[0] - along[0]
    total = wp.outer(zero, zero)
    for k in range(starts[i], starts[i + 1]):
        e = edges[k]
        total += amount[e] * wp.outer(along[e], along[e])
    out[i] = total / rest.dtype(wp.max(starts[i + 1] - starts[i], 1))


@wp.kernel
def _stretches(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    edges: wp.array(dtype=wp.int32),
    rest: wp.array(dtype=Any),
    amount: wp.array(dtype=Any),
    out: wp.array(dtype=Any),
):
    i = first + wp.tid()
    mean = rest.dtype(0.0)
    below = rest.dtype(0.0)
    square = rest.dtype(0.0)
    for k in range(starts[i], starts[i + 1]):
        e = amount[edges[k]]
        mean += e
        below += wp.min(e, rest.dtype(0.0))
        square += e * e
    share = rest.dtype(1.0) / rest.dtype(wp.max(starts[i + 1] - starts[i], 1))
    v = out[i]
    v[0] = mean * share
    v[1] = below * share
    v[2] = wp.sqrt(square * share + rest.dtype(wp.static(FLOOR)))
    out[i] = v


def _arrays(t: torch.dtype, kinds: str) -> list[Any]:
    """Types of a kernel's parameters: i integers, p pairs of them, s scalars, v vectors, m matrices."""
    known = {"i": wp.int32, "p": wp.vec2i, "s": SCALAR[t], "v": VECTOR[t]}
    known["m"] = wp.types.matrix(shape=(3, 3), dtype=SCALAR[t])
    return [wp.int32, *(wp.array(dtype=known[kind]) for kind in kinds)]


_NORMALS, _SPANS, _STRAINS, _STRETCHES = (
    {t: wp.overload(kernel, _arrays(t, kinds)) for t in VECTOR}
    for kernel, kinds in ((_normals, "ipvv"), (_spans, "psvvs"), (_strains, "iisvsm"), (_stretches, "iissv"))
)
