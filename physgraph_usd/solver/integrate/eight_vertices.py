"""`Physgraph` as a single kernel for eight vertices at once, on the CPU.

Features and layers stay in the cache: `fused` writes and reads both for CUDA.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..mesh.kernels import ALONE
from ..mesh.simd import EIGHT, annotate, eight_at_once
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
    clock_of,
    counted_families,
    in_rows,
    pairs_in,
)
from .vertex_frame import VertexFrame

_THREE = "auto three = [](const wp::vec3f& a) { return Four{a[0], a[1], a[2], 0.0f}; };\n"
_NORMAL = """
Four area[8] = {};
auto turned = [](Four a) { return __builtin_shufflevector(a, a, 1, 2, 0, 3); };
for (int i = 0; i < 8; ++i) {
    const int at = element[i];
    const Four here = three(x.data[at]);
    for (int k = corners.data[at]; k < corners.data[at + 1]; ++k) {
        const Four a = three(x.data[others.data[k][0]]) - here, b = three(x.data[others.data[k][1]]) - here;
        area[i] += turned(a * turned(b) - turned(a) * b);
    }
}
across = vec([&](int i) { return &area[i]; });
const Eight length = root(dot(across, across));
across = across * (length > 0.0f ? 1.0f / length : Eight{});
"""
_MEANS = """
Four mean[MEANS][8] = {};
for (int i = 0; i < 8; ++i) {
    const int at = element[i], degree = ends.data[at + 1] - ends.data[at];
    for (int k = ends.data[at]; k < ends.data[at + 1]; ++k)
        for (int s = 0; s < MEANS; ++s) mean[s][i] += three(v.data[SMOOTHED[s] * vertices + far.data[k]]);
    for (int s = 0; s < MEANS; ++s) mean[s][i] *= 1.0f / (degree > 1 ? degree : 1);
}
for (int s = 0; s < MEANS; ++s) row[WHOLES + s] = vec([&](int i) { return &mean[s][i]; });
"""
_LAYERS = """
Eight other[WIDEST];
const float *weight = weights.data, *bias = biases.data;
auto layer = [&](const Eight* in, int inputs, Eight* out, int outputs, bool last) {
    for (int o = 0; o < outputs; o += 8) {
        Eight sum[8];
        for (int j = 0; j < 8; ++j) sum[j] = bias[o + j] + Eight{};
        for (int i = 0; i < inputs; ++i)
            for (int j = 0; j < 8; ++j) sum[j] += in[i] * weight[i * outputs + o + j];
        for (int j = 0; j < 8; ++j) out[o + j] = last ? sum[j] : (sum[j] < 0.0f ? Eight{} : sum[j]);
    }
    weight += inputs * outputs;
    bias += outputs;
};
"""
_LIMITED = """
move = move + across * lift;
const Eight length_of_move = root(dot(move, move)), most = longest * load(reach);
move = move * (length_of_move > most ? most / length_of_move : 1.0f + Eight{});
for (int i = 0; i < 8; ++i) out.data[element[i]] = wp::vec3f(move.x[i], move.y[i], move.z[i]);
"""


class EightPhysgraph:
    """A network's weights for a given number of vertices.

    Attributes:
        bases: Names of the input vectors; the kernel derives the other vectors as parts.
    """

    def __init__(self, network: Physgraph, vertices: int, longest: float, *, threads: int) -> None:
        """Lay out the weights.

        Args:
            vertices: Number of vertices.
            longest: Longest displacement in local edge lengths.
            threads: Most threads that the kernel uses.
        """
        names = network.config.vectors
        self.bases, smoothed, parts = in_rows(names)
        self._frames = bool(smoothed) or any(normal for _, normal in parts)
        self._rows = torch.zeros((len(self.bases), vertices, 3))
        self._out = torch.zeros((vertices, 3))
        layers: list[Any] = [network.encode, *network.hidden, network.decode]
        widths = tuple(-(-len(layer.bias) // EIGHT) * EIGHT for layer in layers)
        bias = torch.cat([_padded(layer.bias, to) for layer, to in zip(layers, widths, strict=True)])
        bias[-widths[-1]] += 1.0
        self._bias, self._clock = bias, _padded(network.encode_means.weight[:, 0], len(bias))
        inputs = (layers[0].in_features, *widths[:-1])
        sizes = zip(layers, inputs, widths, strict=True)
        weights = [_padded(layer.weight.T, from_, to).reshape(-1) for layer, from_, to in sizes]
        self._weights = torch.cat(weights)
        families = counted_families(names)
        kernel = eight_physgraph(parts, pairs_in(names), smoothed, families=families, widths=widths)
        x, others, number = (wp.zeros(1, dtype=kind, device="cpu") for kind in (wp.vec3f, wp.vec2i, wp.int32))
        length = wp.zeros(vertices, dtype=wp.float32, device="cpu")
        places = [vectors(self._rows.reshape(-1, 3)), length, length, x, number, others, number, number]
        learned = [argument(self._weights), argument(self._bias), longest, vectors(self._out)]
        given = {"device": "cpu", "threads": threads, "at_once": EIGHT}
        self._launch = Launch(kernel, vertices, [vertices, *places, *learned], **given)

    def __call__(
        self,
        bases: Sequence[Float[Tensor, "vertices 3"]],
        spacing: Float[Tensor, " vertices"],
        reach: Float[Tensor, " vertices"],
        step: int | Tensor,
        *,
        frame: Callable[[], VertexFrame],
    ) -> Float[Tensor, "vertices 3"]:
        """The displacement [m]; arguments as for `FusedPhysgraph`."""
        torch.stack(list(bases), out=self._rows)
        bias = self._bias + self._clock * clock_of(step)
        changed = {2: argument(spacing), 3: argument(reach), 10: argument(bias)}
        if self._frames:
            surface = frame()
            changed |= {4: surface.positions} | dict(enumerate(surface.mesh, start=5))
        self._launch(changed)
        return self._out.clone()


def _padded(values: Tensor, *shape: int) -> Tensor:
    """A tensor of given shape beginning with the values, 0 after them."""
    out = torch.zeros(shape)
    out[tuple(map(slice, values.shape))] = values.detach()
    return out


@functools.cache
def eight_physgraph(
    parts: Parts, pairs: Pairs, smoothed: tuple[int, ...], *, families: Families, widths: tuple[int, ...]
) -> wp.Kernel:
    """The kernel; an item is a block of eight vertices.

    Args:
        parts: Row of each vector, and whether the vector is the normal part of the row.
        pairs: Pairs of vectors with products as features.
        smoothed: Rows with neighbour means in the last rows.
        families: As for `fused.seeing`.
        widths: Numbers after each layer, multiples of eight.
    """
    made = hashlib.sha256(repr((parts, pairs, smoothed, families, widths)).encode()).hexdigest()[:16]
    rows, features = _rows(parts, smoothed), _features(parts, pairs, families)
    formula = "".join([_THREE, *rows, *_units(parts, families), *features, *_layers(widths), *_combined(parts)])

    def eight(block, vertices, v, spacing, reach, x, corners, others, ends, far, weights, biases, longest, out): ...

    def physgraph(first, vertices, v, spacing, reach, x, corners, others, ends, far, weights, biases, longest, out):
        block = first + wp.tid()
        native(block, vertices, v, spacing, reach, x, corners, others, ends, far, weights, biases, longest, out)

    number, index, vector, pair = (wp.array(dtype=kind) for kind in (wp.float32, wp.int32, wp.vec3f, wp.vec2i))
    kinds = (wp.int32, wp.int32, vector, number, number, vector, index, pair, index, index, number, number)
    for each in (eight, physgraph):
        annotate(each, *kinds, wp.float32, vector)
    eight.__qualname__ = f"physgraph_{made}_of_eight"
    native = wp.func_native(eight_at_once(formula, "vertices"))(eight)
    return cast(wp.Kernel, wp.kernel(physgraph, name=f"physgraph_{made}", **ALONE))


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
    return [*lines[:1], "Eight hidden[WIDEST];\n", *lines[1:], f"const Eight* last = {now};\n"]


def _combined(parts: Parts) -> list[str]:
    """Source of the combination of the vectors, limited in length."""
    lines = ["Vec move = {};\nEight lift = {};\n"]
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
        f"Eight size[{kinds}], inverse[{kinds}], height[{len(parts)}];\nVec near[{rows}], unit[{rows}];\n",
        f"const Eight scale = 1.0f / load(spacing);\nfor (int u = 0; u < {rows}; ++u) near[u] = row[u] * scale;\n",
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
        "auto logarithm = [](Eight a) { for (int i = 0; i < 8; ++i) a[i] = wp::log(a[i]); return a; };\n",
        f"const Eight seen[] = {{{values}}};\n",
        f"constexpr int SEEN = {len(terms) + kinds};\n",
    ]
