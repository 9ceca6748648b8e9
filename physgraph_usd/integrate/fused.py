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

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..mesh.lanes import Launch
from ..mesh.stencil import vectors
from .around import Around
from .features import NORMAL, STRAIN, Parts, seeing
from .network import FLOOR, Physgraph, PhysgraphConfig, clock_of, families, pairs_of

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
        self.bases, self._smoothed, self._parts = in_rows(config.vectors)
        self._kinds = {kind for _, kind in self._parts}
        self._pairs = pairs_of(config).to(device)
        pairs = self._pairs.shape[1]
        self._rows = torch.zeros((len(self.bases) + len(self._smoothed), vertices, 3), device=device)
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
        flat, spacing = vectors(self._rows.reshape(-1, 3)), wp.zeros(vertices, dtype=wp.float32, device=device)
        normal = wp.zeros(vertices if NORMAL in self._kinds else 1, dtype=wp.vec3f, device=device)
        strain, x, others = (wp.zeros(1, dtype=t, device=device) for t in (wp.mat33f, wp.vec3f, wp.vec2i))
        number = wp.zeros(1, dtype=wp.int32, device=device)
        shared = [vertices, flat, spacing, normal, strain]
        given = {"device": device, "lanes": lanes}
        seen = [wp.from_torch(self._squares), wp.from_torch(self._cosines), vectors(self._scaled.reshape(-1, 3))]
        between = tuple((a, b) for a, b in self._pairs.T.tolist())
        shares = tuple(tuple(column) for column in (config.soft**2 * families(config.vectors)).T.tolist())
        see = seeing(self._parts, between, self._smoothed, shares, means=config.means)
        self._see = Launch(see, vertices, [*shared, x, number, others, number, number, *seen], **given)
        self._mesh: object = None
        self._spacing: Tensor | None = None
        ends = [wp.from_torch(self._layers[-1]), longest, vectors(self._out)]
        self._combine = Launch(combining(self._parts), vertices, [*shared, *ends], **given)

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
        torch.stack(list(bases), out=self._rows[: len(self.bases)])
        changed = {}
        if self._spacing is not spacing:
            self._spacing, changed[2] = spacing, wp.from_torch(spacing, requires_grad=False)
        seen = around() if self._kinds & {NORMAL, STRAIN} or self._smoothed or self._config.strain else None
        if seen is not None and STRAIN in self._kinds:
            changed[4] = wp.from_torch(seen.strain, dtype=wp.mat33f)
        self._combine.change(changed)
        if seen is not None:
            changed[5] = seen.positions
            if self._mesh is not seen.mesh:
                self._mesh = seen.mesh
                changed |= dict(enumerate(seen.mesh, start=6))
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
        self._combine({})
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


def in_rows(names: Sequence[str]) -> tuple[tuple[str, ...], tuple[int, ...], Parts]:
    """The whole vectors behind vectors of these names, those whose means follow them, and each one's row and part."""
    split = [name.partition(".")[::2] for name in names]
    wholes = tuple(dict.fromkeys(whole for whole, _ in split))
    smoothed = tuple(wholes.index(whole) for whole, part in split if part == "smooth")

    def place(whole: str, part: str) -> tuple[int, int]:
        row = wholes.index(whole)
        if part == "smooth":
            return len(wholes) + smoothed.index(row), 0
        return row, {"normal": NORMAL, "strain": STRAIN}.get(part, 0)

    return wholes, smoothed, tuple(place(*each) for each in split)


@functools.cache
def combining(parts: Parts) -> wp.Kernel:
    """The kernel that combines vectors of which these are the rows and parts."""
    kinds = {kind for _, kind in parts}

    @wp.kernel(module="unique")
    def combine(
        first: wp.int32,
        vertices: wp.int32,
        v: wp.array(dtype=wp.vec3f),
        spacing: wp.array(dtype=wp.float32),
        normal: wp.array(dtype=wp.vec3f),
        strain: wp.array(dtype=wp.mat33f),
        coefficients: wp.array(dtype=wp.float32, ndim=2),
        longest: wp.float32,
        out: wp.array(dtype=wp.vec3f),
    ):
        i = first + wp.tid()
        move, across, along = wp.vec3f(), wp.vec3f(), wp.mat33f()
        lift = wp.float32(0.0)
        if wp.static(NORMAL in kinds):
            across = normal[i]
        if wp.static(STRAIN in kinds):
            along = strain[i]
        for a in range(wp.static(len(parts))):
            s = v[wp.static(parts[a][0]) * vertices + i]
            if wp.static(parts[a][1] == NORMAL):
                lift += coefficients[a, i] * wp.dot(s, across)
            elif wp.static(parts[a][1] == STRAIN):
                move += coefficients[a, i] * (along * s)
            else:
                move += coefficients[a, i] * s
        move += lift * across
        far, most = wp.length(move), longest * spacing[i]
        if far > most:
            move = move * (most / far)
        out[i] = move

    return combine
