"""Kernels from one formula in C++ each, for CPU and CUDA, in single and double precision.

On a CPU a Warp kernel computes its elements one by one. The same formula on Clang's vectors of eight numbers takes a
quarter of the time. Vectors have eight numbers on every processor, so that results are equal to the bit also where
registers are longer. On CUDA a thread computes one element.

A formula is C++ with these names; the last two only in `element_kernels`:

| name | meaning |
|---|---|
| ``Scalar``, ``BLOCK`` | type of a number; elements computed at once |
| ``Number`` | a number of each element; operators act on each element |
| ``Vec``, ``Quad`` | a 3-vector of each element, with ``dot`` and ``cross``; four numbers of each, indexed with [] |
| ``Four`` | four numbers of one element, the last one unused in vectors; ``three(vector)``, ``turned``: y, z, x |
| ``root``, ``larger``, ``rint``, ``fabs`` | functions of a `Number` |
| ``each(function, numbers...)`` | a function of scalars, for each element |
| ``element[i]`` | index of the i-th element; the last block repeats the last element |
| ``load(array)``, ``load4(array)`` | a `Number` of an array with a number for each element; a `Quad` |
| ``vec([&](int i) { return address; })`` | the `Vec` with three scalars of each element, from any address |
| ``wide([&](int i) { return address; })`` | likewise, from the address of a `Four` |
| ``logarithm`` | natural logarithm of positive, normal numbers |
| ``put(array, vec)`` | writes a `Vec` to an array of vectors |
| ``corner(k)`` | positions of the k-th corners [m], a `Vec` |
| ``store(energy, {force, ...})`` | writes energies [J], a `Number`, and the force on each corner [N], a `Vec` |
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

from typing import Any, cast

import torch
import warp as wp

from .kernels import ALONE

EIGHT = 8
"""Elements computed at once on a CPU."""
SCALAR = {torch.float32: wp.float32, torch.float64: wp.float64}
"""Warp's scalar for each torch scalar type."""
VECTOR = {torch.float32: wp.vec3f, torch.float64: wp.vec3d}
"""Warp's 3-vector for each torch scalar type."""
QUAD = {torch.float32: wp.vec4f, torch.float64: wp.vec4d}
"""Warp's 4-vector for each torch scalar type."""

