"""Where what is in the way moves too: the ways nearest to those wanted on which no pair that was met comes nearer."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.narrow_phase import Pairs
from ..collide.near import weights
from ..mesh.stencil import add_at

COMES = 0.5
"""Part of its distance by which a pair may come nearer: the promise lets it come by four fifths."""
PASSES = 16
"""Passes over the pairs: what is left is cut back by the promise."""


def along(
    x: Float[Tensor, "vertices 3"],
    way: Float[Tensor, "vertices 3"],
    met: Pairs,
    *,
    free: Bool[Tensor, "vertices 1"],
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
    """
    if not len(met.value):
        return way
    corners, face = _distinct(met)
    weight, places = weights(x, corners, face), corners.long()
    apart = (weight.unsqueeze(2) * x[places]).sum(dim=1)
    distance = apart.norm(dim=1)
    normal = apart / distance.clamp_min(1e-300).unsqueeze(1)
    count = torch.bincount(places.reshape(-1), minlength=len(x)).to(x)
    gives = weight * free[places].squeeze(2)
    stiffness = (gives.square() * count[places]).sum(dim=1).clamp_min(1e-300)
    push, out = torch.zeros_like(distance), way
    for _ in range(PASSES):
        nearer = (weight * (normal.unsqueeze(1) * out[places]).sum(dim=2)).sum(dim=1) + COMES * distance
        push = (push - nearer / stiffness).clamp_min(0.0)
        each = (push.unsqueeze(1) * gives).unsqueeze(2) * normal.unsqueeze(1)
        out = add_at(way.clone(), places.reshape(-1), each.reshape(-1, 3))
    return out


def _distinct(met: Pairs) -> tuple[Int[Tensor, "pairs 4"], Bool[Tensor, " pairs"]]:
    """Corners of each pair once, in their order, and whether it is of a vertex and a face.

    Two sorts of whole numbers: `torch.unique` of rows compares them number by number, some ten times as slowly.
    """
    a, b, c, d = met.corners.long().T
    count = int(met.corners.max()) + 1
    first, second = a * count + b, 2 * (c * count + d) + met.face
    order = torch.argsort(second, stable=True)
    order = order[torch.argsort(first[order], stable=True)]
    first, second = first[order], second[order]
    kept = torch.ones_like(first, dtype=torch.bool)
    kept[1:] = (first[1:] != first[:-1]) | (second[1:] != second[:-1])
    order = order[kept]
    return met.corners[order], met.face[order].bool()
