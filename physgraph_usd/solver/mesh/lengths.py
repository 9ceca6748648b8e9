"""Lengths of edges and normals of triangles, one kernel each: torch would take many passes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from .stencil import SCALAR, VECTOR, overloads, vectors
from .threads import Launch, start_warp

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


@wp.kernel
def _normals(
    first: wp.int32,
    triangles: wp.array(dtype=wp.vec3i),
    x: wp.array(dtype=Any),
    normal: wp.array(dtype=Any),
):
    t = first + wp.tid()
    a = x[triangles[t][0]]
    normal[t] = wp.cross(x[triangles[t][1]] - a, x[triangles[t][2]] - a)


_LENGTHS, _NORMALS = overloads(_lengths, wp.vec2i, VECTOR, SCALAR), overloads(_normals, wp.vec3i, VECTOR, VECTOR)


class EdgeLengths:
    """The lengths of some edges, wherever their vertices are."""

    def __init__(self, edges: Int[Tensor, "edges 2"], like: Float[Tensor, "vertices 3"], *, threads: int = 1) -> None:
        """Prepare the launch.

        Args:
            edges: End vertices, int32.
            like: Any positions, for their type and device.
            threads: Most threads on the CPU.
        """
        self._launch = _Measure(_LENGTHS, edges, like, corners=wp.vec2i, threads=threads)

    def __call__(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " edges"]:
        """The lengths at x [m]."""
        return self._launch(x, x.new_empty(self._launch.count))


class TriangleNormals:
    """The normals of some triangles, twice their areas long, wherever their vertices are."""

    def __init__(
        self, triangles: Int[Tensor, "triangles 3"], like: Float[Tensor, "vertices 3"], *, threads: int = 1
    ) -> None:
        """Prepare the launch; arguments are those of `EdgeLengths`, with corners for ends."""
        self._launch = _Measure(_NORMALS, triangles, like, corners=wp.vec3i, threads=threads)

    def __call__(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "triangles 3"]:
        """The normals at x [m^2]."""
        return self._launch(x, x.new_empty(self._launch.count, 3))


class _Measure:
    """One kernel over elements, launched anew for other positions and another result."""

    def __init__(
        self, kernels: Mapping[torch.dtype, wp.Kernel], elements: Tensor, like: Tensor, *, corners: type, threads: int
    ) -> None:
        start_warp()  # Views of tensors do not start Warp by themselves.
        self.count, self._elements, self._launch = len(elements), elements.contiguous(), None
        if len(elements):  # Empty tensors keep strides that Warp refuses.
            out = like.new_empty(len(elements), *([3] if kernels is _NORMALS else []))
            inputs = [wp.from_torch(self._elements, dtype=corners), vectors(like), _packed(out)]
            self._launch = Launch(kernels[like.dtype], len(elements), inputs, device=str(like.device), threads=threads)

    def __call__(self, x: Tensor, out: Tensor) -> Tensor:
        if self._launch is not None:
            self._launch({1: vectors(x.contiguous()), 2: _packed(out)})
        return out


def _packed(out: Tensor) -> wp.array:
    return vectors(out) if out.ndim == 2 else wp.from_torch(out)
