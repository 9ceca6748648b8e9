"""`Physgraph` as a single kernel: features and layers of a vertex stay in the cache or in registers.

In torch a step at 26,000 vertices writes some forty arrays.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..mesh.formula import at_once, block_size, kernel, native
from ..mesh.stencil import vectors
from ..mesh.threads import Launch, argument
from .network import (
    LOG_OFFSET,
    LOG_SCALE,
    ZERO_LENGTH,
    Families,
    Pairs,
    Parts,
    Physgraph,
    PhysgraphConfig,
    clock_of,
    counted_families,
    in_rows,
    pairs_in,
)
from .vertex_frame import VertexFrame

_NORMAL = """
Four area[BLOCK] = {};
for (int i = 0; i < BLOCK; ++i) {
    const int at = element[i];
    const Four here = three(x.data[at]);
    for (int k = corners.data[at]; k < corners.data[at + 1]; ++k) {
        const Four a = three(x.data[others.data[k][0]]) - here, b = three(x.data[others.data[k][1]]) - here;
        area[i] += turned(a * turned(b) - turned(a) * b);
    }
}
across = vec([&](int i) { return &area[i]; });
const Number length = root(dot(across, across));
across = across * (length > 0.0f ? 1.0f / length : Number{});
"""
_MEANS = """
Four mean[MEANS][BLOCK] = {};
for (int i = 0; i < BLOCK; ++i) {
    const int at = element[i], degree = ends.data[at + 1] - ends.data[at];
    for (int k = ends.data[at]; k < ends.data[at + 1]; ++k)
        for (int s = 0; s < MEANS; ++s) mean[s][i] += three(v.data[SMOOTHED[s] * vertices + far.data[k]]);
    for (int s = 0; s < MEANS; ++s) mean[s][i] *= 1.0f / (degree > 1 ? degree : 1);
}
for (int s = 0; s < MEANS; ++s) row[WHOLES + s] = vec([&](int i) { return &mean[s][i]; });
"""
ROW = 8
"""Numbers of a layer computed at once."""
_LAYERS = (
    f"constexpr int ROW = {ROW};"
    """
Number other[WIDEST];
const float *weight = weights.data, *bias = biases.data;
auto layer = [&](const Number* in, int inputs, Number* out, int outputs, bool last) {
    for (int o = 0; o < outputs; o += ROW) {
        Number sum[ROW];
        for (int j = 0; j < ROW; ++j) sum[j] = bias[o + j] + Number{};
        for (int i = 0; i < inputs; ++i)
            for (int j = 0; j < ROW; ++j) sum[j] += in[i] * weight[i * outputs + o + j];
        for (int j = 0; j < ROW; ++j) out[o + j] = last ? sum[j] : (sum[j] < 0.0f ? Number{} : sum[j]);
    }
    weight += inputs * outputs;
    bias += outputs;
};
"""
)
_LIMITED = """
move = move + across * lift;
const Number length_of_move = root(dot(move, move)), most = longest * load(reach);
move = move * (length_of_move > most ? most / length_of_move : 1.0f + Number{});
put(out, move);
"""


class FusedPhysgraph:
    """A network's weights for a given number of vertices.

    Attributes:
        bases: Names of the input vectors; the kernel derives the other vectors as parts.
    """

    def __init__(self, network: Physgraph, vertices: int, longest: float, *, device: str, threads: int) -> None:
        """Lay out the weights.

        Args:
            vertices: Number of vertices.
            longest: Longest displacement in local edge lengths.
            device: "cpu" or a CUDA device; the network is there.
            threads: Most threads that the kernel uses on the CPU.
        """
        self.bases, smoothed, parts = in_rows(network.config.vectors)
        self._frames = bool(smoothed) or any(normal for _, normal in parts)
        self._rows = torch.zeros((len(self.bases), vertices, 3), device=device)
        self._out = torch.zeros((vertices, 3), device=device)
        layers: list[Any] = [network.encode, *network.hidden, network.decode]
        widths = _widths(network.config)
        bias = torch.cat([_padded(layer.bias, to) for layer, to in zip(layers, widths, strict=True)])
        bias[-widths[-1]] += 1.0
        self._bias, self._clock = bias, _padded(network.encode_means.weight[:, 0], len(bias))
        self._biases: dict[int, Tensor] = {}
        inputs = (layers[0].in_features, *widths[:-1])
        sizes = zip(layers, inputs, widths, strict=True)
        self._weights = torch.cat([_padded(layer.weight.T, from_, to).reshape(-1) for layer, from_, to in sizes])
        x, others, number = (wp.zeros(1, dtype=kind, device=device) for kind in (wp.vec3f, wp.vec2i, wp.int32))
        length = wp.zeros(vertices, dtype=wp.float32, device=device)
        places = [vectors(self._rows.reshape(-1, 3)), length, length, x, number, others, number, number]
        learned = [argument(self._weights), argument(self._bias), longest, vectors(self._out)]
        given: dict[str, Any] = {"device": device, "threads": threads, "at_once": block_size(device)}
        self._launch = Launch(fused_kernel(network.config), vertices, [vertices, *places, *learned], **given)

    def __call__(
        self,
        bases: Sequence[Float[Tensor, "vertices 3"]],
        spacing: Float[Tensor, " vertices"],
        reach: Float[Tensor, " vertices"],
        bias: Float[Tensor, " outputs"],
        *,
        frame: Callable[[], VertexFrame],
    ) -> Float[Tensor, "vertices 3"]:
        """The displacement [m], limited to the longest allowed.

        Args:
            bases: The vectors named by `bases` [m].
            spacing: Mean rest edge at each vertex [m].
            reach: The spacing, and 0 at fixed vertices [m].
            bias: As `bias_at` a number of previous steps.
            frame: Gives the surroundings of the vertices; called only if parts need them.
        """
        torch.stack(list(bases), out=self._rows)
        changed = {2: argument(spacing), 3: argument(reach), 10: argument(bias)}
        if self._frames:
            surface = frame()
            changed |= {4: surface.positions} | dict(enumerate(surface.mesh, start=5))
        self._launch(changed)
        return self._out.clone()

    def bias_at(self, step: int) -> Float[Tensor, " outputs"]:
        """The layers' biases after a number of previous steps."""
        if step not in self._biases:
            self._biases[step] = self._bias + self._clock * clock_of(step)
        return self._biases[step]


