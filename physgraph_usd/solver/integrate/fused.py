"""`Physgraph` without messages as two kernels around a few products of matrices.

In torch a step at 26,000 vertices writes some forty arrays; on a CPU that costs several force evaluations. One kernel
takes the parts of the vectors and writes the features, the layers are products of matrices, and a second kernel
combines; `tests/test_learned.py` holds them against `network.Physgraph`. The same code runs on CUDA.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false, reportReturnType=false
from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..mesh.stencil import vectors
from ..mesh.threads import Launch
from .around import Around
from .features import NORMAL, STRAIN, Parts, seeing
from .network import (
    FLOOR,
    LOG_OFFSET,
    LOG_SCALE,
    Physgraph,
    PhysgraphConfig,
    clock_of,
    counted,
    families_of,
    pairs_of,
)

wp.set_module_options({"enable_backward": False})


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

    def __init__(
        self, network: Physgraph, starts: tuple[int, ...], longest: float, *, device: str, threads: int
    ) -> None:
        """Lay out the weights.

        Args:
            network: A network that `can_fuse` covers.
            starts: First vertex of each garment, and the number of vertices.
            longest: Longest displacement in local edge lengths.
            device: "cpu" or a CUDA device.
            threads: Most threads that a kernel uses on the CPU.
        """
        self._config = config = network.config
        self.vertices = vertices = starts[-1]
        self.count = len(config.vectors)
        self._spans = [slice(a, b) for a, b in pairwise(starts)]
        self.bases, self._smoothed, self._parts = in_rows(config.vectors)
        self._kinds = {kind for _, kind in self._parts}
        self._pairs = pairs_of(config).to(device)
        self._rows = torch.zeros((len(self.bases) + len(self._smoothed), vertices, 3), device=device)
        self._out = torch.zeros((vertices, 3), device=device)
        self._scaled = torch.zeros((self.count, vertices if config.means else 1, 3), device=device)
        means = network.encode_means.weight.detach()
        self._clock, self._at_means = means[:, 0], means[:, 1:]
        layers = [network.encode, *network.hidden, network.decode]
        # Turned, so that each layer is one product whose rows are vertices.
        self._weights = [layer.weight.detach().T.contiguous() for layer in layers]  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
        self._biases = [layer.bias.detach().clone() for layer in layers]  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
        self._biases[-1][0] += 1.0
        self._stretches = 3 * config.strain
        self._features = torch.zeros((vertices, len(self._weights[0])), device=device)
        self._layers = [torch.zeros((vertices, len(bias)), device=device) for bias in self._biases]
        flat, spacing = vectors(self._rows.reshape(-1, 3)), wp.zeros(vertices, dtype=wp.float32, device=device)
        normal = wp.zeros(vertices if NORMAL in self._kinds else 1, dtype=wp.vec3f, device=device)
        strain, x, others = (wp.zeros(1, dtype=t, device=device) for t in (wp.mat33f, wp.vec3f, wp.vec2i))
        number = wp.zeros(1, dtype=wp.int32, device=device)
        shared = [vertices, flat, spacing, normal, strain]
        given = {"device": device, "threads": threads}
        seen = [wp.from_torch(self._features), vectors(self._scaled.reshape(-1, 3))]
        between = tuple((a, b) for a, b in self._pairs.T.tolist())
        shares = tuple(zip(families_of(config.vectors), counted(config.vectors), strict=True))
        see = seeing(self._parts, between, self._smoothed, shares, means=config.means)
        self._see = Launch(see, vertices, [*shared, x, number, others, number, number, *seen], **given)
        self._mesh: object = None
        self._spacing: Tensor | None = None
        ends = [wp.from_torch(self._layers[-1]), longest, vectors(self._out)]
        self._reach: Tensor | None = None
        self._combine = Launch(combining(self._parts), vertices, [*shared, *ends], **given)

    def __call__(
        self,
        bases: Sequence[Float[Tensor, "vertices 3"]],
        spacing: Float[Tensor, " vertices"],
        reach: Float[Tensor, " vertices"],
        step: int | Tensor,
        *,
        around: Callable[[], Around],
    ) -> Float[Tensor, "vertices 3"]:
        """The displacement [m], no longer than allowed.

        Args:
            bases: The vectors that `bases` names [m].
            spacing: Mean rest edge at each vertex [m].
            reach: The same, and 0 where a vertex may not move [m].
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
            self._combine.change({4: changed[4]})
        if self._reach is not reach:
            self._reach = reach
            self._combine.change({2: wp.from_torch(reach, requires_grad=False)})
        if seen is not None:
            changed[5] = seen.positions
            if self._mesh is not seen.mesh:
                self._mesh = seen.mesh
                changed |= dict(enumerate(seen.mesh, start=6))
        self._see(changed)
        if seen is not None and self._stretches:
            self._features[:, -self._stretches :] = seen.stretch
        h = self._features
        biases = [self._biases[0] + self._clock * clock_of(step), *self._biases[1:]]
        for place, (bias, weight, out) in enumerate(zip(biases, self._weights, self._layers, strict=True)):
            h = torch.addmm(bias, h.relu_() if place else h, weight, out=out)
            if self._config.means and not place:
                for span in self._spans:
                    h[span] += self._from_means(span)
        self._combine({})
        return self._out.clone()

    def _from_means(self, span: slice) -> Float[Tensor, " width"]:
        """What the first layer takes from a garment's means."""
        flat = self._scaled[:, span].reshape(self.count, -1)
        products = flat @ flat.T / max(span.stop - span.start, 1)
        root = (products.diagonal() + FLOOR**2).sqrt()
        first, second = self._pairs
        cosine = products[first, second] / (root[first] * root[second])
        return self._at_means @ torch.cat([2.0 * LOG_SCALE * root.log() + LOG_OFFSET, cosine])


@functools.lru_cache(maxsize=8)
def fused_physgraph(
    network: Physgraph, starts: tuple[int, ...], longest: float, *, device: str, threads: int
) -> FusedPhysgraph:
    """The same, kept for the next frame; the network's weights must not change any more."""
    return FusedPhysgraph(network, starts, longest, device=device, threads=threads)


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
        reach: wp.array(dtype=wp.float32),
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
                lift += coefficients[i, a] * wp.dot(s, across)
            elif wp.static(parts[a][1] == STRAIN):
                move += coefficients[i, a] * (along * s)
            else:
                move += coefficients[i, a] * s
        move += lift * across
        far, most = wp.length(move), longest * reach[i]
        if far > most:
            move = move * (most / far)
        out[i] = move

    return combine
