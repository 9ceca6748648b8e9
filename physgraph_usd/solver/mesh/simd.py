"""Kernels computing eight elements at once, on the CPU in single precision.

On a CPU a Warp kernel computes its elements one by one. The same formula on Clang's vectors of eight floats takes a
quarter of the time. Vectors have eight floats on every processor, so that results are equal to the bit also where
registers are longer. CUDA and double precision take the plain kernel beside each formula.

A formula is C++ with these names; the last two only in `eight_elements`:

| name | meaning |
|---|---|
| ``Eight`` | a number of each element; operators act on each element |
| ``Vec`` | a 3-vector of each element, with ``dot`` and ``cross`` |
| ``root``, ``larger``, ``rint``, ``fabs`` | functions of an ``Eight`` |
| ``element[i]`` | index of the i-th element; the last block repeats the last element |
| ``load(array)``, ``load4(array)`` | an ``Eight`` of an array with a number for each element; four, indexed with [] |
| ``vec([&](int i) { return address; })`` | the ``Vec`` with three floats of each element, from any address |
| ``write(to, width, values, n)`` | writes n ``Eight`` values, n > 3, as rows of a table of a given width |
| ``corner(k)`` | positions of the k-th corners [m], a ``Vec`` |
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

const int begin = 8 * block;
const bool whole = begin + 8 <= count;
size_t element[8];
for (int i = 0; i < 8; ++i) element[i] = begin + i < count ? begin + i : count - 1;
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
auto vec = [&](auto address) -> Vec {
    Four row[8];
    for (int i = 0; i < 8; ++i) {
        const float* p = (const float*)address(i);
        row[i] = Four{p[0], p[1], p[2], 0.0f};
    }
    Quad c = columns(row);
    return {c[0], c[1], c[2]};
};
auto write = [&](float* to, int width, const Eight* values, int n) {
    for (int c = 0; c < n; c += 4) {  // Four columns at a time; the last four may overlap.
        const int from = c + 4 <= n ? c : n - 4;
        Eight half[4];
        transpose(values + from, half);
        for (int i = 0; i < 4; ++i) {
            *(Four*)(to + width * element[i] + from) = __builtin_shufflevector(half[i], half[i], 0, 1, 2, 3);
            *(Four*)(to + width * element[i + 4] + from) = __builtin_shufflevector(half[i], half[i], 4, 5, 6, 7);
        }
    }
};
"""
_OF_ELEMENTS = r"""
constexpr int K = sizeof(*corners.data) / sizeof(int);
auto corner = [&](int k) { return vec([&](int i) { return x.data + corners.data[element[i]][k]; }); };
auto store = [&](Eight energy, const Vec (&force)[K]) {
    if (whole) *(Eight*)(energies.data + begin) = energy;
    else for (int i = 0; i < 8; ++i) energies.data[element[i]] = energy[i];
    write((float*)corner_force.data, 3 * K, &force[0].x, 3 * K);
};
"""


FOUR = """
typedef float Four __attribute__((vector_size(16), aligned(4), may_alias));
"""
"""Source of the type of four floats, for sums of vectors."""


def on_cpu(source: str) -> str:
    """Source of a native function; empty on CUDA, which has no such vectors."""
    return f"#ifndef __CUDACC__\n{source}\n#endif\n"


def eight_at_once(formula: str, count: str) -> str:
    """Source of a native function for the elements 8 block to 8 block + 7 of a number of elements, named in C++."""
    return on_cpu(f"const int count = {count};\n{_NAMES}\n{formula}")


def annotate(function: Any, *kinds: Any) -> None:
    """Set the Warp types of a function's parameters, in order."""
    code = function.__code__
    function.__annotations__ = dict(zip(code.co_varnames[: code.co_argcount], kinds, strict=True))


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

    def eight(block, x, corners, parameter0, parameter1, energies, corner_force): ...

    def kernel(first, x, corners, parameter0, parameter1, energies, corner_force):
        native(first + wp.tid(), x, corners, parameter0, parameter1, energies, corner_force)

    kinds = (wp.vec3f, wp.types.vector(corners, wp.int32), parameter, parameter, wp.float32, wp.vec3f)
    for each in (eight, kernel):
        annotate(each, wp.int32, *(wp.array(dtype=kind) for kind in kinds))
    eight.__qualname__ = f"{name}_of_eight"
    native = wp.func_native(eight_at_once(_OF_ELEMENTS + formula, "energies.shape[0]"))(eight)
    return cast(wp.Kernel, wp.kernel(kernel, name=name, **ALONE))
