"""The secants of a trained network's steps: fields in a ring of slots, and the L-BFGS direction by coefficients.

The direction of `quasi_newton.secant_direction` is a combination of few fields, with coefficients that depend on scalar
products alone:

    d = gamma H0^-1 F + sum_i a_i z_i + sum_i b_i s_i,   a_i = -gamma alpha_i,   b_i = alpha_i - beta_i

| symbol | here | meaning |
|---|---|---|
| s_i, y_i, z_i | ``fields`` | differences of positions, of negative forces, and of their images under H0^-1 |
| s_i.F, y_i.g, s_i.y_0, y_i.z_0 | `_PRODUCTS` | products with F, its image g and the newest secant |
| s_i.y_j, y_i.z_j | ``gram`` | products of the secants with one another, kept from step to step |
| alpha_i, beta_i | `combine` | the two loops of L-BFGS (Nocedal 1980), on numbers instead of fields |

A pass over all fields costs a fraction of the loops over fields: each field is read once.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false, reportGeneralTypeIssues=false, reportOperatorIssue=false
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..mesh.formula import at_once, kernel, native, one_by_one
from ..mesh.kernels import KERNELS
from ..mesh.threads import Launch, argument, run
from .ahead import STEPS_AHEAD
from .quasi_newton import SECANTS

CHUNK = {"cpu": 1024, "cuda": 64}
"""Vertices per item of the product kernel, by device type."""
SUMS = 4 * SECANTS + 2
"""Scalar products of a pass."""
WEIGHTS = 2 * SECANTS + 1
"""Coefficients of a direction: of g, of the images z and of the moves s, newest first."""

_PRODUCTS = (
    f"constexpr int SECANTS = {SECANTS}, SUMS = {SUMS};"
    """