_FOUR = """
#ifdef __CUDACC__
struct Four {
    Scalar v[4];
    CUDA_CALLABLE Scalar operator[](int i) const { return v[i]; }
    CUDA_CALLABLE Four operator+(Four b) const { return {v[0] + b[0], v[1] + b[1], v[2] + b[2], v[3] + b[3]}; }
    CUDA_CALLABLE Four operator-(Four b) const { return {v[0] - b[0], v[1] - b[1], v[2] - b[2], v[3] - b[3]}; }
    CUDA_CALLABLE Four operator*(Four b) const { return {v[0] * b[0], v[1] * b[1], v[2] * b[2], v[3] * b[3]}; }
    CUDA_CALLABLE Four operator*(Scalar s) const { return {v[0] * s, v[1] * s, v[2] * s, v[3] * s}; }
    CUDA_CALLABLE void operator+=(Four b) { *this = *this + b; }
    CUDA_CALLABLE void operator*=(Scalar s) { *this = *this * s; }
};
#else
typedef Scalar Four __attribute__((vector_size(4 * sizeof(Scalar)), aligned(sizeof(Scalar)), may_alias));
#endif
auto three = [](const auto& a) { return Four{a[0], a[1], a[2], 0.0f}; };
"""
_TYPES = r"""
struct Vec {
    Number x, y, z;
    CUDA_CALLABLE Vec operator+(Vec b) const { return {x + b.x, y + b.y, z + b.z}; }
    CUDA_CALLABLE Vec operator-(Vec b) const { return {x - b.x, y - b.y, z - b.z}; }
    CUDA_CALLABLE Vec operator-() const { return {-x, -y, -z}; }
    CUDA_CALLABLE Vec operator*(Number s) const { return {x * s, y * s, z * s}; }
};
struct Quad {
    Number column[4];
    CUDA_CALLABLE Number operator[](int i) const { return column[i]; }
};
auto dot = [](Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
auto cross = [](Vec a, Vec b) -> Vec {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
};
auto larger = [](Number a, Number b) { return a > b ? a : b; };
"""
_ON_CUDA = f"""
constexpr int BLOCK = 1;
typedef Scalar Number;
{_TYPES}
auto root = [](Number a) {{ return ::sqrt(a); }};
auto rint = [](Number a) {{ return ::rint(a); }};
auto fabs = [](Number a) {{ return ::fabs(a); }};
auto each = [](auto f, auto... numbers) {{ return f(numbers...); }};
auto turned = [](Four a) {{ return Four{{a[1], a[2], a[0], a[3]}}; }};
const size_t element[1] = {{(size_t)block}};
auto load = [&](const auto& array) {{ return array.data[block]; }};
auto load4 = [&](const auto& array) -> Quad {{
    const auto& a = array.data[block];
    return {{a[0], a[1], a[2], a[3]}};
}};
auto vec = [&](auto address) -> Vec {{
    const Scalar* p = (const Scalar*)address(0);
    return {{p[0], p[1], p[2]}};
}};
auto wide = [&](auto address) -> Vec {{
    const auto& a = *address(0);
    return {{a[0], a[1], a[2]}};
}};
auto logarithm = [](Number a) {{ return wp::log(a); }};
auto write = [&](Scalar* to, int width, const Number* values, int n) {{
    for (int c = 0; c < n; ++c) to[width * block + c] = values[c];
}};
auto put = [&](const auto& array, Vec a) {{ write((Scalar*)array.data, 3, &a.x, 3); }};
"""
_ON_CPU = (
    f"""
constexpr int BLOCK = {EIGHT};
typedef Scalar Number __attribute__((vector_size(BLOCK * sizeof(Scalar)), aligned(sizeof(Scalar)), may_alias));
{_TYPES}"""
    + r"""
auto root = [](Number a) { return __builtin_elementwise_sqrt(a); };
auto rint = [](Number a) { return __builtin_elementwise_rint(a); };
auto fabs = [](Number a) { return __builtin_elementwise_abs(a); };
auto each = [](auto f, auto... numbers) {
    Number out;
    for (int i = 0; i < BLOCK; ++i) out[i] = f(numbers[i]...);
    return out;
};
auto turned = [](Four a) { return __builtin_shufflevector(a, a, 1, 2, 0, 3); };

// Transposes the 4x4 blocks of four vectors: numbers 0-3 and numbers 4-7.
auto transpose = [](const Number* in, Number* out) {
    Number low[2], high[2];
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
    Number half[4];
    for (int i = 0; i < 4; ++i) half[i] = __builtin_shufflevector(row[i], row[i + 4], 0, 1, 2, 3, 4, 5, 6, 7);
    Quad out;
    transpose(half, out.column);
    return out;
};

const int begin = BLOCK * block;
const bool whole = begin + BLOCK <= count;
size_t element[BLOCK];
for (int i = 0; i < BLOCK; ++i) element[i] = begin + i < count ? begin + i : count - 1;
auto load = [&](const auto& array) -> Number {
    if (whole) return *(const Number*)(array.data + begin);
    Number out;
    for (int i = 0; i < BLOCK; ++i) out[i] = array.data[element[i]];
    return out;
};
auto load4 = [&](const auto& array) -> Quad {
    Four row[BLOCK];
    for (int i = 0; i < BLOCK; ++i) row[i] = *(const Four*)(array.data + element[i]);
    return columns(row);
};
auto vec = [&](auto address) -> Vec {
    Four row[BLOCK];
    for (int i = 0; i < BLOCK; ++i) row[i] = three((const Scalar*)address(i));
    Quad c = columns(row);
    return {c[0], c[1], c[2]};
};
auto wide = [&](auto address) -> Vec {
    Four row[BLOCK];
    for (int i = 0; i < BLOCK; ++i) row[i] = *address(i);
    Quad c = columns(row);
    return {c[0], c[1], c[2]};
};
auto logarithm = [&](Number a) -> Number {
    if (sizeof(Scalar) == 8) return each([](Scalar b) { return wp::log(b); }, a);
    // a = 2^power m with m in [1, 2), and ln m = 2 artanh(t), t = (m - 1) / (m + 1), to 2e-6.
    typedef int Bits __attribute__((vector_size(BLOCK * sizeof(int))));
    union { Number number; Bits bits; } whole = {a};
    Bits power = (whole.bits >> 23) - 127;
    whole.bits = (whole.bits & 0x7fffff) | 0x3f800000;
    Number m = whole.number, t = (m - 1.0f) / (m + 1.0f), s = t * t;
    Number series = 1.0f + s * (0.33333333f + s * (0.2f + s * (0.14285714f + s * (0.11111111f + s * 0.09090909f))));
    return __builtin_convertvector(power, Number) * 0.69314718f + 2.0f * t * series;
};
auto write = [&](Scalar* to, int width, const Number* values, int n) {
    for (int c = 0; c < n; c += 4) {  // Four columns at a time; the last four may overlap.
        const int from = c + 4 <= n ? c : n - 4;
        Number half[4];
        transpose(values + from, half);
        for (int i = 0; i < 4; ++i) {
            *(Four*)(to + width * element[i] + from) = __builtin_shufflevector(half[i], half[i], 0, 1, 2, 3);
            *(Four*)(to + width * element[i + 4] + from) = __builtin_shufflevector(half[i], half[i], 4, 5, 6, 7);
        }
    }
};
auto put = [&](const auto& array, Vec a) {
    for (int i = 0; i < BLOCK; ++i) {
        Scalar* to = (Scalar*)(array.data + element[i]);
        to[0] = a.x[i], to[1] = a.y[i], to[2] = a.z[i];
    }
};
"""
)
_OF_ELEMENTS = r"""
constexpr int K = sizeof(*corners.data) / sizeof(int);
auto corner = [&](int k) { return vec([&](int i) { return x.data + corners.data[element[i]][k]; }); };
auto store = [&](Number energy, const Vec (&force)[K]) {
    double total = 0.0;
    for (int i = 0; i < BLOCK && BLOCK * block + i < count; ++i) {  // The last block repeats an element.
        const Scalar value = ((const Scalar*)&energy)[i];
        if (energies.data) energies.data[element[i]] = value;
        total += value;
    }
    sums.data[part] = block == part * blocks ? total : sums.data[part] + total;
#ifdef __CUDACC__
    write((Scalar*)forces.data, 3 * K, &force[0].x, 3 * K);
#else
    for (int k = 0; k < K; ++k) {
        const Number values[4] = {force[k].x, force[k].y, force[k].z, Number{}};
        Number half[4];
        transpose(values, half);
        Four at[BLOCK];
        for (int i = 0; i < 4; ++i) {
            at[i] = __builtin_shufflevector(half[i], half[i], 0, 1, 2, 3);
            at[i + 4] = __builtin_shufflevector(half[i], half[i], 4, 5, 6, 7);
        }
        for (int i = 0; i < BLOCK && BLOCK * block + i < count; ++i)
            ((Four*)forces.data)[part * vertices + corners.data[element[i]][k]] += at[i];
    }
#endif
};
"""


