"""What a vertex sees of the surface around it: its normal, the strain of its edges, its neighbours.

A vector v of a vertex gives others that turn with the cloth as v does, and that a network may combine:

| name | vector | what for |
|---|---|---|
| ``v.normal`` | (v . n) n | cloth is soft across itself and stiff along itself |
| ``v.strain`` | E v, E = mean of `squashed` e / `STRAIN` u u^T over the edges | it folds along what is compressed |
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

from ..mesh.incidence import incidence
from ..mesh.stencil import SCALAR, VECTOR, Stencil, vectors
from ..mesh.threads import Launch
from .base import Surface

wp.set_module_options({"enable_backward": False})

PARTS = ("normal", "strain", "smooth")
SHOWN = 30.0
"""What strains are multiplied by before a network sees them `squashed`."""
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

    @property
    def strain(self) -> Float[Tensor, "vertices 3 3"]:
        """E of each vertex."""
        return self._strained[0]

    @property
    def stretch(self) -> Float[Tensor, "vertices 3"]:
        """Mean, mean compression and root mean square of the strain of each vertex's edges, as networks see them."""
        return self._strained[1]

    @cached_property
    def _strained(self) -> tuple[Float[Tensor, "vertices 3 3"], Float[Tensor, "vertices 3"]]:
        """`strain` and `stretch`."""
        matrix, seen = self._x.new_empty(len(self._x), 3, 3), torch.empty_like(self._x)
        wide = wp.types.matrix(shape=(3, 3), dtype=SCALAR[self._x.dtype])
        self._tables.strains({3: vectors(self._x), 4: wp.from_torch(matrix, dtype=wide), 5: vectors(seen)})
        return matrix, seen

    @property
    def positions(self) -> wp.array:
        """The positions, for kernels."""
        return vectors(self._x)

    @property
    def mesh(self) -> tuple[wp.array, ...]:
        """What lies around each vertex, for kernels: triangles from where, their other corners; edges from where, their
        far ends."""
        return self._tables.mesh


def squashed(strain: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """a / sqrt(1 + |a|): small strains as they are, large ones by their root."""
    return strain / (1.0 + strain.abs()).sqrt()


class _Tables:
    """What lies around each vertex of a level, ready for the kernels."""

    def __init__(self, level: Surface) -> None:
        count, device, dtype = len(level.rest), str(level.rest.device), level.rest.dtype
        triangles, edges = level.triangles.cpu().numpy(), level.edges.cpu().numpy()
        (corner_starts, corner), (end_starts, end) = (
            [each.cpu().numpy() for each in incidence(elements, count)] for elements in (level.triangles, level.edges)
        )
        turned = np.take_along_axis(triangles[corner // 3], (corner[:, None] % 3 + [1, 2]) % 3, axis=1).astype(np.int32)
        far = edges[end // 2, 1 - end % 2].astype(np.int32)
        x = vectors(torch.zeros_like(level.rest))
        wide = wp.zeros(count, dtype=wp.types.matrix(shape=(3, 3), dtype=SCALAR[dtype]), device=device)

        def ints(values: np.ndarray, kind: Any = wp.int32) -> wp.array:
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=kind, device=device)

        given = {"device": device, "threads": level.threads}
        lengths = level.rest_length.double().cpu().numpy()[end // 2]
        rest = wp.array(lengths, dtype=SCALAR[dtype], device=device)
        self.mesh = (ints(corner_starts), ints(turned, wp.vec2i), ints(end_starts), ints(far))
        self.normals = Launch(_NORMALS[dtype], count, [*self.mesh[:2], x, x], **given)
        self.strains = Launch(_STRAINS[dtype], count, [*self.mesh[2:], rest, x, wide, x], **given)
        degree = np.diff(end_starts)
        weights = 1.0 / np.repeat(np.maximum(degree, 1), degree)
        mean = sp.csr_matrix((weights, far, end_starts), shape=(count, count))
        self._mean = Stencil(mean, dtype=dtype, **given)
        self._back = Stencil(sp.csr_matrix(mean.T), dtype=dtype, **given)

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


@wp.func
def normal_of(
    i: wp.int32,
    x: wp.array(dtype=Any),
    starts: wp.array(dtype=wp.int32),
    others: wp.array(dtype=wp.vec2i),
):
    """Area-weighted unit normal of a vertex; zero where triangles have no area."""
    total = x[i] - x[i]
    for k in range(starts[i], starts[i + 1]):
        total += wp.cross(x[others[k][0]] - x[i], x[others[k][1]] - x[i])
    return wp.normalize(total)


@wp.kernel
def _normals(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    others: wp.array(dtype=wp.vec2i),
    x: wp.array(dtype=Any),
    out: wp.array(dtype=Any),
):
    i = first + wp.tid()
    out[i] = normal_of(i, x, starts, others)


@wp.func
def squash(a: Any):
    """`squashed` of a number."""
    return a / wp.sqrt(type(a)(1.0) + wp.abs(a))


@wp.kernel
def _strains(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    far: wp.array(dtype=wp.int32),
    rest: wp.array(dtype=Any),
    x: wp.array(dtype=Any),
    matrix: wp.array(dtype=Any),
    seen: wp.array(dtype=Any),
):
    i = first + wp.tid()
    zero = x[0] - x[0]
    total = wp.outer(zero, zero)
    mean = rest.dtype(0.0)
    below = rest.dtype(0.0)
    square = rest.dtype(0.0)
    for k in range(starts[i], starts[i + 1]):
        span = x[far[k]] - x[i]
        length = wp.max(wp.length(span), rest[k] * rest.dtype(1.0e-6))
        e = length / rest[k] - rest.dtype(1.0)
        total += squash(e / rest.dtype(wp.static(STRAIN))) / (length * length) * wp.outer(span, span)
        mean += e
        below += wp.min(e, rest.dtype(0.0))
        square += e * e
    share = rest.dtype(1.0) / rest.dtype(wp.max(starts[i + 1] - starts[i], 1))
    shown = rest.dtype(wp.static(SHOWN))
    matrix[i] = share * total
    v = seen[i]
    v[0] = squash(shown * share * mean)
    v[1] = squash(shown * share * below)
    v[2] = squash(shown * wp.sqrt(square * share + rest.dtype(wp.static(FLOOR))))
    seen[i] = v


def _arrays(t: torch.dtype, kinds: str) -> list[Any]:
    """Types of a kernel's parameters: i integers, p pairs, s scalars, v vectors, m matrices."""
    known: dict[str, Any] = {"i": wp.int32, "p": wp.vec2i, "s": SCALAR[t], "v": VECTOR[t]}
    known["m"] = wp.types.matrix(shape=(3, 3), dtype=SCALAR[t])
    return [wp.int32, *(wp.array(dtype=known[kind]) for kind in kinds)]


_NORMALS, _STRAINS = (
    {t: wp.overload(kernel, _arrays(t, kinds)) for t in VECTOR}
    for kernel, kinds in ((_normals, "ipvv"), (_strains, "iisvmv"))
)