const int since = 3 * bounds.data[block][0], until = 3 * bounds.data[block][1];
const float *f = (const float*)force.data, *g = (const float*)image.data, *all = (const float*)fields.data;
const size_t size = 3 * (size_t)vertices;
const float *s[SECANTS], *y[SECANTS], *z = all + (2 * slots + newest) * size;
for (int i = 0; i < SECANTS; ++i) {
    const int slot = (newest + slots - (i < secants ? i : 0)) % slots;
    s[i] = all + slot * size, y[i] = all + (slots + slot) * size;
}
Number sum[SUMS] = {};
for (int at = since; at < until; at += BLOCK) {
    auto load = [&](const float* p) -> Number {
        if (at + BLOCK <= until) return *(const Number*)(p + at);
        Number some = {};
        for (int j = 0; at + j < until; ++j) ((float*)&some)[j] = p[at + j];
        return some;
    };
    const Number here = load(f), there = load(g), change = load(y[0]), moved = load(z), step = load(s[0]);
    for (int i = 0; i < SECANTS; ++i) {
        const Number a = load(s[i]), b = load(y[i]);
        sum[4 * i] += a * here, sum[4 * i + 1] += b * there, sum[4 * i + 2] += a * change, sum[4 * i + 3] += b * moved;
    }
    sum[4 * SECANTS] += step * step, sum[4 * SECANTS + 1] += change * change;
}
for (int k = 0; k < SUMS; ++k) {
    double total = 0.0;
    for (int j = 0; j < BLOCK; ++j) total += ((const float*)&sum[k])[j];
    partial.data[block * SUMS + k] = total;
}
"""
)

wp.set_module_options(KERNELS)


def _products_kernel() -> wp.Kernel:
    """The kernel of (first, vertices, slots, newest, secants, bounds, force, image, fields, partial), by chunk."""

    def of_chunk(block, vertices, slots, newest, secants, bounds, force, image, fields, partial): ...

    def secant_products(first, vertices, slots, newest, secants, bounds, force, image, fields, partial):
        add(first + wp.tid(), vertices, slots, newest, secants, bounds, force, image, fields, partial)

    pair, vector, total = (wp.array(dtype=kind) for kind in (wp.vec2i, wp.vec3f, wp.float64))
    kinds = *[wp.int32] * 4, pair, vector, vector, vector, total
    add = native(of_chunk, "secant_products", at_once(_PRODUCTS, "bounds.shape[0]", torch.float32), *kinds)
    return kernel(secant_products, "secant_products", *kinds)


_PRODUCTS_KERNEL = _products_kernel()
_N = wp.constant(SECANTS)
_SUMS = wp.constant(SUMS)
_WEIGHTS = wp.constant(WEIGHTS)


@wp.kernel
def add_up(
    first: wp.int32,
    ends: wp.array(dtype=wp.vec2i),
    partial: wp.array(dtype=wp.float64),
    sums: wp.array(dtype=wp.float64),
):
    """Add up the chunks of a garment for one scalar product, in fixed order."""
    item = first + wp.tid()
    garment, product = item // _SUMS, item % _SUMS
    total = wp.float64(0.0)
    for chunk in range(ends[garment][0], ends[garment][1]):
        total += partial[chunk * _SUMS + product]
    sums[item] = total


@wp.func
def keep_products(
    garment: wp.int32,
    is_new: wp.int32,
    sums: wp.array(dtype=wp.float64),
    before: wp.array(dtype=wp.float64),
    gram: wp.array(dtype=wp.float64),
):
    """Copy the secants' mutual products from the last step, and fill in the row and column of a new secant."""
    size = 2 * _N * _N + _N
    sy, yz, good, s = garment * size, garment * size + _N * _N, (garment + 1) * size - _N, garment * _SUMS
    for i in range(is_new, _N):
        for j in range(is_new, _N):
            gram[sy + i * _N + j] = before[sy + (i - is_new) * _N + j - is_new]
            gram[yz + i * _N + j] = before[yz + (i - is_new) * _N + j - is_new]
        gram[good + i] = before[good + i - is_new]
    if is_new == 1:
        for i in range(_N):
            gram[sy + i * _N] = sums[s + 4 * i + 2]
            gram[yz + i * _N] = sums[s + 4 * i + 3]
            gram[yz + i] = sums[s + 4 * i + 3]
        floor = wp.float64(1e-8) * wp.sqrt(sums[s + 4 * _N] * sums[s + 4 * _N + 1])
        sound = gram[sy] > floor and gram[yz] > wp.float64(0.0)
        gram[good] = wp.where(sound, wp.float64(1.0), wp.float64(0.0))


@wp.kernel
def combine(
    first: wp.int32,
    count: wp.int32,
    is_new: wp.int32,
    sums: wp.array(dtype=wp.float64),
    before: wp.array(dtype=wp.float64),
    gram: wp.array(dtype=wp.float64),
    weights: wp.array(dtype=wp.float32),
):
    """The coefficients of a garment's direction, and the products of its secants with one another.

    Of each garment, ``gram`` has s_i.y_j, then y_i.z_j, for all i and j, newest first; last, whether s_i.y_i is safely
    positive: otherwise the secant has no effect. In the loops the first product of a secant in ``sums`` becomes
    alpha, the second alpha - beta.
    """
    garment = first + wp.tid()
    keep_products(garment, is_new, sums, before, gram)
    size, none = 2 * _N * _N + _N, wp.float64(0.0)
    sy, yz, good, s = garment * size, garment * size + _N * _N, (garment + 1) * size - _N, garment * _SUMS
    gamma = wp.where(gram[good] > none, gram[sy] / gram[yz], wp.float64(1.0))
    for i in range(count):
        residual = sums[s + 4 * i]
        for j in range(i):
            residual -= sums[s + 4 * j] * gram[sy + j + i * _N]
        sums[s + 4 * i] = wp.where(gram[good + i] > none, residual / gram[sy + i * _N + i], none)
    for n in range(count):
        i = count - 1 - n
        along = gamma * sums[s + 4 * i + 1]
        for j in range(count):
            along -= gamma * sums[s + 4 * j] * gram[yz + i * _N + j]
        for j in range(i + 1, count):
            along += sums[s + 4 * j + 1] * gram[sy + j * _N + i]
        rest = sums[s + 4 * i] - along / gram[sy + i * _N + i]
        sums[s + 4 * i + 1] = wp.where(gram[good + i] > none, rest, none)
    w = garment * _WEIGHTS
    weights[w] = wp.float32(gamma)
    for i in range(_N):
        weights[w + 1 + i] = wp.where(i < count, wp.float32(-gamma * sums[s + 4 * i]), wp.float32(0.0))
        weights[w + 1 + _N + i] = wp.where(i < count, wp.float32(sums[s + 4 * i + 1]), wp.float32(0.0))


