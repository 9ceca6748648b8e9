"""The last resort where a result crosses more than its input: back towards positions that do not, as far as it takes.

`ClothView.mend` looks for the smallest change and may find none. This always ends: at worst all of the cloth is where
the good positions have it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .cloth import ClothState, ClothView
from .cloth_mesh import ClothMesh

FIRST = 4
"""Rings round what crosses that are taken back at first; twice as many each time."""


def taken_back(
    cloth: ClothView, mesh: ClothMesh, x: Float[Tensor, "vertices 3"], goods: Sequence[ClothState]
) -> Float[Tensor, "vertices 3"]:
    """Positions that cross no more than may.

    Args:
        cloth: The finest level's cloth.
        mesh: Its faces.
        x: Positions [m].
        goods: Positions to go back to, the best first; the last crosses no more than may.

    Returns:
        Positions [m], x itself where no more crosses.
    """
    if not cloth.worse(x):
        return x
    for good in goods:
        if not cloth.worse(good.x):
            mended = cloth.mend(x, good).x
            if not cloth.worse(mended):
                return mended
    good, rings = goods[-1], FIRST
    out, back = x, torch.zeros_like(mesh.level.free[:, 0])
    while cloth.worse(out) and not bool(back.all()):
        back = widened(mesh, back, cloth.round_crossings(out, rings=0), rings)
        out = cloth.closed(returned(mesh, x, good.x, where=back, rings=rings))
        rings = min(2 * rings, len(x))
    return out


def widened(
    mesh: ClothMesh, where: Bool[Tensor, " vertices"], more: Bool[Tensor, " vertices"], rings: int
) -> Bool[Tensor, " vertices"]:
    """Vertices, more of them, and some rings round all; every one where that adds none.

    Rings end where a piece of cloth does, and a loose vertex is in none.
    """
    out = mesh.grown(where | more, rings)
    return out if bool((out & ~where).any()) else torch.ones_like(where)


def returned(
    mesh: ClothMesh,
    x: Float[Tensor, "vertices 3"],
    good: Float[Tensor, "vertices 3"],
    *,
    where: Bool[Tensor, " vertices"],
    rings: int,
) -> Float[Tensor, "vertices 3"]:
    """Positions that are good ones at some vertices and change over to others over some rings round them [m]."""
    return good + (x - good) * _kept(mesh, where, rings)


def _kept(mesh: ClothMesh, back: Bool[Tensor, " vertices"], rings: int) -> Float[Tensor, "vertices 1"]:
    """0 at some vertices, rising to 1 over some rings round them."""
    kept = torch.ones_like(back, dtype=mesh.level.rest.dtype)
    for ring in range(rings):
        kept[back] = torch.minimum(kept[back], torch.full_like(kept[back], ring / rings))
        back = mesh.grown(back, 1)
    return kept.unsqueeze(1)
