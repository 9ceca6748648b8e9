"""`Physgraph` as two kernels around a few matrix products, for CUDA.

In torch a step at 26,000 vertices writes some forty arrays. Here one kernel computes normals, neighbour means and
scalar products in a single pass, so values gathered from the neighbours are used while still cached. The layers are
matrix products, and a second kernel combines. A normal part is a number times the normal; its products are computed
from the number. On the CPU `eight_vertices` takes a single kernel.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportCallIssue=false, reportReturnType=false
from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..mesh.kernels import ALONE, KERNELS
from ..mesh.stencil import vectors
from ..mesh.threads import Launch
from .eight_vertices import EightPhysgraph
from .network import (
    LOG_OFFSET,
    LOG_SCALE,
    ZERO_LENGTH,
    Families,
    Pairs,
    Parts,
    Physgraph,
    clock_of,
    counted_families,
    in_rows,
    pairs_in,
)
from .vertex_frame import VertexFrame, normal_of

wp.set_module_options(KERNELS)


class FusedPhysgraph:
    """A network's weights and buffers for a given number of vertices, in float32.

    Attributes:
        bases: Names of the input vectors; the kernels derive the other vectors as parts.
    """

    def __init__(self, network: Physgraph, vertices: int, longest: float, *, device: str, threads: int) -> None:
        """Lay out the weights.

        Args:
            vertices: Number of vertices.
            longest: Longest displacement in local edge lengths.
            device: "cpu" or a CUDA device.
            threads: Most threads that a kernel uses on the CPU.
        """
        names = network.config.vectors
        self.bases, smoothed, parts = in_rows(names)
        self._frames = bool(smoothed) or any(normal for _, normal in parts)
        self._rows = torch.zeros((len(self.bases) + len(smoothed), vertices, 3), device=device)
        self._out = torch.zeros((vertices, 3), device=device)
        layers: list[Any] = [network.encode, *network.hidden, network.decode]
        # Transposed, so that each layer is one product whose rows are vertices.
        self._weights = [layer.weight.detach().T.contiguous() for layer in layers]
        self._biases = [layer.bias.detach().clone() for layer in layers]
        self._biases[-1][0] += 1.0
        self._clock = network.encode_means.weight.detach()[:, 0]
        self._features = torch.zeros((vertices, len(self._weights[0])), device=device)
        self._layers = [torch.zeros((vertices, len(bias)), device=device) for bias in self._biases]
        flat, spacing = vectors(self._rows.reshape(-1, 3)), wp.zeros(vertices, dtype=wp.float32, device=device)
        normal = wp.zeros(vertices if self._frames else 1, dtype=wp.vec3f, device=device)
        x, others, number = (wp.zeros(1, dtype=kind, device=device) for kind in (wp.vec3f, wp.vec2i, wp.int32))
        shared, place = [vertices, flat, spacing, normal], {"device": device, "threads": threads}
        pairs, families = pairs_in(names), counted_families(names)
        mesh = [x, number, others, number, number]
        see = seeing(parts, pairs, smoothed, families)
        self._see = Launch(see, vertices, [*shared, *mesh, wp.from_torch(self._features)], **place)
        ends = [wp.from_torch(self._layers[-1]), longest, vectors(self._out)]
        self._combine = Launch(combining(parts), vertices, [*shared, *ends], **place)
        self._mesh: object = None
        self._spacing: Tensor | None = None
        self._reach: Tensor | None = None

    def __call__(
        self,
        bases: Sequence[Float[Tensor, "vertices 3"]],
        spacing: Float[Tensor, " vertices"],
        reach: Float[Tensor, " vertices"],
        step: int,
        *,
        frame: Callable[[], VertexFrame],
    ) -> Float[Tensor, "vertices 3"]:
        """The displacement [m], limited to the longest allowed.

        Args:
            bases: The vectors named by `bases` [m].
            spacing: Mean rest edge at each vertex [m].
            reach: The spacing, and 0 at fixed vertices [m].
            step: Number of previous steps.
            frame: Gives the surroundings of the vertices; called only if parts need them.
        """
        torch.stack(list(bases), out=self._rows[: len(self.bases)])
        changed = {}
        if self._spacing is not spacing:
            self._spacing, changed[2] = spacing, wp.from_torch(spacing, requires_grad=False)
        if self._reach is not reach:
            self._reach = reach
            self._combine.change({2: wp.from_torch(reach, requires_grad=False)})
        if self._frames:
            surface = frame()
            changed[4] = surface.positions
            if self._mesh is not surface.mesh:
                self._mesh = surface.mesh
                changed |= dict(enumerate(surface.mesh, start=5))
        self._see(changed)
        h = self._features
        biases = [self._biases[0] + self._clock * clock_of(step), *self._biases[1:]]
        for place, (bias, weight, out) in enumerate(zip(biases, self._weights, self._layers, strict=True)):
            h = torch.addmm(bias, h.relu_() if place else h, weight, out=out)
        self._combine({})
        return self._out.clone()


@functools.lru_cache(maxsize=8)
def fused_physgraph(
    network: Physgraph, vertices: int, longest: float, *, device: str, threads: int
) -> FusedPhysgraph | EightPhysgraph:
    """The kernels for a device, reused in the next frame; the network's weights must stay constant."""
    if device == "cpu":
        return EightPhysgraph(network, vertices, longest, threads=threads)
    return FusedPhysgraph(network, vertices, longest, device=device, threads=threads)


