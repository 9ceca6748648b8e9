"""`Physgraph` without messages as two kernels around a few products of matrices.

In torch a step at 26,000 vertices writes some forty arrays; on a CPU that costs several force evaluations. One kernel
takes the parts of the vectors and writes the features, the layers are products of matrices, and a second kernel
combines; `tests/test_learned.py` holds them against `network.Physgraph`. The same code runs on CUDA.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false, reportReturnType=false
from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..mesh.lanes import Launch
from ..mesh.stencil import vectors
from .around import Around
from .network import FLOOR, Physgraph, PhysgraphConfig, clock_of, pairs_of

NORMAL, STRAIN = 1, 2
"""Parts of a vector that the kernels take themselves; 0 is the vector, and means over neighbours are given."""
LOG_SCALE = 0.5 / math.log(10.0)
LOG_OFFSET = 1.5
"""The networks see (log10 + 3) / 2 of a length."""


def can_fuse(config: PhysgraphConfig, dtype: torch.dtype) -> bool:
    """Whether the kernels cover a network: no messages, float32."""
    return not config.rounds and dtype == torch.float32


class FusedPhysgraph:
    """A network's weights and buffers for one number of vertices.

    Attributes:
        vertices: That number.
        count: Number of vectors.
        bases: Names of the vectors that are handed over; the others are parts that the kernels take of them.
    """

    def __init__(self, network: Physgraph, starts: tuple[int, ...], longest: float, *, device: str, lanes: int) -> None:
        """Lay out the weights.

        Args:
            network: A network that `can_fuse` covers.
            starts: First vertex of each garment, and the number of vertices.
            longest: Longest displacement in local edge lengths.
            device: "cpu" or a CUDA device.
            lanes: Most threads that a kernel uses on the CPU.
        """
        self._config = config = network.config
        self.vertices = vertices = starts[-1]
        self.count = len(config.vectors)
        self._spans = [slice(a, b) for a, b in pairwise(starts)]
        self.bases, source, kind = in_bases(config.vectors)
        self._kinds = set(kind)
        self._pairs = pairs_of(config).to(device)
        pairs = self._pairs.shape[1]
        self._stack = torch.zeros((len(self.bases), vertices, 3), device=device)
        self._squares = torch.zeros((self.count, vertices), device=device)
        self._cosines, self._out = (torch.zeros((vertices, n), device=device) for n in (pairs, 3))
        self._scaled = torch.zeros((self.count, vertices if config.means else 1, 3), device=device)
        self._bias, means = network.encode.bias.detach(), network.encode_means.weight.detach()
        self._clock, self._at_means = means[:, 0], means[:, 1:]
        layers = [network.encode, *network.hidden, network.decode]
        self._weights = [layer.weight.detach().clone() for layer in layers]  # pyright: ignore[reportAttributeAccessIssue]
        self._biases = [layer.bias.detach().clone() for layer in layers]  # pyright: ignore[reportAttributeAccessIssue]
        self._biases[-1][0] += 1.0
        # The features are logarithms of squares as they are: the first layer takes their scale and offset.
        sizes = [self.count, pairs, 3 * config.strain]
        lengths, cosines, self._at_stretch = self._weights.pop(0).split(sizes, dim=1)
        self._bias = self._bias + LOG_OFFSET * lengths.sum(dim=1)
        self._at_lengths, self._at_cosines = 0.5 * LOG_SCALE * lengths, cosines.contiguous()
        self._layers = [torch.zeros((bias.numel(), vertices), device=device) for bias in self._biases]
        which = [wp.array(values, dtype=wp.int32, device=device) for values in (source, kind)]
        flat, spacing = vectors(self._stack.reshape(-1, 3)), wp.zeros(vertices, dtype=wp.float32, device=device)
        normal, strain = (wp.zeros(1, dtype=t, device=device) for t in (wp.vec3f, wp.mat33f))
        shared = [vertices, flat, *which, spacing, normal, strain]
        given = {"device": device, "lanes": lanes}
        seen = [wp.from_torch(self._squares), wp.from_torch(self._cosines), vectors(self._scaled.reshape(-1, 3))]
        between = tuple((a, b) for a, b in self._pairs.T.tolist())
        self._see = Launch(seeing(self.count, between, config.means), vertices, [*shared, *seen], **given)
        ends = [wp.from_torch(self._layers[-1]), longest, vectors(self._out)]
        self._combine = Launch(combining(self.count), vertices, [*shared, *ends], **given)

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
        changed = {4: wp.from_torch(spacing, requires_grad=False)}
        seen = around() if self._kinds & {NORMAL, STRAIN} or self._config.strain else None
        if seen is not None and NORMAL in self._kinds:
            changed[5] = vectors(seen.normal)
        if seen is not None and STRAIN in self._kinds:
            changed[6] = wp.from_torch(seen.strain, dtype=wp.mat33f)
        self._see(changed)
        h = self._layers[0]
        bias = self._bias + self._clock * clock_of(step)
        torch.addmm(bias.unsqueeze(1), self._at_cosines, self._cosines.T, out=h)
        h.addmm_(self._at_lengths, self._squares.log_())
        if seen is not None and self._config.strain:
            h.addmm_(self._at_stretch, seen.stretch.T)
        if self._config.means:
            for span in self._spans:
                h[:, span] += self._from_means(span).unsqueeze(1)
        for bias, weight, out in zip(self._biases[1:], self._weights, self._layers[1:], strict=True):
            h = torch.addmm(bias.unsqueeze(1), weight, h.relu_(), out=out)
        self._combine(changed)
        return self._out

    def _from_means(self, span: slice) -> Float[Tensor, " width"]:
        """What the first layer takes from a garment's means."""
        flat = self._scaled[:, span].reshape(self.count, -1)
        products = flat @ flat.T / max(span.stop - span.start, 1)
        root = (products.diagonal() + FLOOR**2).sqrt()
        first, second = self._pairs
        cosine = products[first, second] / (root[first] * root[second])
        return self._at_means @ torch.cat([LOG_SCALE * root.log() + LOG_OFFSET, cosine])


