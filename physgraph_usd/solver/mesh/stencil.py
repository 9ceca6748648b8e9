"""A sparse linear map on vertex arrays, applied on CPU or CUDA by one gather per row.

Gathering keeps the order of each sum fixed, so a run repeats bit for bit on either device.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from .formula import QUAD, SCALAR, VECTOR, kernel, native, one_by_one
from .threads import Launch, argument


def _gather_kernel(dtype: torch.dtype) -> wp.Kernel:
    """The kernel of (first, starts, columns, values, x, out) multiplying a row of a sparse matrix and vectors."""

    def of_row(row, starts, columns, values, x, out): ...

    def gather(first, starts, columns, values, x, out):
        multiply(first + wp.tid(), starts, columns, values, x, out)

    source = """
    Four total = {};
    for (int k = starts.data[row]; k < starts.data[row + 1]; ++k) {
        const Four part = three(x.data[columns.data[k]]) * values.data[k];
        total += part;
    }
    for (int i = 0; i < 3; ++i) out.data[row][i] = total[i];
    """
    vector = VECTOR[dtype]
    kinds = [wp.array(dtype=kind) for kind in (wp.int32, wp.int32, SCALAR[dtype], vector, vector)]
    name = f"gather_rows_{SCALAR[dtype].__name__}"
    multiply = native(of_row, name, one_by_one(source, dtype), *kinds)
    return kernel(gather, name, *kinds)


_GATHER = {dtype: _gather_kernel(dtype) for dtype in VECTOR}


def three_columns(values: Shaped[Tensor, " rows"]) -> Shaped[Tensor, "rows 3"]:
    """Values repeated in three columns: broadcasting a column in a product takes ten times the product's time."""
    return values.unsqueeze(1).expand(-1, 3).contiguous()


def vectors(tensor: Tensor) -> Any:
    """A kernel's view of a contiguous (N, 3) or (N, 4) tensor as N vectors, without a copy."""
    kind = (VECTOR if tensor.shape[1] == 3 else QUAD)[tensor.dtype]
    if not len(tensor):  # Empty tensors keep strides that Warp refuses.
        return wp.empty(0, dtype=kind, device=str(tensor.device))
    return argument(tensor, kind)


def add_at(total: Tensor, indices: Int[Tensor, " items"], values: Tensor) -> Tensor:
    """Add values in place at first indices, possibly repeated, in the same order on every run; returns ``total``.

    The order, and thus the rounding, of `index_add_` changes from run to run on CUDA; that of `index_put_` does on
    several threads of a CPU.
    """
    if total.is_cuda:
        return total.index_put_((indices,), values, accumulate=True)
    return total.index_add_(0, indices, values)


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
        self.matrix, self._dtype, self._device, self._threads = csr, dtype, device, threads
        self.shape: tuple[int, int] = (csr.shape[0], csr.shape[1])
        self._empty = 0 in self.shape
        starts = wp.array(csr.indptr.astype(np.int32), dtype=wp.int32, device=device)
        columns = wp.array(csr.indices.astype(np.int32), dtype=wp.int32, device=device)
        values = wp.array(csr.data, dtype=SCALAR[dtype], device=device)
        x, out = (wp.zeros(count, dtype=VECTOR[dtype], device=device) for count in reversed(self.shape))
        inputs = [starts, columns, values, x, out]
        self._launch = Launch(_GATHER[dtype], self.shape[0], inputs, device=device, threads=threads)

    def alike(self, matrix: sp.csr_matrix) -> Stencil:
        """Another matrix, of equal type and on the same device."""
        return Stencil(matrix, dtype=self._dtype, device=self._device, threads=self._threads)

    @cached_property
    def transposed(self) -> Stencil:
        """The transposed matrix."""
        return self.alike(sp.csr_matrix(self.matrix.T))

    def apply(self, x: Float[Tensor, "columns 3"]) -> Float[Tensor, "rows 3"]:
        """The matrix times x."""
        out = torch.empty((self.shape[0], 3), dtype=x.dtype, device=x.device)
        if self._empty:
            return out.zero_()
        self._launch({3: x, 4: out})
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
