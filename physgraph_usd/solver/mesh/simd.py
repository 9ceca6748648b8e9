"""Kernels computing eight elements at once, on the CPU in single precision.

On a CPU a Warp kernel computes its elements one by one. The same formula on Clang's vectors of eight floats takes a
quarter of the time. Vectors have eight floats on every processor, so that results are equal to the bit also where
registers are longer. CUDA and double precision take the plain kernel beside each formula.

A formula is C++ with these names:

| name | meaning |
|---|---|
| ``Eight`` | a number of each element; operators act on each element |
| ``Vec`` | a 3-vector of each element, with ``dot`` and ``cross`` |
| ``corner(k)`` | positions of the k-th corners [m], a ``Vec`` |
| ``load(parameter0)``, ``load4(parameter0)`` | a parameter: an ``Eight``, or four indexed with [] |
| ``root``, ``larger``, ``rint``, ``fabs`` | functions of an ``Eight`` |
| ``store(energy, {force, ...})`` | writes energies [J], an ``Eight``, and the force on each corner [N], a ``Vec`` |
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

from typing import Any, cast

import warp as wp

from .kernels import ALONE

EIGHT = 8
"""Elements computed at once."""

_NAMES = r"""
typedef float Eight __attribute__((vector_size(32), aligned(4), may_alias));
typedef float Four __attribute__((vector_size(16), aligned(4), may_alias));
struct Vec {
    Eight x, y, z;
    Vec operator+(Vec b) const { return {x + b.x, y + b.y, z + b.z}; }
    Vec operator-(Vec b) const { return {x - b.x, y - b.y, z - b.z}; }
    Vec operator-() const { return {-x, -y, -z}; }
    Vec operator*(Eight s) const { return {x * s, y * s, z * s}; }
};
struct Quad {
    Eight column[4];
    Eight operator[](int i) const { return column[i]; }
};
auto dot = [](Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
auto cross = [](Vec a, Vec b) -> Vec {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
};
auto root = [](Eight a) { return __builtin_elementwise_sqrt(a); };
auto rint = [](Eight a) { return __builtin_elementwise_rint(a); };
auto fabs = [](Eight a) { return __builtin_elementwise_abs(a); };
auto larger = [](Eight a, Eight b) { return a > b ? a : b; };

// Transposes the 4x4 blocks of four vectors: lanes 0-3 and lanes 4-7.
auto transpose = [](const Eight* in, Eight* out) {
    Eight low[2], high[2];
    for (int i = 0; i < 2; ++i) {
        low[i] = __builtin_shufflevector(in[2 * i], in[2 * i + 1], 0, 8, 1, 9, 4, 12, 5, 13);
        high[i] = __builtin_shufflevector(in[2 * i], in[2 * i + 1], 2, 10, 3, 11, 6, 14, 7, 15);
    }
    out[0] = __builtin_shufflevector(low[0], low[1], 0, 1, 8, 9, 4, 5, 12, 13);
    out[1] = __builtin_shufflevector(low[0], low[1], 2, 3, 10, 11, 6, 7, 14, 15);
    out[2] = __builtin_shufflevector(high[0], high[1], 0, 1, 8, 9, 4, 5, 12, 13);
    out[3] = __builtin_shufflevector(high[0], high[1], 2, 3, 10, 11, 6, 7, 14, 15);
};
auto columns = [&](const Four* row) -> Quad {
    Eight half[4];
    for (int i = 0; i < 4; ++i) half[i] = __builtin_shufflevector(row[i], row[i + 4], 0, 1, 2, 3, 4, 5, 6, 7);
    Quad out;
    transpose(half, out.column);
    return out;
};

const int begin = 8 * block, count = energies.shape[0];
const bool whole = begin + 8 <= count;
size_t element[8];  // The last block repeats the last element.
for (int i = 0; i < 8; ++i) element[i] = begin + i < count ? begin + i : count - 1;
constexpr int K = sizeof(*corners.data) / sizeof(int);
auto corner = [&](int k) -> Vec {
    Four row[8];
    for (int i = 0; i < 8; ++i) {
        const float* p = (const float*)(x.data + corners.data[element[i]][k]);
        row[i] = Four{p[0], p[1], p[2], 0.0f};
    }
    Quad c = columns(row);
    return {c[0], c[1], c[2]};
};
auto load = [&](const wp::array_t<float>& array) -> Eight {
    if (whole) return *(const Eight*)(array.data + begin);
    Eight out;
    for (int i = 0; i < 8; ++i) out[i] = array.data[element[i]];
    return out;
};
auto load4 = [&](const auto& array) -> Quad {
    Four row[8];
    for (int i = 0; i < 8; ++i) row[i] = *(const Four*)(array.data + element[i]);
    return columns(row);
};
auto store = [&](Eight energy, const Vec (&force)[K]) {
    if (whole) *(Eight*)(energies.data + begin) = energy;
    else for (int i = 0; i < 8; ++i) energies.data[element[i]] = energy[i];
    for (int c = 0; c < 3 * K; c += 4) {  // Four columns at a time; the last four may overlap.
        const int from = c + 4 <= 3 * K ? c : 3 * K - 4;
        Eight half[4];
        transpose(&force[0].x + from, half);
        for (int i = 0; i < 4; ++i) {
            float *low = (float*)(corner_force.data + K * element[i]) + from;
            float *high = (float*)(corner_force.data + K * element[i + 4]) + from;
            *(Four*)low = __builtin_shufflevector(half[i], half[i], 0, 1, 2, 3);
            *(Four*)high = __builtin_shufflevector(half[i], half[i], 4, 5, 6, 7);
        }
    }
};
"""


def on_cpu(source: str) -> str:
    """Source of a native function; empty on CUDA, which has no such vectors."""
    return f"#ifndef __CUDACC__\n{source}\n#endif\n"


def eight_elements(name: str, formula: str, *, corners: int, parameter: Any = wp.float32) -> wp.Kernel:
    """A kernel of (first, x, corners, parameter0, parameter1, energy, corner_force), all in float32.

    Args:
        name: The kernel's name.
        formula: Energy and forces of eight elements, see this module.
        corners: Corners of an element.
        parameter: Type of both parameters.

    Returns:
        The kernel; an item is a block of `EIGHT` elements.
    """

    def eight(
        block: Any, x: Any, corners: Any, parameter0: Any, parameter1: Any, energies: Any, corner_force: Any
    ) -> None: ...

    def kernel(
        first: Any, x: Any, corners: Any, parameter0: Any, parameter1: Any, energies: Any, corner_force: Any
    ) -> None:
        native(first + wp.tid(), x, corners, parameter0, parameter1, energies, corner_force)

    kinds = (wp.vec3f, wp.types.vector(corners, wp.int32), parameter, parameter, wp.float32, wp.vec3f)
    for each in (eight, kernel):
        each.__annotations__ = dict(
            zip(each.__code__.co_varnames, [wp.int32, *(wp.array(dtype=kind) for kind in kinds)], strict=True)
        )
    eight.__qualname__ = f"{name}_of_eight"
    native = wp.func_native(on_cpu(_NAMES + formula))(eight)
    return cast(wp.Kernel, wp.kernel(kernel, name=name, **ALONE))