@dataclass(frozen=True, eq=False)
class Secants:
    """The secants of a carry, and the direction that follows from them and the carry's force.

    Attributes:
        fields: Moves s [m], differences y of negative forces [N], and their images z [m], shape (3, slots, V, 3). All
            carries of a descent share them. The newest secant of a step overwrites the oldest of the ring, so a carry's
            own secants last for as many further steps as there are slots beyond `SECANTS`.
        newest: Slot of the newest secant.
        count: Number of secants.
        gram: Products of the secants with one another, and which have an effect, per garment, float64.
        weights: Coefficients of the direction, shape (garments, `WEIGHTS`).
    """

    fields: Float[Tensor, "3 slots vertices 3"]
    newest: int
    count: int
    gram: Tensor
    weights: Float[Tensor, "garments weights"]

    @staticmethod
    def none(x: Float[Tensor, "vertices 3"], garments: int) -> Secants:
        """No secants: the direction is H0^-1 F."""
        slots = SECANTS + STEPS_AHEAD[x.device.type]
        fields = torch.empty((3, slots, *x.shape), dtype=x.dtype, device=x.device)
        gram = torch.zeros(garments * (2 * SECANTS**2 + SECANTS), dtype=torch.float64, device=x.device)
        weights = torch.zeros((garments, WEIGHTS), dtype=torch.float32, device=x.device)
        weights[:, 0] = 1.0
        return Secants(fields, 0, 0, gram, weights)

    @property
    def slots(self) -> int:
        """Secants that the fields have room for."""
        return self.fields.shape[1]

    def after(self, move: Tensor, forces: tuple[Tensor, Tensor], images: tuple[Tensor, Tensor]) -> Secants:
        """With a newest secant.

        Args:
            move: Displacement [m].
            forces: F before and after [N].
            images: H0^-1 F before and after [m].
        """
        newest = (self.newest + 1) % self.slots
        moves, yields, moved = self.fields[:, newest]
        moves.copy_(move)
        torch.sub(*forces, out=yields)
        torch.sub(*images, out=moved)
        return replace(self, newest=newest, count=min(self.count + 1, SECANTS))


