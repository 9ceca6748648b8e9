"""A sparse linear map on vertex arrays, applied on CPU or CUDA by one gather per row.

Gathering keeps the order of each sum fixed, so a run repeats bit for bit on either device.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, cast

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from .kernels import ALONE, KERNELS
from .simd import FOUR, on_cpu
from .threads import Launch, argument

wp.set_module_options(KERNELS)


@wp.kernel
def _gather_rows(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    values: wp.array(dtype=Any),
    x: wp.array(dtype=Any),
    out: wp.array(dtype=Any),
):
    row = first + wp.tid()
    total = x[0] * values.dtype(0.0)
    for k in range(starts[row], starts[row + 1]):
        total += values[k] * x[columns[k]]
    out[row] = total


@wp.func_native(
    on_cpu(
        FOUR
        + """
    Four total = {};
    for (int k = starts.data[row]; k < starts.data[row + 1]; ++k) {
        const wp::vec3f& at = x.data[columns.data[k]];
        const Four part = Four{at[0], at[1], at[2], 0.0f} * values.data[k];
        total += part;
    }
    out.data[row] = wp::vec3f(total[0], total[1], total[2]);
    """
    )
)
def _sum_row(
    row: wp.int32,
    starts: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    values: wp.array(dtype=wp.float32),
    x: wp.array(dtype=wp.vec3f),
    out: wp.array(dtype=wp.vec3f),
): ...


@wp.kernel(**ALONE)
def _gather_rows_at_once(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    values: wp.array(dtype=wp.float32),
    x: wp.array(dtype=wp.vec3f),
    out: wp.array(dtype=wp.vec3f),
):
    _sum_row(first + wp.tid(), starts, columns, values, x, out)


VECTOR = {torch.float32: wp.vec3f, torch.float64: wp.vec3d}
"""Warp's 3-vector for each torch scalar type."""
QUAD = {torch.float32: wp.vec4f, torch.float64: wp.vec4d}
"""Warp's 4-vector for each torch scalar type."""
SCALAR = {torch.float32: wp.float32, torch.float64: wp.float64}
"""Warp's scalar for each torch scalar type."""


def overloads(kernel: Any, *kinds: Any) -> dict[torch.dtype, wp.Kernel]:
    """A generic kernel of (first, *arrays) for float32 and float64.

    Args:
        kinds: Element type of each array: a type, or `SCALAR` or `VECTOR`.
    """

    def arrays(dtype: torch.dtype) -> list[Any]:
        return [wp.array(dtype=kind[dtype] if isinstance(kind, dict) else kind) for kind in kinds]

    return {dtype: wp.overload(kernel, [wp.int32, *arrays(dtype)]) for dtype in VECTOR}


_GATHER = overloads(_gather_rows, wp.int32, wp.int32, SCALAR, VECTOR, VECTOR)


def three_columns(values: Shaped[Tensor, " rows"]) -> Shaped[Tensor, "rows 3"]:
    """Values repeated in three columns: broadcasting a column in a product takes ten times the product's time."""
    return values.unsqueeze(1).expand(-1, 3).contiguous()


def vectors(tensor: Tensor) -> Any:
    """A kernel's view of a contiguous (N, 3) or (N, 4) tensor as N vectors, without a copy."""
    kind = (VECTOR if tensor.shape[1] == 3 else QUAD)[tensor.dtype]
    if not len(tensor):  # Empty tensors keep strides that Warp refuses.
        return wp.empty(0, dtype=kind, device=str(tensor.device))
    return argument(tensor, kind)


def add_at(total: Tensor, places: Int[Tensor, " items"], values: Tensor) -> Tensor:
    """Add values in place at first indices, possibly repeated, in the same order on every run; returns ``total``.

    On CUDA the order of `index_add_`, and thus its rounding, changes from run to run.
    """
    if total.is_cuda:
        return total.index_put_((places,), values, accumulate=True)
    return total.index_add_(0, places, values)


class Stencil:
    """A sparse matrix from (columns, 3) vertex arrays to (rows, 3) vertex arrays.

    Attributes:
        shape: (rows, columns).
        matrix: The scipy matrix.
    """

    def __init__(self, matrix: sp.csr_matrix, *, dtype: torch.dtype, device: str, threads: int = 1) -> None:
        """Copy a scipy matrix to the device.

        Args:
            matrix: Any scipy sparse matrix, shape (rows, columns).
            dtype: torch.float32 or torch.float64.
            device: "cpu" or a CUDA device.
            threads: Most threads to use on the CPU.
        """
        csr = sp.csr_matrix(matrix)
        csr.sort_indices()
        self.matrix, self._made = csr, {"dtype": dtype, "device": device, "threads": threads}
        self.shape: tuple[int, int] = (csr.shape[0], csr.shape[1])
        self._empty = 0 in self.shape
        starts = wp.array(csr.indptr.astype(np.int32), dtype=wp.int32, device=device)
        columns = wp.array(csr.indices.astype(np.int32), dtype=wp.int32, device=device)
        values = wp.array(csr.data, dtype=SCALAR[dtype], device=device)
        x, out = (wp.zeros(count, dtype=VECTOR[dtype], device=device) for count in reversed(self.shape))
        inputs = [starts, columns, values, x, out]
        single = device == "cpu" and dtype == torch.float32
        gather = cast(wp.Kernel, _gather_rows_at_once) if single else _GATHER[dtype]
        self._launch = Launch(gather, self.shape[0], inputs, device=device, threads=threads)

    def alike(self, matrix: sp.csr_matrix) -> Stencil:
        """Another matrix, of equal type and on the same device."""
        return Stencil(matrix, **self._made)

    @cached_property
    def transposed(self) -> Stencil:
        """The transposed matrix."""
        return self.alike(sp.csr_matrix(self.matrix.T))

    def apply(self, x: Float[Tensor, "columns 3"]) -> Float[Tensor, "rows 3"]:
        """The matrix times x."""
        out = torch.zeros((self.shape[0], 3), dtype=x.dtype, device=x.device)
        if not self._empty:
            self._launch({3: vectors(x), 4: vectors(out)})
        return out


def incidence(
    elements: Int[Tensor, "elements corners"], vertex_count: int
) -> tuple[Int[Tensor, " starts"], Int[Tensor, " slots"]]:
    """List the corners at each vertex, in compressed rows for gathers by vertex.

    Contact makes such rows in every round, therefore sorting runs on the elements' device.

    Args:
        elements: Vertices of each element, shape (N, K).
        vertex_count: Number of vertices V.

    Returns:
        Start of each vertex's row, shape (V + 1,), int32; and element * K + corner of each entry, ascending within a
        row, shape (N K,), int32.
    """
    flat = elements.reshape(-1)
    starts = torch.zeros(vertex_count + 1, dtype=torch.int32, device=elements.device)
    count = torch.zeros_like(starts[1:])
    count.scatter_add_(0, flat.long(), torch.ones_like(count[:1]).expand(len(flat)))  # bincount waits for the device.
    starts[1:] = count.cumsum(dim=0)
    return starts, torch.argsort(flat, stable=True).to(torch.int32)
