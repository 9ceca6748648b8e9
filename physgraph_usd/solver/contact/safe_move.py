"""The promise: cloth that is apart never crosses.

Theorem. Let every vertex-face and edge-edge pair of a mesh, except pairs that share a vertex, have a positive distance
at ``start``. Then every such pair has a positive distance at the result of `safe_move`, and the result has no crossings
that ``start`` did not have: a plane keeps each pair apart on the straight path between the two positions, as rounded
(`collide.separation`), so no pair can have changed sides. The theorem holds for any wanted positions.

Exempt are pairs that touch at the start (`TOUCHES` of `collide.separation`), and pairs with all vertices in a single
given tangle. If the start is in double precision and the wanted positions in single, gaps below single precision's
rounding cannot be returned, and are not promised.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.parts import Parts
from ..collide.search import blocking_pairs
from ..deadline import is_over
from ..level import Placed

ROUNDS = 4
"""Most passes that shorten blocked displacements. Vertices still blocked afterwards stay at the start, so the passes
end."""

STRAINS, LEAST = 0.5, 0.01
"""Largest strain of an edge between vertices whose displacements are shortened, and the fraction of that change which
is negligible. Without the limit shot 02 needs twice the rounds (53 for 24 in frame 18) and keeps crossings."""


def safe_move(
    start: Float[Tensor, "vertices 3"],
    wanted: Float[Tensor, "vertices 3"],
    parts: Parts,
    *,
    floor: float,
    tangle: Int[Tensor, " vertices"] | None = None,
    inside: Bool[Tensor, " vertices"] | None = None,
    asked: Bool[Tensor, " vertices"] | None = None,
    dtype: torch.dtype | None = None,
) -> Placed:
    """Move vertices towards wanted positions as far as a plane keeps each pair of parts apart.

    Corners of blocked pairs move as far as the plane at the start allows. Pairs with changed vertices are then checked
    again, until no pair is blocked. Only relative motion counts, so layers that move together are not stopped.

    Args:
        start: Start positions, the reference of the promise [m].
        wanted: Wanted positions [m], of the same dtype.
        parts: Table of vertex, edge and face pairs that may be in contact.
        floor: Gap that pairs keep [m]; a pair that is already closer keeps most of its distance.
        tangle: The tangle of each vertex, int32, -1 outside tangles; pairs inside a single tangle have no promise. None
            without tangles.
        inside: Cloth inside a body; its pairs with bodies have no promise. None for none.
        asked: Vertices whose pairs must be checked; pairs without such a vertex are known to be safe. None checks every
            vertex that moves.
        dtype: Type to which positions of the cloth are rounded; None for the type of the wanted positions.

    Returns:
        Positions [m], ``wanted`` itself if no pair is blocked.
    """
    at = start.double()
    way = wanted.double() - at
    share = torch.ones(len(way), dtype=torch.float64, device=way.device)
    x, asked = wanted, (way != 0).any(dim=1) if asked is None else asked
    given = {"floor": floor, "tangle": tangle, "inside": inside}
    cloth, dtype = torch.arange(len(way), device=way.device) < parts.level.vertex_count, dtype or wanted.dtype
    for attempt in range(len(way) + ROUNDS):
        more = blocking_pairs(parts, start, x, asked=asked, **given)
        if not len(more.value):
            break
        least = torch.ones_like(share)
        corner = more.corners.long().reshape(-1)
        least.scatter_reduce_(0, corner, more.value.repeat_interleave(4), "amin")
        shorter = share * least if attempt < ROUNDS else torch.where(least < 1.0, 0.0, share)
        # Once time is over all stays where it is.
        less = torch.zeros_like(share) if is_over() else _spread(shorter, way, parts)
        known, share = share, torch.where(cloth, less, share)  # Bodies go their way.
        asked = share < known
        moved = (at + share.unsqueeze(1) * way).to(dtype).to(wanted)
        x = torch.where((share < 1.0).unsqueeze(1), moved, wanted)
    return Placed(x)


def _spread(share: Tensor, way: Tensor, parts: Parts) -> Float[Tensor, " vertices"]:
    """Fractions reduced around shortened vertices, so that no edge is strained by more than `STRAINS`."""
    length = way.norm(dim=1)
    late = length * (1.0 - share)
    first, second = parts.links.T
    within = STRAINS * parts.lengths
    least = LEAST * within.mean()
    while True:
        new = late.scatter_reduce(0, second, late[first] - within, "amax")
        new = new.scatter_reduce(0, first, new[second] - within, "amax")
        if is_over() or not bool((new > late + least).any()):
            break
        late = new
    out = torch.minimum(share, (1.0 - late / length.clamp_min(1e-300)).clamp_min(0.0))
    sewn, partner = parts.links[parts.lengths == 0].T  # Seams stay closed to the last bit.
    out = out.scatter_reduce(0, partner, out[sewn], "amin")
    return out.scatter_reduce(0, sewn, out[partner], "amin")