@functools.cache
def seeing(parts: Parts, pairs: Pairs, smoothed: tuple[int, ...], families: Families) -> wp.Kernel:
    """The kernel computing the normal, the neighbours' means and the features of each vertex.

    Args:
        parts: Row of each vector, and whether the vector is the normal part of the row.
        pairs: Pairs of vectors with products as features.
        smoothed: Rows with neighbour means in the last rows.
        families: Family of each vector, whose mean square normalises the products, and whether the vector counts in the
            mean.
    """
    # Warp's kernel hash misses some values captured by generic functions; the kernel's name includes them.
    made = hashlib.sha256(repr((parts, pairs, smoothed, families)).encode()).hexdigest()[:16]
    measure, compare = _measuring(1 + max(row for row, _ in parts), smoothed), _comparing(parts, families)
    show = _showing(parts, pairs, 1 + max(families)[0])

    @wp.kernel(name=f"see_{made}", **ALONE)
    def see(
        first: wp.int32,
        vertices: wp.int32,
        v: wp.array(dtype=wp.vec3f),
        spacing: wp.array(dtype=wp.float32),
        normal: wp.array(dtype=wp.vec3f),
        x: wp.array(dtype=wp.vec3f),
        corners: wp.array(dtype=wp.int32),
        others: wp.array(dtype=wp.vec2i),
        ends: wp.array(dtype=wp.int32),
        far: wp.array(dtype=wp.int32),
        features: wp.array(dtype=wp.float32, ndim=2),
    ):
        i = first + wp.tid()
        across = wp.vec3f()
        if wp.static(any(is_normal for _, is_normal in parts)):
            across = normal_of(i, x, corners, others)
            normal[i] = across
        near = measure(i, vertices, ends, far, v, spacing)
        unit, size = compare(near, across)
        show(i, unit, size, across, features)

    return see


def _measuring(rows: int, smoothed: tuple[int, ...]) -> Any:
    """The function computing a vertex's rows in local edges and writing its neighbour means."""
    table = wp.types.matrix(shape=(rows, 3), dtype=wp.float32)
    means = wp.types.matrix(shape=(max(len(smoothed), 1), 3), dtype=wp.float32)
    wholes = rows - len(smoothed)

    @wp.func
    def measure(
        i: wp.int32,
        vertices: wp.int32,
        ends: wp.array(dtype=wp.int32),
        far: wp.array(dtype=wp.int32),
        v: wp.array(dtype=wp.vec3f),
        spacing: wp.array(dtype=wp.float32),
    ):
        near, total = table(), means()
        scale = wp.float32(1.0) / spacing[i]
        if wp.static(len(smoothed) > 0):
            for k in range(ends[i], ends[i + 1]):
                j = far[k]
                for s in range(wp.static(len(smoothed))):
                    total[s] += v[wp.static(smoothed[s]) * vertices + j]
            part = wp.float32(1.0) / wp.float32(wp.max(ends[i + 1] - ends[i], 1))
            for s in range(wp.static(len(smoothed))):
                v[wp.static(wholes + s) * vertices + i] = part * total[s]
        for u in range(wp.static(rows)):
            near[u] = scale * v[u * vertices + i]
        return near

    return measure


