"""`Physgraph` without messages as one kernel: features, layers and combination of a vertex never leave the registers.

In torch a step at 26,000 vertices writes some forty arrays; on a CPU that costs several force evaluations. The kernel
does the same arithmetic (`tests/test_learned.py` holds one against the other) and, as every kernel here, runs on CUDA
as it is.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false
from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..mesh.lanes import Launch
from ..mesh.stencil import vectors
from .around import Around
from .network import FLOOR, Physgraph, PhysgraphConfig, clock_of

NORMAL, STRAIN = 1, 2
"""Parts of a vector that the kernel takes itself; 0 is the vector, and means over neighbours are given."""
LOG_SCALE = 0.5 / math.log(10.0)
"""The networks see (log10 + 3) / 2 of a length."""


def can_fuse(config: PhysgraphConfig, dtype: torch.dtype) -> bool:
    """Whether the kernel covers a network: no messages, no strain, no means, two hidden layers, float32."""
    plain = not (config.rounds or config.strain or config.means)
    return plain and config.depth == 2 and dtype == torch.float32


class FusedPhysgraph:
    """A network's weights and buffers for one number of vertices.

    Attributes:
        vertices: That number.
        count: Number of vectors.
        bases: Names of the vectors that are handed over; the others are parts that the kernel takes of them.
    """

    def __init__(self, network: Physgraph, vertices: int, longest: float, *, device: str, lanes: int) -> None:
        """Lay out the weights.

        Args:
            network: A network that `can_fuse` covers.
            vertices: Number of vertices.
            longest: Longest displacement in local edge lengths.
            device: "cpu" or a CUDA device.
            lanes: Most threads that the kernel uses on the CPU.
        """
        config = network.config
        self.vertices, self.count, width = vertices, len(config.vectors), config.width
        self.bases, source, kind = in_bases(config.vectors)
        self._kinds = set(kind)
        self._stack = torch.zeros((len(self.bases), vertices, 3), device=device)
        self._out = torch.zeros((vertices, 3), device=device)
        self._bias, self._clock = network.encode.bias.detach(), network.encode_means.weight.detach()[:, 0]
        self._first = self._bias.clone().reshape(1, width)
        hidden, last = network.hidden[0], network.decode
        start = torch.zeros(self.count, device=device)
        start[0] = 1.0
        tables = [network.encode.weight.T, self._first, hidden.weight.T, hidden.bias, last.weight.T, last.bias + start]
        self._kept = [self._first if t is self._first else t.detach().contiguous().clone() for t in tables]
        kinds = [width, width, width, width, self.count, self.count]
        packed = [
            wp.from_torch(t.reshape(-1, n), dtype=wp.types.vector(length=n, dtype=wp.float32), requires_grad=False)
            for t, n in zip(self._kept, kinds, strict=True)
        ]
        kernel = fused_kernel(self.count, width)
        flat, spacing = vectors(self._stack.reshape(-1, 3)), wp.zeros(vertices, dtype=wp.float32, device=device)
        which = [wp.array(values, dtype=wp.int32, device=device) for values in (source, kind)]
        normal, strain = (wp.zeros(1, dtype=t, device=device) for t in (wp.vec3f, wp.mat33f))
        inputs = [vertices, flat, *which, spacing, longest, normal, strain, *packed, vectors(self._out)]
        self._launch = Launch(kernel, vertices, inputs, device=device, lanes=lanes)

    def __call__(
        self,
        bases: Sequence[Float[Tensor, "vertices 3"]],
        spacing: Float[Tensor, " vertices"],
        step: int | Tensor,
        *,
        around: Callable[[], Around],
    ) -> Float[Tensor, "vertices 3"]:
        """The displacement [m], no longer than allowed; valid until the next call.

        Args:
            bases: The vectors that `bases` names [m].
            spacing: Mean rest edge at each vertex [m].
            step: Number of steps made before, a scalar on the device while steps are recorded.
            around: Gives the surroundings of the vertices; called where parts need them.
        """
        torch.stack(list(bases), out=self._stack)
        if isinstance(step, Tensor):
            torch.addcmul(self._bias, self._clock, clock_of(step), out=self._first[0])
        else:
            torch.add(self._bias, self._clock, alpha=clock_of(step), out=self._first[0])
        changed = {4: wp.from_torch(spacing, requires_grad=False)}
        seen = around() if self._kinds & {NORMAL, STRAIN} else None
        if seen is not None and NORMAL in self._kinds:
            changed[6] = vectors(seen.normal)
        if seen is not None and STRAIN in self._kinds:
            changed[7] = wp.from_torch(seen.strain, dtype=wp.mat33f)
        self._launch(changed)
        return self._out


@functools.lru_cache(maxsize=8)
def fused_physgraph(network: Physgraph, vertices: int, longest: float, *, device: str, lanes: int) -> FusedPhysgraph:
    """The same, kept for the next frame; the network's weights must not change any more."""
    return FusedPhysgraph(network, vertices, longest, device=device, lanes=lanes)