def _padded(values: Tensor, *shape: int) -> Tensor:
    """A tensor of given shape beginning with the values, 0 after them."""
    out = values.new_zeros(shape)
    out[tuple(map(slice, values.shape))] = values.detach()
    return out


@functools.lru_cache(maxsize=8)
def fused_physgraph(network: Physgraph, vertices: int, longest: float, *, device: str, threads: int) -> FusedPhysgraph:
    """The kernel for a device, reused in the next frame; the network's weights must stay constant."""
    return FusedPhysgraph(network, vertices, longest, device=device, threads=threads)


@functools.cache
def fused_kernel(config: PhysgraphConfig) -> wp.Kernel:
    """The kernel of a network of a given size; an item is a block of vertices."""
    names, name = config.vectors, f"physgraph_{hashlib.sha256(repr(config).encode()).hexdigest()[:16]}"
    (_, smoothed, parts), families = in_rows(names), counted_families(names)
    features = _features(parts, pairs_in(names), families)
    sources = (_rows(parts, smoothed), _units(parts, families), features, _layers(_widths(config)), _combined(parts))
    formula = "".join(line for lines in sources for line in lines)

    def of_block(block, vertices, v, spacing, reach, x, corners, others, ends, far, weights, biases, longest, out): ...

    def physgraph(first, vertices, v, spacing, reach, x, corners, others, ends, far, weights, biases, longest, out):
        block = first + wp.tid()
        compute(block, vertices, v, spacing, reach, x, corners, others, ends, far, weights, biases, longest, out)

    number, index, vector, pair = (wp.array(dtype=kind) for kind in (wp.float32, wp.int32, wp.vec3f, wp.vec2i))
    kinds = (wp.int32, vector, number, number, vector, index, pair, index, index, number, number, wp.float32, vector)
    compute = native(of_block, name, at_once(formula, "vertices", torch.float32), *kinds)
    return kernel(physgraph, name, *kinds)


