"""The kernel behind `fused.FusedPhysgraph` that sees: normals, means over the neighbours, scalar products.

One pass over the vertices, so that what a vertex gathers from its neighbours is still at hand when it is used. A normal
part is a number times the normal; its products come from that number.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false, reportReturnType=false, reportIndexIssue=false
from __future__ import annotations

import functools
import hashlib
from typing import Any

import warp as wp

from .around import normal_of
from .network import FLOOR, LOG_OFFSET, LOG_SCALE

wp.set_module_options({"enable_backward": False})

NORMAL, STRAIN = 1, 2
"""Parts of a vector that the kernels take themselves; 0 is a row as it is: a whole vector or its mean."""
Parts = tuple[tuple[int, int], ...]
Pairs = tuple[tuple[int, int], ...]
Shares = tuple[tuple[int, bool], ...]


@functools.cache
def seeing(parts: Parts, pairs: Pairs, smoothed: tuple[int, ...], shares: Shares, *, means: bool) -> wp.Kernel:
    """The kernel that finds the normal, the neighbours' means and the features of each vertex.

    Args:
        parts: Row and part of each vector.
        pairs: The vectors whose products are shown.
        smoothed: Rows whose means over the neighbours are the last rows.
        shares: Family of each vector, over whose mean square its products are shown, and whether it counts in that.
        means: Whether it keeps the vectors in local edge lengths, for the garments' means.
    """
    # Warp's hash of a kernel does not see all values that functions of any type are made with; the name carries them.
    made = hashlib.sha256(repr((parts, pairs, smoothed, shares, means)).encode()).hexdigest()[:16]
    own, place, crosses, wholes = _laid_out(parts, len(smoothed))
    measure, compare = _measuring(own, smoothed, wholes), _comparing(own, place, crosses, shares)
    show, keep = _showing(place, crosses, pairs, 1 + max(shares)[0]), _keeping(place, crosses)

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
        features: wp.array(dtype=wp.float32, ndim=2),
        scaled: wp.array(dtype=wp.vec3f),
    ):
        i = first + wp.tid()
        across = wp.vec3f()
        if wp.static(any(crosses)):
            across = normal_of(i, x, corners, others)
            normal[i] = across
        near = measure(i, vertices, ends, far, v, spacing, strain)
        if wp.static(means):
            keep(i, vertices, near, across, scaled)
        unit, size = compare(near, across)
        show(i, unit, size, across, features)

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


def _measuring(own: Parts, smoothed: tuple[int, ...], wholes: int) -> Any:
    """The function that finds vectors looked at as they are, in local edges.

    Those that are means over a vertex's neighbours are also written behind the whole rows.
    """
    table = wp.types.matrix(shape=(len(own), 3), dtype=wp.float32)
    means = wp.types.matrix(shape=(max(len(smoothed), 1), 3), dtype=wp.float32)

    @wp.func
    def measure(
        i: wp.int32,
        vertices: wp.int32,
        ends: wp.array(dtype=wp.int32),
        far: wp.array(dtype=wp.int32),
        v: wp.array(dtype=wp.vec3f),
        spacing: wp.array(dtype=wp.float32),
        strain: wp.array(dtype=wp.mat33f),
    ):
        near, total = table(), means()
        scale = wp.float32(1.0) / spacing[i]
        if wp.static(len(smoothed) > 0):
            for k in range(ends[i], ends[i + 1]):
                j = far[k]
                for s in range(wp.static(len(smoothed))):
                    total[s] += v[wp.static(smoothed[s]) * vertices + j]
            share = wp.float32(1.0) / wp.float32(wp.max(ends[i + 1] - ends[i], 1))
            for s in range(wp.static(len(smoothed))):
                v[wp.static(wholes + s) * vertices + i] = share * total[s]
        for u in range(wp.static(len(own))):
            w = scale * v[wp.static(own[u][0]) * vertices + i]
            if wp.static(own[u][1] == STRAIN):
                w = strain[i] * w
            near[u] = w
        return near

    return measure


def _comparing(own: Parts, place: tuple[int, ...], crosses: tuple[bool, ...], shares: Shares) -> Any:
    """The function that divides vectors by the root mean square of their family's, and gives the mean squares.

    Args:
        own: Rows and parts by strain, looked at as they are.
        place: Of each vector, the one of those that it is or is the normal part of.
        crosses: Whether it is a normal part.
        shares: Family of each vector, and whether it counts in the mean.
    """
    kinds = 1 + max(family for family, _ in shares)
    table = wp.types.matrix(shape=(len(own), 3), dtype=wp.float32)
    column = wp.types.vector(length=kinds, dtype=wp.float32)
    of = tuple(shares[place.index(u)][0] if u in place else 0 for u in range(len(own)))
    counts = tuple(a for a, (_, counted) in enumerate(shares) if counted)
    part = tuple(1.0 / sum(shares[a][0] == kind for a in counts) for kind in range(kinds))

    @wp.func
    def compare(near: Any, across: wp.vec3f):
        unit, size, inverse = table(), column(), column()
        for k in range(wp.static(len(counts))):
            w = near[wp.static(place[counts[k]])]
            if wp.static(crosses[counts[k]]):
                w = wp.dot(w, across) * across
            size[wp.static(shares[counts[k]][0])] += wp.dot(w, w)
        for k in range(wp.static(kinds)):
            size[k] = wp.float32(wp.static(part[k])) * size[k] + wp.float32(wp.static(FLOOR**2))
            inverse[k] = wp.float32(1.0) / wp.sqrt(size[k])
        for u in range(wp.static(len(own))):
            unit[u] = inverse[wp.static(of[u])] * near[u]
        return unit, size

    return compare


def _showing(place: tuple[int, ...], crosses: tuple[bool, ...], pairs: Pairs, kinds: int) -> Any:
    """The function that writes what the network sees of a vertex: squares, products, logarithms of the mean squares.

    Args:
        place: Of each vector, the one looked at as it is that it is or is the normal part of.
        crosses: Whether it is a normal part.
        pairs: The vectors whose products are shown.
        kinds: Number of families.
    """
    every = wp.types.vector(length=len(place), dtype=wp.float32)
    shown = (*((a, a) for a in range(len(place))), *pairs)

    @wp.func
    def show(i: wp.int32, unit: Any, size: Any, across: wp.vec3f, features: wp.array(dtype=wp.float32, ndim=2)):
        height = every()
        for a in range(wp.static(len(place))):
            if wp.static(crosses[a]):
                height[a] = wp.dot(unit[wp.static(place[a])], across)
        for p in range(wp.static(len(shown))):
            a, b = wp.static(shown[p][0]), wp.static(shown[p][1])
            if wp.static(crosses[shown[p][0]] and crosses[shown[p][1]]):
                product = height[a] * height[b]
            elif wp.static(crosses[shown[p][0]]):
                product = height[a] * wp.dot(unit[wp.static(place[shown[p][1]])], across)
            elif wp.static(crosses[shown[p][1]]):
                product = height[b] * wp.dot(unit[wp.static(place[shown[p][0]])], across)
            else:
                product = wp.dot(unit[wp.static(place[shown[p][0]])], unit[wp.static(place[shown[p][1]])])
            features[i, p] = product
        for k in range(wp.static(kinds)):
            features[i, wp.static(len(shown)) + k] = wp.float32(wp.static(LOG_SCALE)) * wp.log(size[k]) + wp.float32(
                wp.static(LOG_OFFSET)
            )

    return show


def _keeping(place: tuple[int, ...], crosses: tuple[bool, ...]) -> Any:
    """The function that keeps each vector in local edge lengths."""

    @wp.func
    def keep(i: wp.int32, vertices: wp.int32, near: Any, across: wp.vec3f, scaled: wp.array(dtype=wp.vec3f)):
        for a in range(wp.static(len(place))):
            w = near[wp.static(place[a])]
            if wp.static(crosses[a]):
                w = wp.dot(w, across) * across
            scaled[a * vertices + i] = w

    return keep