def in_bases(names: Sequence[str]) -> tuple[tuple[str, ...], list[int], list[int]]:
    """The vectors that a kernel must be given for vectors of these names, and for each the base and the part of it."""
    whole = [name if name.endswith(".smooth") else name.partition(".")[0] for name in names]
    bases = tuple(dict.fromkeys(whole))
    kinds = [{"normal": NORMAL, "strain": STRAIN}.get(name.partition(".")[2], 0) for name in names]
    return bases, [bases.index(name) for name in whole], kinds


@wp.func
def part_of(s: wp.vec3f, kind: wp.int32, i: wp.int32, normal: wp.array(dtype=wp.vec3f), strain: wp.array(dtype=Any)):
    """A vector or its part."""
    if kind == wp.static(NORMAL):
        s = normal[i] * wp.dot(s, normal[i])
    if kind == wp.static(STRAIN):
        s = strain[i] * s
    return s


def _encoder(count: int) -> Any:
    """Adds the features' part to the first layer: lengths as logarithms, then cosines of all pairs."""
    floor, log_scale = FLOOR**2, 0.5 * LOG_SCALE

    @wp.func
    def encoded(all: Any, scale: wp.float32, w: Any, start: Any):
        unit = all
        h = start
        for a in range(wp.static(count)):
            s = wp.vec3f(all[a, 0], all[a, 1], all[a, 2]) * scale
            square = wp.dot(s, s) + wp.float32(wp.static(floor))
            h = h + w[a] * (wp.static(log_scale) * wp.log(square) + wp.float32(1.5))
            inverse = wp.float32(1.0) / wp.sqrt(square)
            unit[a, 0] = s[0] * inverse
            unit[a, 1] = s[1] * inverse
            unit[a, 2] = s[2] * inverse
        row = wp.int32(wp.static(count))
        for a in range(wp.static(count)):
            for b in range(a + 1, wp.static(count)):
                cosine = unit[a, 0] * unit[b, 0] + unit[a, 1] * unit[b, 1] + unit[a, 2] * unit[b, 2]
                h = h + w[row] * cosine
                row = row + 1
        return h

    return encoded


def _layer(width: int) -> Any:
    """A layer after a rectifier."""

    @wp.func
    def layer(h: Any, w: Any, start: Any):
        out = start
        for k in range(wp.static(width)):
            out = out + w[k] * wp.max(h[k], wp.float32(0.0))
        return out

    return layer


@functools.cache
def fused_kernel(count: int, width: int) -> wp.Kernel:
    """The kernel for so many vectors and so wide a network; vectors are stored one after another."""
    encoded, layer = _encoder(count), _layer(width)
    rows = wp.types.matrix(shape=(count, 3), dtype=wp.float32)

    @wp.kernel(module="unique")
    def fused(
        first: wp.int32,
        vertices: wp.int32,
        v: wp.array(dtype=Any),
        source: wp.array(dtype=wp.int32),
        kind: wp.array(dtype=wp.int32),
        spacing: wp.array(dtype=wp.float32),
        longest: wp.float32,
        normal: wp.array(dtype=wp.vec3f),
        strain: wp.array(dtype=wp.mat33f),
        w1: wp.array(dtype=Any),
        b1: wp.array(dtype=Any),
        w2: wp.array(dtype=Any),
        b2: wp.array(dtype=Any),
        w3: wp.array(dtype=Any),
        b3: wp.array(dtype=Any),
        out: wp.array(dtype=Any),
    ):
        i = first + wp.tid()
        all = rows()
        for a in range(wp.static(count)):
            s = part_of(v[source[a] * vertices + i], kind[a], i, normal, strain)
            all[a, 0] = s[0]
            all[a, 1] = s[1]
            all[a, 2] = s[2]
        h = encoded(all, wp.float32(1.0) / spacing[i], w1, b1[0])
        c = layer(layer(h, w2, b2[0]), w3, b3[0])
        move = wp.vec3f()
        for a in range(wp.static(count)):
            move = move + wp.vec3f(all[a, 0], all[a, 1], all[a, 2]) * c[a]
        far, most = wp.length(move), longest * spacing[i]
        if far > most:
            move = move * (most / far)
        out[i] = move

    wide, narrow = (wp.array(dtype=wp.types.vector(length=n, dtype=wp.float32)) for n in (width, count))
    space, numbers = wp.array(dtype=wp.vec3f), wp.array(dtype=wp.float32)
    which, tensors = wp.array(dtype=wp.int32), wp.array(dtype=wp.mat33f)
    types = [wp.int32, wp.int32, space, which, which, numbers, wp.float32, space, tensors]
    types += [wide, wide, wide, wide, narrow, narrow, space]
    return wp.overload(fused, types)