def _widths(config: PhysgraphConfig) -> tuple[int, ...]:
    """Numbers after each layer, as multiples of `ROW`."""
    return tuple(-(-each // ROW) * ROW for each in (*[config.width] * config.depth, len(config.vectors)))


def _rows(parts: Parts, smoothed: tuple[int, ...]) -> list[str]:
    """Source of the normal ``across``, 0 if no part needs it, and of the vectors ``row`` [m]."""
    rows = 1 + max(row for row, _ in parts)
    wholes = rows - len(smoothed)
    lines = [
        f"Vec across = {{}}, row[{rows}];\n",
        f"for (int u = 0; u < {wholes}; ++u)\n",
        "    row[u] = vec([&](int i) { return v.data + u * vertices + element[i]; });\n",
    ]
    if smoothed:
        sizes = f"constexpr int MEANS = {len(smoothed)}, WHOLES = {wholes};\n"
        lines += [sizes, f"constexpr int SMOOTHED[] = {{{', '.join(map(str, smoothed))}}};\n", _MEANS]
    return [*lines, _NORMAL] if any(is_normal for _, is_normal in parts) else lines


def _layers(widths: tuple[int, ...]) -> list[str]:
    """Source of the layers: from the features ``seen`` to the coefficients ``last``."""
    lines, now, after, inputs = [f"constexpr int WIDEST = {max(widths)};\n", _LAYERS], "seen", "other", "SEEN"
    for place, width in enumerate(widths):
        lines.append(f"layer({now}, {inputs}, {after}, {width}, {str(place + 1 == len(widths)).lower()});\n")
        now, after, inputs = after, ("hidden" if after == "other" else "other"), str(width)
    return [*lines[:1], "Number hidden[WIDEST];\n", *lines[1:], f"const Number* last = {now};\n"]


def _combined(parts: Parts) -> list[str]:
    """Source of the combination of the vectors, limited in length."""
    lines = ["Vec move = {};\nNumber lift = {};\n"]
    for a, (row, normal) in enumerate(parts):
        term = (
            f"lift += last[{a}] * dot(row[{row}], across);\n" if normal else f"move = move + row[{row}] * last[{a}];\n"
        )
        lines.append(term)
    return [*lines, _LIMITED]


def _units(parts: Parts, families: Families) -> list[str]:
    """Source of the mean squares ``size`` and of the rows over the root mean square of their family, ``unit``.

    A row is of the family of its first part, in local edges ``near``.
    """
    rows, kinds = 1 + max(row for row, _ in parts), 1 + max(family for family, _ in families)
    lines = [
        f"Number size[{kinds}], inverse[{kinds}], height[{len(parts)}];\nVec near[{rows}], unit[{rows}];\n",
        f"const Number scale = 1.0f / load(spacing);\nfor (int u = 0; u < {rows}; ++u) near[u] = row[u] * scale;\n",
    ]
    for kind in range(kinds):
        terms = [_square(*part) for part, each in zip(parts, families, strict=True) if each == (kind, True)]
        lines.append(f"size[{kind}] = {1.0 / len(terms)!r}f * ({' + '.join(terms)}) + {ZERO_LENGTH**2!r}f;\n")
        lines.append(f"inverse[{kind}] = 1.0f / root(size[{kind}]);\n")
    family_of = {row: family for (row, _), (family, _) in reversed(tuple(zip(parts, families, strict=True)))}
    lines += [f"unit[{row}] = near[{row}] * inverse[{family_of.get(row, 0)}];\n" for row in range(rows)]
    return lines + [f"height[{a}] = dot(unit[{row}], across);\n" for a, (row, normal) in enumerate(parts) if normal]


def _square(row: int, normal: bool) -> str:
    """Source of the square of a part of a row in local edges."""
    along = f"dot(near[{row}], across)"
    return f"{along} * {along}" if normal else f"dot(near[{row}], near[{row}])"


def _features(parts: Parts, pairs: Pairs, families: Families) -> list[str]:
    """Source of the network's features ``seen``: squares, products, logarithms of the mean squares."""

    def product(a: int, b: int) -> str:
        (p, p_normal), (q, q_normal) = parts[a], parts[b]
        if p_normal and q_normal:
            return f"height[{a}] * height[{b}]"
        if p_normal or q_normal:
            return f"height[{a if p_normal else b}] * dot(unit[{q if p_normal else p}], across)"
        return f"dot(unit[{p}], unit[{q}])"

    terms = [product(a, b) for a, b in (*((a, a) for a in range(len(parts))), *pairs)]
    kinds = 1 + max(family for family, _ in families)
    logarithm = f"{LOG_SCALE!r}f * logarithm(size[%d]) + {LOG_OFFSET!r}f"
    values = ", ".join([*terms, *(logarithm % kind for kind in range(kinds))])
    return [
        "auto logarithm = [&](Number a) { return each([](Scalar b) { return wp::log(b); }, a); };\n",
        f"const Number seen[] = {{{values}}};\n",
        f"constexpr int SEEN = {len(terms) + kinds};\n",
    ]
