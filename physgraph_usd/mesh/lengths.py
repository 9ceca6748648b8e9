"""Lengths of edges, by one kernel: in torch each would be gathered, subtracted and squared in passes of their own."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false
from __future__ import annotations

from typing import Any

import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from .lanes import Launch
from .stencil import SCALAR, VECTOR, vectors

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _lengths(
    first: wp.int32,
    edges: wp.array(dtype=wp.vec2i),
    x: wp.array(dtype=Any),
    length: wp.array(dtype=Any),
):
    e = first + wp.tid()
    length[e] = wp.length(x[edges[e][1]] - x[edges[e][0]])


_LENGTHS = {
    dtype: wp.overload(
        _lengths,
        [wp.int32, wp.array(dtype=wp.vec2i), wp.array(dtype=VECTOR[dtype]), wp.array(dtype=SCALAR[dtype])],
    )
    for dtype in VECTOR
}


class EdgeLengths:
    """The lengths of some edges, wherever their vertices are."""

    def __init__(self, edges: Int[Tensor, "edges 2"], like: Float[Tensor, "vertices 3"], *, lanes: int = 1) -> None:
        """Prepare the launch.

        Args:
            edges: End vertices, int32.
            like: Any positions, for their type and device.
            lanes: Most threads on the CPU.
        """
        wp.init()  # Views of tensors do not start Warp by themselves.
        self._ends = edges.contiguous()
        self._launch = None
        if len(edges):  # Empty tensors keep strides that Warp refuses.
            inputs = [
                wp.from_torch(self._ends, dtype=wp.vec2i),
                vectors(like),
                wp.from_torch(like.new_empty(len(edges))),
            ]
            self._launch = Launch(_LENGTHS[like.dtype], len(edges), inputs, device=str(like.device), lanes=lanes)

    def __call__(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " edges"]:
        """The lengths at x [m]."""
        out = x.new_empty(len(self._ends))
        if self._launch is not None:
            self._launch({1: vectors(x.contiguous()), 2: wp.from_torch(out)})
        return out
