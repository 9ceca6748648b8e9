"""The kernel behind `fused.FusedPhysgraph` that sees: normals, means over the neighbours, lengths and cosines.

One pass over the vertices, so that what a vertex gathers from its neighbours is still at hand when it is used. A normal
part is a number times the normal; its length and cosines come from scalar products with that.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false, reportReturnType=false, reportIndexIssue=false
from __future__ import annotations

import functools
import hashlib
from typing import Any

import warp as wp

from .around import normal_of
from .network import FLOOR

NORMAL, STRAIN = 1, 2
"""Parts of a vector that the kernels take themselves; 0 is a row as it is: a whole vector or its mean."""
Parts = tuple[tuple[int, int], ...]
Pairs = tuple[tuple[int, int], ...]
Shares = tuple[tuple[float, ...], ...]


@functools.cache
def seeing(parts: Parts, pairs: Pairs, smoothed: tuple[int, ...], shares: Shares, *, means: bool) -> wp.Kernel:
    """The kernel that finds the normal, the neighbours' means and the features of each vertex.

    Args:
        parts: Row and part of each vector.
        pairs: The vectors between which there are cosines.
        smoothed: Rows whose means over the neighbours are the last rows.
        shares: For each vector, the shares of all vectors' squared lengths in the least that it shows of its own.
        means: Whether it keeps the vectors in local edge lengths, for the garments' means.
    """
    # Warp's hash of a kernel does not see all values that functions of any type are made with; the name carries them.
    made = hashlib.sha256(repr((parts, pairs, smoothed, shares, means)).encode()).hexdigest()[:16]
    own, place, crosses, wholes = _laid_out(parts, len(smoothed))
    average, measure, soften = _averaging(smoothed, wholes), _measuring(own), _softening(place, shares)
    show = _showing(place, crosses, pairs, means=means)

    @wp.kernel(module=f"{__name__}.{made}")
    def see(
        first: wp.int32,
        vertices: wp.int32,
        v: wp.array(dtype=wp.vec3f),
        spacing: wp.array(dtype=wp.float32),
        normal: wp.array(dtype=wp.vec3f),
        strain: wp.array(dtype=wp.mat33f),
        x: wp.array(dtype=wp.vec3f),
        corners: wp.array(dtype=wp.int32),
        others: wp.array(dtype=wp.vec2i),
        ends: wp.array(dtype=wp.int32),
        far: wp.array(dtype=wp.int32),
        squares: wp.array(dtype=wp.float32, ndim=2),
        cosines: wp.array(dtype=wp.float32, ndim=2),
        scaled: wp.array(dtype=wp.vec3f),
    ):
        i = first + wp.tid()
        across = wp.vec3f()
        if wp.static(any(crosses)):
            across = normal_of(i, x, corners, others)
            normal[i] = across
        if wp.static(len(smoothed) > 0):
            average(i, vertices, ends, far, v)
        near, square = measure(i, vertices, v, spacing, strain)
        show(i, vertices, near, square, soften(square), across, squares, cosines, scaled)

    return see


def _laid_out(parts: Parts, smoothed: int) -> tuple[Parts, tuple[int, ...], tuple[bool, ...], int]:
    """The vectors that are looked at as they are, and where each of these parts is among them.

    Returns:
        Rows, and parts by strain; for each part its place there; whether it is the normal part of that; whole rows.
    """
    rows = 1 + max(row for row, _ in parts)
    own = (*((row, 0) for row in range(rows)), *(part for part in parts if part[1] == STRAIN))
    place = tuple(own.index((row, 0 if kind == NORMAL else kind)) for row, kind in parts)
    return own, place, tuple(kind == NORMAL for _, kind in parts), rows - smoothed


def _averaging(smoothed: tuple[int, ...], wholes: int) -> Any:
    """The function that writes the means over a vertex's neighbours of some rows behind the whole ones."""

    @wp.func
    def average(
        i: wp.int32,
        vertices: wp.int32,
        ends: wp.array(dtype=wp.int32),
        far: wp.array(dtype=wp.int32),
        v: wp.array(dtype=wp.vec3f),
    ):
        share = wp.float32(1.0) / wp.float32(wp.max(ends[i + 1] - ends[i], 1))
        for s in range(wp.static(len(smoothed))):
            total = wp.vec3f()
            for k in range(ends[i], ends[i + 1]):
                total += v[wp.static(smoothed[s]) * vertices + far[k]]
            v[wp.static(wholes + s) * vertices + i] = share * total

    return average