def one_by_one(formula: str, dtype: torch.dtype) -> str:
    """Source of a native function that uses only the names ``Scalar``, ``Four`` and ``three``."""
    scalar = "float" if dtype == torch.float32 else "double"
    return f"typedef {scalar} Scalar;\n{_FOUR}\n{formula}"


def at_once(formula: str, count: str, dtype: torch.dtype) -> str:
    """Source of a native function for the elements of a block; ``count`` is the number of elements, in C++."""
    names = f"#ifdef __CUDACC__\n{_ON_CUDA}\n#else\n{_ON_CPU}\n#endif\n"
    return one_by_one(f"const int count = {count};\n{names}\n{formula}", dtype)


def block_size(device: str) -> int:
    """Number of elements in a block on a device."""
    return EIGHT if device == "cpu" else 1


def native(function: Any, name: str, source: str, *kinds: Any) -> Any:
    """A native function of (number of the item, arrays of given kinds), from an empty Python function and a source."""
    _annotate(function, *kinds)
    function.__qualname__ = f"{name}_of_item"
    return wp.func_native(source)(function)


def kernel(function: Any, name: str, *kinds: Any) -> wp.Kernel:
    """A kernel of (first item, arrays of given kinds) that compiles separately; its name must be unique."""
    _annotate(function, *kinds)
    return cast(wp.Kernel, wp.kernel(function, name=name, **ALONE))


def _annotate(function: Any, *kinds: Any) -> None:
    """Set the Warp types of a function's parameters: an integer, then arrays, or scalars where a kind is one."""
    code = function.__code__
    types = (wp.int32, *kinds)
    function.__annotations__ = dict(zip(code.co_varnames[: code.co_argcount], types, strict=True))


def element_kernels(
    name: str, formula: str, *, corners: int, parameter: dict[torch.dtype, Any]
) -> dict[torch.dtype, wp.Kernel]:
    """Kernels of the energies and forces of elements, for each torch scalar type.

    Their arguments are (first, blocks, all blocks, elements, vertices, x, corners, parameter0, parameter1, energies,
    sums, forces). An item is a part of so many blocks of elements. On a CPU it adds to its own forces on all
    vertices, on CUDA it writes the force on each corner. Energies of single elements are written if there is room.

    Args:
        name: The kernels' name.
        formula: Energy and forces of a block of elements, see this module.
        corners: Corners of an element.
        parameter: Type of both parameters, `SCALAR` or `QUAD`.
    """

    def kernel_of(dtype: torch.dtype) -> wp.Kernel:
        def of_block(
            block, part, blocks, elements, vertices, x, corners, parameter0, parameter1, energies, sums, forces
        ): ...

        def parts(
            first, blocks, all_blocks, elements, vertices, x, corners, parameter0, parameter1, energies, sums, forces
        ):
            part = first + wp.tid()
            for block in range(part * blocks, wp.min((part + 1) * blocks, all_blocks)):
                compute(
                    block, part, blocks, elements, vertices, x, corners, parameter0, parameter1, energies, sums, forces
                )

        vector, number, ends = VECTOR[dtype], parameter[dtype], wp.types.vector(corners, wp.int32)
        arrays = [wp.array(dtype=kind) for kind in (vector, ends, number, number, SCALAR[dtype], wp.float64, vector)]
        full = f"{name}_{SCALAR[dtype].__name__}"
        kinds, source = [*[wp.int32] * 4, *arrays], at_once(_OF_ELEMENTS + formula, "elements", dtype)
        compute = native(of_block, full, source, *kinds)
        return kernel(parts, full, *kinds)

    return {dtype: kernel_of(dtype) for dtype in SCALAR}