class SecantProducts:
    """Computes the coefficients of directions for garments of given vertices."""

    def __init__(self, spans: tuple[tuple[int, int], ...], *, device: str, threads: int) -> None:
        """Prepare the launches.

        Args:
            spans: First vertex of each garment, and the one after its last.
            device: "cpu" or a CUDA device.
            threads: Most threads used on the CPU.
        """
        size = CHUNK[device.split(":", maxsplit=1)[0]]
        chunks = [[(at, min(at + size, end)) for at in range(begin, end, size)] for begin, end in spans]
        ends = np.cumsum([0, *map(len, chunks)])
        bounds = np.array([chunk for garment in chunks for chunk in garment], np.int32).reshape(-1, 2)
        self._bounds = wp.array(bounds, dtype=wp.vec2i, device=device)
        self._ends = wp.array(np.stack([ends[:-1], ends[1:]], axis=1).astype(np.int32), dtype=wp.vec2i, device=device)
        self._partial = torch.zeros(len(bounds) * SUMS, dtype=torch.float64, device=device)
        self._sums = torch.zeros(len(spans) * SUMS, dtype=torch.float64, device=device)
        vector, total = wp.zeros(1, dtype=wp.vec3f, device=device), argument(self._sums)
        weight = wp.zeros(1, dtype=wp.float32, device=device)
        partial = argument(self._partial)
        inputs = [0, 0, 0, 0, self._bounds, vector, vector, vector, partial]
        self._products = Launch(_PRODUCTS_KERNEL, len(bounds), inputs, device=device, threads=threads)
        inputs = [self._ends, partial, total]
        self._add_up = Launch(add_up, len(self._sums), inputs, device=device, threads=threads)
        inputs = [0, 0, total, total, total, weight]
        self._combine = Launch(combine, len(spans), inputs, device=device, threads=threads)

    def directed(
        self, secants: Secants, force: Float[Tensor, "vertices 3"], image: Float[Tensor, "vertices 3"], *, is_new: bool
    ) -> Secants:
        """The secants with the direction for a force.

        Args:
            secants: Secants with the fields of all, and the products of all but possibly the newest.
            force: F [N].
            image: H0^-1 F [m].
            is_new: Whether the newest secant's products are missing.
        """
        if not secants.count:
            return secants
        fields = secants.fields.view(-1, 3)
        numbers = (len(force), secants.slots, secants.newest, secants.count)
        self._products({**dict(enumerate(numbers)), 5: force, 6: image, 7: fields})
        self._add_up({})
        gram, weights = torch.empty_like(secants.gram), torch.empty_like(secants.weights)
        self._combine(dict(enumerate([secants.count, int(is_new), self._sums, secants.gram, gram, weights.view(-1)])))
        return replace(secants, gram=gram, weights=weights)


_TURN = """
const float* r = (const float*)rotation.data + 9 * vertex;
const Four a = {r[0], r[3], r[6], 0.0f}, b = {r[1], r[4], r[7], 0.0f}, c = {r[2], r[5], r[8], 0.0f};
for (int k = 0; k < count; ++k) {
    const float* from = (const float*)fields.data + 3 * ((size_t)k * vertices + vertex);
    float* to = (float*)out.data + 3 * ((size_t)k * vertices + vertex);
    const Four turned = a * from[0] + b * from[1] + c * from[2];
    for (int i = 0; i < 3; ++i) to[i] = turned[i];
}
"""


def _turn_kernel() -> wp.Kernel:
    """The kernel of (first, vertices, count, rotation, fields, out) turning fields at each vertex."""

    def of_vertex(vertex, vertices, count, rotation, fields, out): ...

    def turn_fields(first, vertices, count, rotation, fields, out):
        turn(first + wp.tid(), vertices, count, rotation, fields, out)

    kinds = wp.int32, wp.int32, *[wp.array(dtype=wp.float32)] * 3
    turn = native(of_vertex, "turn_fields", one_by_one(_TURN, torch.float32), *kinds)
    return kernel(turn_fields, "turn_fields", *kinds)


_TURN_KERNEL = _turn_kernel()


def rotated_fields(
    fields: Float[Tensor, "fields vertices 3"], rotation: Float[Tensor, "vertices 3 3"]
) -> Float[Tensor, "fields vertices 3"]:
    """Fields rotated at each vertex, single precision, shape (N, V, 3)."""
    out, rotation = torch.empty_like(fields), rotation.contiguous()
    arrays = [argument(array.reshape(-1)) for array in (rotation, fields, out)]
    run(_TURN_KERNEL, len(rotation), [len(rotation), len(fields), *arrays], device=str(fields.device))
    return out


@lru_cache(maxsize=16)
def secant_products(spans: tuple[tuple[int, int], ...], *, device: str, threads: int) -> SecantProducts:
    """The launches for garments of given vertices, used again from frame to frame."""
    return SecantProducts(spans, device=device, threads=threads)