def _measuring(own: Parts) -> Any:
    """The function that finds vectors looked at as they are, in local edges, and their squared lengths."""
    table = wp.types.matrix(shape=(len(own), 3), dtype=wp.float32)
    column = wp.types.vector(length=len(own), dtype=wp.float32)

    @wp.func
    def measure(
        i: wp.int32,
        vertices: wp.int32,
        v: wp.array(dtype=wp.vec3f),
        spacing: wp.array(dtype=wp.float32),
        strain: wp.array(dtype=wp.mat33f),
    ):
        near, square = table(), column()
        scale = wp.float32(1.0) / spacing[i]
        for u in range(wp.static(len(own))):
            w = scale * v[wp.static(own[u][0]) * vertices + i]
            if wp.static(own[u][1] == STRAIN):
                w = strain[i] * w
            square[u] = wp.dot(w, w)
            near[u] = w
        return near, square

    return measure


def _softening(place: tuple[int, ...], shares: Shares) -> Any:
    """The function that finds the least squared length that each vector shows.

    Args:
        place: Of each vector, the one looked at as it is that it is or is the normal part of.
        shares: Of each vector, the shares of all vectors' squares in that.
    """
    kinds = tuple(dict.fromkeys(shares))
    column = wp.types.vector(length=len(place), dtype=wp.float32)
    each = wp.types.vector(length=len(kinds), dtype=wp.float32)
    floor = FLOOR**2

    @wp.func
    def soften(square: Any):
        least, mixed = column(), each()
        for k in range(wp.static(len(kinds))):
            total = wp.float32(wp.static(floor))
            for b in range(wp.static(len(place))):
                if wp.static(kinds[k][b] > 0.0):
                    total += wp.float32(wp.static(kinds[k][b])) * square[wp.static(place[b])]
            mixed[k] = total
        for a in range(wp.static(len(place))):
            least[a] = mixed[wp.static(kinds.index(shares[a]))]
        return least

    return soften


def _showing(place: tuple[int, ...], crosses: tuple[bool, ...], pairs: Pairs, *, means: bool) -> Any:
    """The function that writes what the network sees of a vertex.

    Args:
        place: Of each vector, the one looked at as it is that it is or is the normal part of.
        crosses: Whether it is a normal part.
        pairs: The vectors between which there are cosines.
        means: Whether the vectors in local edge lengths are kept too.
    """
    every = wp.types.vector(length=len(place), dtype=wp.float32)

    @wp.func
    def show(
        i: wp.int32,
        vertices: wp.int32,
        near: Any,
        square: Any,
        least: Any,
        across: wp.vec3f,
        squares: wp.array(dtype=wp.float32, ndim=2),
        cosines: wp.array(dtype=wp.float32, ndim=2),
        scaled: wp.array(dtype=wp.vec3f),
    ):
        inverse, height = every(), every()
        for a in range(wp.static(len(place))):
            size, w = square[wp.static(place[a])], near[wp.static(place[a])]
            if wp.static(crosses[a]):
                height[a] = wp.dot(w, across)
                size = height[a] * height[a]
                w = height[a] * across
            size += least[a]
            inverse[a] = wp.float32(1.0) / wp.sqrt(size)
            squares[a, i] = size
            if wp.static(means):
                scaled[a * vertices + i] = w
        for p in range(wp.static(len(pairs))):
            a, b = wp.static(pairs[p][0]), wp.static(pairs[p][1])
            if wp.static(crosses[pairs[p][0]] and crosses[pairs[p][1]]):
                product = height[a] * height[b]
            elif wp.static(crosses[pairs[p][0]]):
                product = height[a] * wp.dot(near[wp.static(place[pairs[p][1]])], across)
            elif wp.static(crosses[pairs[p][1]]):
                product = height[b] * wp.dot(near[wp.static(place[pairs[p][0]])], across)
            else:
                product = wp.dot(near[wp.static(place[pairs[p][0]])], near[wp.static(place[pairs[p][1]])])
            cosines[i, p] = product * inverse[a] * inverse[b]

    return show
