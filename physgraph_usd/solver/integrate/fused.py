"""`Physgraph` as a single kernel: features and layers of a vertex stay in the cache or in registers.

In torch a step at 26,000 vertices writes some forty arrays.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
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
from .secants import SECANTS, WEIGHTS, Secants
from .vertex_frame import VertexFrame

_NORMAL = """
Four area[BLOCK] = {};
for (int i = 0; i < BLOCK; ++i) {
    const int at = element[i];
    const Four here = *row_of(at, POSITION);
    for (int k = corners.data[at]; k < corners.data[at + 1]; ++k) {
        const Four a = *row_of(ring.data[k][0], POSITION) - here, b = *row_of(ring.data[k][1], POSITION) - here;
        area[i] += turned(a * turned(b) - turned(a) * b);
    }
}
across = wide([&](int i) { return &area[i]; });
const Number length = root(dot(across, across));
across = across * (length > 0.0f ? 1.0f / length : Number{});
"""
_MEANS = """
Four mean[MEANS][BLOCK] = {};
for (int i = 0; i < BLOCK; ++i) {
    const int at = element[i], degree = ends.data[at + 1] - ends.data[at];
    for (int k = ends.data[at]; k < ends.data[at + 1]; ++k)
        for (int s = 0; s < MEANS; ++s) mean[s][i] += *row_of(far.data[k], s);
    for (int s = 0; s < MEANS; ++s) mean[s][i] *= 1.0f / (degree > 1 ? degree : 1);
}
for (int s = 0; s < MEANS; ++s) row[WHOLES + s] = wide([&](int i) { return &mean[s][i]; });
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
put(to, wide([&](int i) { return row_of(element[i], POSITION); }) + move);
"""


class FusedPhysgraph:
    """A network's weights for a given number of vertices."""

    def __init__(self, network: Physgraph, vertices: int, longest: float, *, device: str, threads: int) -> None:
        """Lay out the weights.

        Args:
            vertices: Number of vertices.
            longest: Longest displacement in local edge lengths.
            device: "cpu" or a CUDA device; the network is there.
            threads: Most threads that the kernel uses on the CPU.
        """
        layers: list[Any] = [network.encode, *network.hidden, network.decode]
        widths = _widths(network.config)
        bias = torch.cat([_padded(layer.bias, to) for layer, to in zip(layers, widths, strict=True)])
        bias[-widths[-1]] += 1.0
        self._bias, self._clock = bias, _padded(network.encode_means.weight[:, 0], len(bias))
        self._biases: dict[int, Tensor] = {}
        inputs = (layers[0].in_features, *widths[:-1])
        sizes = zip(layers, inputs, widths, strict=True)
        self._weights = torch.cat([_padded(layer.weight.T, from_, to).reshape(-1) for layer, from_, to in sizes])
        self._rows = torch.zeros((vertices * len(_table_rows(network.config.vectors)), 4), device=device)
        none = vectors(torch.zeros((1, 3), device=device))
        number, index, pair = (wp.zeros(1, dtype=kind, device=device) for kind in (wp.float32, wp.int32, wp.vec2i))
        rows, at_once = vectors(self._rows), block_size(device)
        pack, fused = pack_kernel(network.config.vectors), fused_kernel(network.config)
        inputs = [vertices, 0, 0, 0, index, number, number, *[none] * 7, rows]
        self._pack = Launch(pack, vertices, inputs, device=device, threads=threads, at_once=at_once)
        learned = [argument(self._weights), argument(self._bias), longest, none, none]
        inputs = [vertices, rows, number, number, index, pair, index, index, *learned]
        self._launch = Launch(fused, vertices, inputs, device=device, threads=threads, at_once=at_once)

    def __call__(
        self, past: Past, x: Float[Tensor, "vertices 3"], frame: VertexFrame | None
    ) -> tuple[Float[Tensor, "vertices 3"], Float[Tensor, "vertices 3"]]:
        """The displacement, limited to the longest allowed, and the positions after it [m].

        Args:
            past: Sources of the vectors.
            x: Positions [m].
            frame: The surroundings of the vertices; None without a mesh, for networks that need none.
        """
        secants = past.secants
        fields = secants.fields.view(-1, 3)
        packed = [past.garment, secants.weights.view(-1), past.stiffness, fields, x]
        packed += [past.force, past.image, past.force1, past.image1, past.image2]
        self._pack(dict(enumerate([secants.slots, secants.newest, secants.count, *packed], start=1)))
        move, moved = torch.empty_like(x), torch.empty_like(x)
        changed = {2: past.spacing, 3: past.reach, 9: self.bias_at(past.step), 11: move, 12: moved}
        if frame is not None:
            changed |= dict(enumerate(frame.mesh, start=4))
        self._launch(changed)
        return move, moved

    def bias_at(self, step: int) -> Float[Tensor, " outputs"]:
        """The layers' biases after a number of previous steps."""
        if step not in self._biases:
            self._biases[step] = self._bias + self._clock * clock_of(step)
        return self._biases[step]


