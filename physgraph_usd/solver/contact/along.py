"""Where what is in the way moves too: the ways nearest to those wanted on which no pair that was met comes nearer."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false
from __future__ import annotations

from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.narrow_phase import Pairs
from ..collide.near import weights
from ..mesh.stencil import incidence
from ..mesh.threads import Launch, argument

wp.set_module_options({"enable_backward": False})

COMES = 0.5
"""Part of its distance by which a pair may come nearer: the promise lets it come by four fifths."""
PASSES = 16
"""Passes over the pairs: what is left is cut back by the promise."""


@wp.kernel
def _push_apart(
    first: wp.int32,
    corners: wp.array(dtype=wp.vec4i),
    weight: wp.array(dtype=wp.vec4d),
    normal: wp.array(dtype=wp.vec3d),
    may: wp.array(dtype=wp.float64),
    stiffness: wp.array(dtype=wp.float64),
    way: wp.array(dtype=wp.vec3d),
    push: wp.array(dtype=wp.float64),
):
    """The multiplier of each pair, from how much nearer its parts come on their ways."""
    n = first + wp.tid()
    nearer = wp.float64(0.0)
    for k in range(4):
        along_it = wp.cw_mul(normal[n], way[corners[n][k]])
        nearer += weight[n][k] * (along_it[0] + along_it[1] + along_it[2])
    push[n] = wp.max(push[n] - (nearer + may[n]) / stiffness[n], wp.float64(0.0))


@wp.kernel
def _add_pushes(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    slots: wp.array(dtype=wp.int32),
    gives: wp.array(dtype=wp.vec4d),
    normal: wp.array(dtype=wp.vec3d),
    push: wp.array(dtype=wp.float64),
    wanted: wp.array(dtype=wp.vec3d),
    way: wp.array(dtype=wp.vec3d),
):
    """The way of each vertex that its pairs leave it."""
    v = first + wp.tid()
    total = wanted[v]
    for k in range(starts[v], starts[v + 1]):
        n = slots[k] // 4
        total += push[n] * gives[n][slots[k] - 4 * n] * normal[n]
    way[v] = total


def along(
    x: Float[Tensor, "vertices 3"],
    way: Float[Tensor, "vertices 3"],
    met: Pairs,
    *,
    free: Bool[Tensor, "vertices 1"],
    threads: int = 1,
) -> Float[Tensor, "vertices 3"]:
    """The ways nearest to those wanted [m] on which no pair comes nearer than it may.

    What counts is how the two parts of a pair move against each other: layers that move together go on together. The
    least squares under one linear inequality a pair are solved by Jacobi's method on the multipliers, each vertex
    split among its pairs (Tonge et al. 2012).

    Args:
        x: Positions [m], float64.
        way: How far each vertex wants to go [m], float64.
        met: The pairs.
        free: Which vertices may go another way than they want.
        threads: Most threads on the CPU.
    """
    if not len(met.value):
        return way
    corners, face = _distinct(met, len(x))
    weight, places = weights(x, corners, face), corners.long()
    apart = (weight.unsqueeze(2) * x[places]).sum(dim=1)
    distance = apart.norm(dim=1)
    normal = apart / distance.clamp_min(1e-300).unsqueeze(1)
    starts, slots = incidence(places, len(x))
    gives = (weight * free[places].squeeze(2)).contiguous()
    count = starts.diff().to(x)
    stiffness = (gives.square() * count[places]).sum(dim=1).clamp_min(1e-300)
    pairs = [argument(corners, wp.vec4i), *(argument(each, wp.vec4d) for each in (weight, gives))]
    pairs += [argument(normal.contiguous(), wp.vec3d)]
    moved = way.clone(memory_format=torch.contiguous_format)
    push, wanted, out = argument(torch.zeros_like(distance)), _vectors(way), _vectors(moved)
    push_apart = [*pairs[:2], pairs[3], argument(COMES * distance), argument(stiffness), out, push]
    add_pushes = [argument(starts), argument(slots), pairs[2], pairs[3], push, wanted, out]
    launched = {"device": str(x.device), "threads": threads}
    launches = [
        Launch(_push_apart, len(corners), push_apart, **launched),
        Launch(_add_pushes, len(x), add_pushes, **launched),
    ]
    for launch in launches * PASSES:
        launch({})
    return moved


def _distinct(met: Pairs, count: int) -> tuple[Int[Tensor, "pairs 4"], Bool[Tensor, " pairs"]]:
    """Corners of each pair once, in their order, and whether it is of a vertex and a face.

    Two sorts of whole numbers: `torch.unique` of rows compares them number by number, some ten times as slowly.

    Args:
        met: The pairs.
        count: Number of vertices.
    """
    a, b, c, d = met.corners.long().T
    first, second = a * count + b, 2 * (c * count + d) + met.face
    order = torch.argsort(second, stable=True)
    order = order[torch.argsort(first[order], stable=True)]
    first, second = first[order], second[order]
    kept = torch.ones_like(first, dtype=torch.bool)
    kept[1:] = (first[1:] != first[:-1]) | (second[1:] != second[:-1])
    order = order[torch.nonzero(kept).squeeze(1)]
    return met.corners[order], met.face[order].bool()


def _vectors(x: Tensor) -> Any:
    """Vectors as kernels read them."""
    return argument(x.contiguous(), wp.vec3d)