@functools.lru_cache(maxsize=8)
def fused_physgraph(
    network: Physgraph, starts: tuple[int, ...], longest: float, *, device: str, lanes: int
) -> FusedPhysgraph:
    """The same, kept for the next frame; the network's weights must not change any more."""
    return FusedPhysgraph(network, starts, longest, device=device, lanes=lanes)


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


@functools.cache
def seeing(count: int, pairs: tuple[tuple[int, int], ...], means: bool) -> wp.Kernel:
    """The kernel that finds the features of each vertex.

    Args:
        count: Number of vectors.
        pairs: The vectors between which there are cosines.
        means: Whether it keeps the vectors in local edge lengths, for the garments' means.
    """
    rows = wp.types.matrix(shape=(count, 3), dtype=wp.float32)
    floor = FLOOR**2

    @wp.kernel(module="unique")
    def see(
        first: wp.int32,
        vertices: wp.int32,
        v: wp.array(dtype=wp.vec3f),
        source: wp.array(dtype=wp.int32),
        kind: wp.array(dtype=wp.int32),
        spacing: wp.array(dtype=wp.float32),
        normal: wp.array(dtype=wp.vec3f),
        strain: wp.array(dtype=wp.mat33f),
        squares: wp.array(dtype=wp.float32, ndim=2),
        cosines: wp.array(dtype=wp.float32, ndim=2),
        scaled: wp.array(dtype=wp.vec3f),
    ):
        i = first + wp.tid()
        unit = rows()
        scale = wp.float32(1.0) / spacing[i]
        for a in range(wp.static(count)):
            s = part_of(v[source[a] * vertices + i], kind[a], i, normal, strain) * scale
            if wp.static(means):
                scaled[a * vertices + i] = s
            square = wp.dot(s, s) + wp.float32(wp.static(floor))
            squares[a, i] = square
            s = s * (wp.float32(1.0) / wp.sqrt(square))
            unit[a, 0] = s[0]
            unit[a, 1] = s[1]
            unit[a, 2] = s[2]
        for p in range(wp.static(len(pairs))):
            a, b = wp.static(pairs[p][0]), wp.static(pairs[p][1])
            cosines[i, p] = unit[a, 0] * unit[b, 0] + unit[a, 1] * unit[b, 1] + unit[a, 2] * unit[b, 2]

    return see


@functools.cache
def combining(count: int) -> wp.Kernel:
    """The kernel that combines so many vectors."""

    @wp.kernel(module="unique")
    def combine(
        first: wp.int32,
        vertices: wp.int32,
        v: wp.array(dtype=wp.vec3f),
        source: wp.array(dtype=wp.int32),
        kind: wp.array(dtype=wp.int32),
        spacing: wp.array(dtype=wp.float32),
        normal: wp.array(dtype=wp.vec3f),
        strain: wp.array(dtype=wp.mat33f),
        coefficients: wp.array(dtype=wp.float32, ndim=2),
        longest: wp.float32,
        out: wp.array(dtype=wp.vec3f),
    ):
        i = first + wp.tid()
        move = wp.vec3f()
        for a in range(wp.static(count)):
            move += coefficients[a, i] * part_of(v[source[a] * vertices + i], kind[a], i, normal, strain)
        far, most = wp.length(move), longest * spacing[i]
        if far > most:
            move = move * (most / far)
        out[i] = move

    return combine
