"""Lengths of edges, normals of triangles and folds of hinges, one kernel each: torch would need many passes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from .formula import SCALAR, VECTOR
from .kernels import KERNELS, start_warp
from .stencil import vectors
from .threads import Launch

wp.set_module_options(KERNELS)


@wp.kernel
def _lengths(first: wp.int32, edges: wp.array(dtype=wp.vec2i), x: wp.array(dtype=Any), length: wp.array(dtype=Any)):
    e = first + wp.tid()
    length[e] = wp.length(x[edges[e][1]] - x[edges[e][0]])


@wp.kernel
def _normals(first: wp.int32, triangles: wp.array(dtype=wp.vec3i), x: wp.array(dtype=Any), normal: wp.array(dtype=Any)):
    t = first + wp.tid()
    a = x[triangles[t][0]]
    normal[t] = wp.cross(x[triangles[t][1]] - a, x[triangles[t][2]] - a)


@wp.kernel
def _folds(
    first: wp.int32,
    hinges: wp.array(dtype=wp.types.vector(length=6, dtype=wp.int32)),
    x: wp.array(dtype=Any),
    cosine: wp.array(dtype=Any),
):
    h = first + wp.tid()
    i, c = x[hinges[h][0]], hinges[h]
    axis = x[c[1]] - i
    n1, n2 = wp.cross(axis, x[c[2]] - i + x[c[3]] - i), wp.cross(x[c[4]] - i + x[c[5]] - i, axis)
    cosine[h] = wp.dot(n1, n2) / (wp.length(n1) * wp.length(n2))


def _for_both(kernel: Any, corners: Any, kinds: Mapping[torch.dtype, Any]) -> dict[torch.dtype, wp.Kernel]:
    """A generic kernel for float32 and float64."""
    kind = {dtype: [corners, VECTOR[dtype], kinds[dtype]] for dtype in VECTOR}
    return {
        dtype: wp.overload(kernel, [wp.int32, *(wp.array(dtype=element) for element in kind[dtype])]) for dtype in kind
    }


LENGTHS, NORMALS = _for_both(_lengths, wp.vec2i, SCALAR), _for_both(_normals, wp.vec3i, VECTOR)
FOLDS = _for_both(_folds, wp.types.vector(length=6, dtype=wp.int32), SCALAR)
"""Kernels for `ElementValues`: edge lengths [m], normals of twice the triangle's area [m^2], and cosines of the angle
between a hinge's faces; not a number if a face has no area."""


class ElementValues:
    """A value per element, at any vertex positions."""

    def __init__(
        self,
        kernels: Mapping[torch.dtype, wp.Kernel],
        elements: Int[Tensor, "elements corners"],
        like: Float[Tensor, "vertices 3"],
        *,
        shape: tuple[int, ...],
        threads: int = 1,
    ) -> None:
        """Prepare the launch.

        Args:
            kernels: For each scalar type a kernel of (first, elements, x, values).
            elements: Corner vertices, int32.
            like: Any positions, for their type and device.
            shape: Shape of an element's value.
            threads: Most threads on the CPU.
        """
        start_warp()  # Views of tensors do not start Warp by themselves.
        self._shape, self._elements = (len(elements), *shape), elements.contiguous()
        self._launch = None
        if len(elements):  # Empty tensors keep strides that Warp refuses.
            corners = wp.types.vector(length=elements.shape[1], dtype=wp.int32)
            packed = wp.from_torch(self._elements, dtype=corners)
            inputs = [packed, vectors(like), _packed(like.new_empty(self._shape))]
            self._launch = Launch(kernels[like.dtype], len(elements), inputs, device=str(like.device), threads=threads)

    def __call__(self, x: Float[Tensor, "vertices 3"]) -> Tensor:
        """The values at positions x [m], shape (elements, *shape)."""
        out = x.new_empty(self._shape)
        if self._launch is not None:
            self._launch({1: x.contiguous(), 2: out})
        return out


def _packed(out: Tensor) -> Any:
    return vectors(out) if out.ndim == 2 else wp.from_torch(out)