@dataclass(frozen=True, eq=False)
class Past:
    """Forces, their images, and secants: the sources of a network's vectors.

    Attributes:
        secants: The secants, with the direction for the force.
        force, force1: F now and one step ago [N].
        image, image1, image2: H0^-1 F now, and one and two steps ago [m].
        stiffness: Diagonal of H0 [N/m], shape (V,).
        spacing: Mean rest edge at each vertex [m], shape (V,).
        reach: The spacing, and 0 at fixed vertices [m].
        garment: Number of each vertex's garment, int32, shape (V,).
        step: Number of steps made.
    """

    secants: Secants
    force: Float[Tensor, "vertices 3"]
    force1: Float[Tensor, "vertices 3"]
    image: Float[Tensor, "vertices 3"]
    image1: Float[Tensor, "vertices 3"]
    image2: Float[Tensor, "vertices 3"]
    stiffness: Float[Tensor, " vertices"]
    spacing: Float[Tensor, " vertices"]
    reach: Float[Tensor, " vertices"]
    garment: Int[Tensor, " vertices"]
    step: int


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
    (_, _, parts), families = in_rows(names), counted_families(names)
    features = _features(parts, pairs_in(names), families)
    sources = (_rows(names), _units(parts, families), features, _layers(_widths(config)), _combined(parts))
    formula = "".join(line for lines in sources for line in lines)

    def of_block(
        block, vertices, rows, spacing, reach, corners, ring, ends, far, weights, biases, longest, out, to
    ): ...

    def physgraph(first, vertices, rows, spacing, reach, corners, ring, ends, far, weights, biases, longest, out, to):
        block = first + wp.tid()
        compute(block, vertices, rows, spacing, reach, corners, ring, ends, far, weights, biases, longest, out, to)

    number, index, vector, pair = (wp.array(dtype=kind) for kind in (wp.float32, wp.int32, wp.vec3f, wp.vec2i))
    row = wp.array(dtype=wp.vec4f)
    kinds = (wp.int32, row, number, number, index, pair, index, index, number, number, wp.float32, vector, vector)
    compute = native(of_block, name, at_once(formula, "vertices", torch.float32), *kinds)
    return kernel(physgraph, name, *kinds)


def _table_rows(names: Sequence[str]) -> dict[str, int]:
    """Row of each whole vector, and of the positions "x", in a vertex's table; first those with neighbour means."""
    wholes, smoothed, _ = in_rows(names)
    first = [wholes[index] for index in smoothed]
    return {name: row for row, name in enumerate([*first, "x", *(name for name in wholes if name not in first)])}


_VECTOR_SOURCES = {
    "metric": "at((const float*)g.data, vertex)",
    "metric1": "at((const float*)g1.data, vertex)",
    "metric2": "at((const float*)g2.data, vertex)",
    "diagonal": "at((const float*)f.data, vertex) * soft[i]",
    "diagonal1": "at((const float*)f1.data, vertex) * soft[i]",
    "move1": "secants > 0 ? at(moves[0], vertex) : Four{}",
    "move2": "secants > 1 ? at(moves[1], vertex) : Four{}",
    "secant": "direction(vertex)",
    "x": "at((const float*)x.data, vertex)",
}
_PACK = (
    f"constexpr int SECANTS = {SECANTS}, WEIGHTS = {WEIGHTS};"
    """
const float *moves[SECANTS], *images[SECANTS], *all = (const float*)fields.data;
for (int i = 0; i < SECANTS; ++i) {
    const int slot = (newest + slots - i) % slots;
    moves[i] = all + 3 * (size_t)slot * vertices, images[i] = all + 3 * (size_t)(2 * slots + slot) * vertices;
}
const Number softness = 1.0f / load(stiffness);
const float* soft = (const float*)&softness;
auto at = [&](const float* field, size_t vertex) {  // Four numbers are read where there are as many.
    const float* p = field + 3 * vertex;
    return vertex + 1 < count ? *(const Four*)p : Four{p[0], p[1], p[2], 0.0f};
};
auto direction = [&](size_t vertex) {
    const float* w = weights.data + WEIGHTS * garment.data[vertex];
    Four sum = at((const float*)g.data, vertex) * w[0];
    for (int i = 0; i < secants; ++i)
        sum += at(images[i], vertex) * w[1 + i] + at(moves[i], vertex) * w[1 + SECANTS + i];
    return sum;
};
"""
)