def _comparing(parts: Parts, families: Families) -> Any:
    """The function dividing rows by the root mean square of their family's vectors, and returning the mean squares."""
    kinds, rows = 1 + max(family for family, _ in families), 1 + max(row for row, _ in parts)
    table = wp.types.matrix(shape=(rows, 3), dtype=wp.float32)
    column = wp.types.vector(length=kinds, dtype=wp.float32)
    family_of = {row: family for (row, _), (family, _) in reversed(tuple(zip(parts, families, strict=True)))}
    of = tuple(family_of.get(row, 0) for row in range(rows))
    counts = tuple(a for a, (_, counts) in enumerate(families) if counts)
    inverse_count = tuple(1.0 / sum(families[a][0] == kind for a in counts) for kind in range(kinds))

    @wp.func
    def compare(near: Any, across: wp.vec3f):
        unit, size, inverse = table(), column(), column()
        for k in range(wp.static(len(counts))):
            w = near[wp.static(parts[counts[k]][0])]
            if wp.static(parts[counts[k]][1]):
                w = wp.dot(w, across) * across
            size[wp.static(families[counts[k]][0])] += wp.dot(w, w)
        for k in range(wp.static(kinds)):
            size[k] = wp.float32(wp.static(inverse_count[k])) * size[k] + wp.float32(wp.static(ZERO_LENGTH**2))
            inverse[k] = wp.float32(1.0) / wp.sqrt(size[k])
        for u in range(wp.static(rows)):
            unit[u] = inverse[wp.static(of[u])] * near[u]
        return unit, size

    return compare


def _showing(parts: Parts, pairs: Pairs, kinds: int) -> Any:
    """The function writing the network's features of a vertex: squares, products, logarithms of the mean squares."""
    every = wp.types.vector(length=len(parts), dtype=wp.float32)
    terms = (*((a, a) for a in range(len(parts))), *pairs)

    @wp.func
    def show(i: wp.int32, unit: Any, size: Any, across: wp.vec3f, features: wp.array(dtype=wp.float32, ndim=2)):
        height = every()
        for a in range(wp.static(len(parts))):
            if wp.static(parts[a][1]):
                height[a] = wp.dot(unit[wp.static(parts[a][0])], across)
        for p in range(wp.static(len(terms))):
            a, b = wp.static(terms[p][0]), wp.static(terms[p][1])
            if wp.static(parts[terms[p][0]][1] and parts[terms[p][1]][1]):
                product = height[a] * height[b]
            elif wp.static(parts[terms[p][0]][1]):
                product = height[a] * wp.dot(unit[wp.static(parts[terms[p][1]][0])], across)
            elif wp.static(parts[terms[p][1]][1]):
                product = height[b] * wp.dot(unit[wp.static(parts[terms[p][0]][0])], across)
            else:
                product = wp.dot(unit[wp.static(parts[terms[p][0]][0])], unit[wp.static(parts[terms[p][1]][0])])
            features[i, p] = product
        for k in range(wp.static(kinds)):
            features[i, wp.static(len(terms)) + k] = wp.float32(wp.static(LOG_SCALE)) * wp.log(size[k]) + wp.float32(
                wp.static(LOG_OFFSET)
            )

    return show


@functools.cache
def combining(parts: Parts) -> wp.Kernel:
    """The kernel combining the vectors, given as rows and normal parts."""

    @wp.kernel(**ALONE)
    def combine(
        first: wp.int32,
        vertices: wp.int32,
        v: wp.array(dtype=wp.vec3f),
        reach: wp.array(dtype=wp.float32),
        normal: wp.array(dtype=wp.vec3f),
        coefficients: wp.array(dtype=wp.float32, ndim=2),
        longest: wp.float32,
        out: wp.array(dtype=wp.vec3f),
    ):
        i = first + wp.tid()
        move, across = wp.vec3f(), wp.vec3f()
        lift = wp.float32(0.0)
        if wp.static(any(is_normal for _, is_normal in parts)):
            across = normal[i]
        for a in range(wp.static(len(parts))):
            s = v[wp.static(parts[a][0]) * vertices + i]
            if wp.static(parts[a][1]):
                lift += coefficients[i, a] * wp.dot(s, across)
            else:
                move += coefficients[i, a] * s
        move += lift * across
        far, most = wp.length(move), longest * reach[i]
        if far > most:
            move = move * (most / far)
        out[i] = move

    return combine