@functools.cache
def pack_kernel(names: tuple[str, ...]) -> wp.Kernel:
    """The kernel that writes each vertex's table of vectors, for networks of given vectors; an item is a block."""
    table = _table_rows(names)
    lines = ["for (int i = 0; i < BLOCK; ++i) {\nconst size_t vertex = element[i];\n"]
    lines += [f"Four* row = (Four*)rows.data + vertex * {len(table)};\n"]
    lines += [f"row[{row}] = {_VECTOR_SOURCES[name]};\n" for name, row in table.items()]
    name = f"pack_{hashlib.sha256(repr(names).encode()).hexdigest()[:16]}"

    def of_block(
        block, vertices, slots, newest, secants, garment, weights, stiffness, fields, x, f, g, f1, g1, g2, rows
    ): ...

    def pack(first, vertices, slots, newest, secants, garment, weights, stiffness, fields, x, f, g, f1, g1, g2, rows):
        block = first + wp.tid()
        write(block, vertices, slots, newest, secants, garment, weights, stiffness, fields, x, f, g, f1, g1, g2, rows)

    number, index, vector = (wp.array(dtype=kind) for kind in (wp.float32, wp.int32, wp.vec3f))
    kinds = (*[wp.int32] * 4, index, number, number, *[vector] * 7, wp.array(dtype=wp.vec4f))
    source = at_once(_PACK + "".join([*lines, "}\n"]), "vertices", torch.float32)
    write = native(of_block, name, source, *kinds)
    return kernel(pack, name, *kinds)


def _widths(config: PhysgraphConfig) -> tuple[int, ...]:
    """Numbers after each layer, as multiples of `ROW`."""
    return tuple(-(-width // ROW) * ROW for width in (*[config.width] * config.depth, len(config.vectors)))


def _rows(names: Sequence[str]) -> list[str]:
    """Source of the normal ``across``, 0 if no part needs it, and of the vectors ``row`` [m]."""
    (wholes, smoothed, parts), table = in_rows(names), _table_rows(names)
    order = ", ".join(str(table[name]) for name in wholes)
    lines = [
        f"constexpr int ROWS = {len(table)}, POSITION = {table['x']}, PLACES[] = {{{order}}};\n",
        "auto row_of = [&](size_t vertex, int row) { return (const Four*)rows.data + vertex * ROWS + row; };\n",
        f"Vec across = {{}}, row[{len(wholes) + len(smoothed)}];\n",
        f"for (int u = 0; u < {len(wholes)}; ++u)\n",
        "    row[u] = wide([&](int i) { return row_of(element[i], PLACES[u]); });\n",
    ]
    if smoothed:
        lines += [f"constexpr int MEANS = {len(smoothed)}, WHOLES = {len(wholes)};\n", _MEANS]
    return [*lines, _NORMAL] if any(is_normal for _, is_normal in parts) else lines


def _layers(widths: tuple[int, ...]) -> list[str]:
    """Source of the layers: from the features ``seen`` to the coefficients ``last``."""
    lines, source, target, inputs = [f"constexpr int WIDEST = {max(widths)};\n", _LAYERS], "seen", "other", "SEEN"
    for number, width in enumerate(widths):
        lines.append(f"layer({source}, {inputs}, {target}, {width}, {str(number + 1 == len(widths)).lower()});\n")
        source, target, inputs = target, ("hidden" if target == "other" else "other"), str(width)
    return [*lines[:1], "Number hidden[WIDEST];\n", *lines[1:], f"const Number* last = {source};\n"]


def _combined(parts: Parts) -> list[str]:
    """Source of the combination of the vectors, limited in length."""
    lines = ["Vec move = {};\nNumber lift = {};\n"]
    for a, (row, normal) in enumerate(parts):
        lift, move = f"lift += last[{a}] * dot(row[{row}], across);\n", f"move = move + row[{row}] * last[{a}];\n"
        lines.append(lift if normal else move)
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
        terms = [_square(*part) for part, family in zip(parts, families, strict=True) if family == (kind, True)]
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
    return [f"const Number seen[] = {{{values}}};\n", f"constexpr int SEEN = {len(terms) + kinds};\n"]
