"""The promise: cloth that is apart never crosses.

Theorem. Let every vertex-face and edge-edge pair of a mesh, but for pairs that share a vertex, have a positive distance
at ``start``. Then it has at what `safe_move` returns, and nothing crosses there that did not at ``start``: a plane
keeps each pair apart on the straight way between the two positions, just as they are rounded (`collide.impact`), so no
pair can have changed sides. Neither what is wanted, how far it is, nor who wants it matters.

Exempt are pairs that touch at the start (distance 0), and pairs all of whose vertices are given as in one tangle. Where
the start is in double precision and what is wanted in single, gaps under its rounding cannot be returned, and are not
promised.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.detector import Detector
from ..collide.narrow_phase import Pairs
from ..collide.parts import Parts
from ..deadline import is_over
from ..level import Placed

ROUNDS = 4
"""How often vertices that would come too near go less far; after that they stay where they start, so that it ends."""

STRAINS, LEAST = 0.5, 0.01
"""Part of its length that an edge changes by at most where vertices beside one another are cut, and a change of that
which counts for nothing. Without it shot 02 needs twice the rounds (53 for 24 in frame 18) and keeps crossings."""


@dataclass(frozen=True, eq=False)
class Moved:
    """Where a move has come.

    Attributes:
        x: Positions [m], shape (V, 3).
        share: How much of its way each vertex has gone, in [0, 1], shape (V,), float64.
        met: Pairs that were in the way.
    """

    x: Placed
    share: Float[Tensor, " vertices"]
    met: Pairs

    @property
    def short(self) -> Bool[Tensor, " vertices"]:
        """Vertices that have not come to where they were to go."""
        return self.share < 1.0


def safe_move(
    start: Float[Tensor, "vertices 3"],
    wanted: Float[Tensor, "vertices 3"],
    parts: Parts,
    *,
    floor: float,
    tangle: Int[Tensor, " vertices"] | None = None,
    detector: Detector | None = None,
    asked: Bool[Tensor, " vertices"] | None = None,
) -> Moved:
    """Move vertices towards wanted positions as far as a plane keeps each pair of parts apart.

    Corners of the pairs that no plane keeps apart go as far as the plane at the start lets them; then the pairs of what
    has changed are asked again, until none is left. Layers that move together are not held up, since what counts is how
    they move against each other.

    Args:
        start: Positions in which what is apart stays apart [m].
        wanted: Where to go [m], of the same dtype.
        parts: What may touch what.
        floor: Gap that pairs keep [m]; most of their distance where that is less.
        tangle: The tangle that each vertex is in, int32, -1 where in none: to what is in one nothing is promised
            against what is in the same; or None.
        detector: What has detected before with the same parts, or None.
        asked: Vertices in all of whose pairs nothing is known of the way; pairs of others are known to be kept apart on
            it. None where nothing is known.

    Returns:
        Positions, ``wanted`` itself where nothing is in the way, and how far vertices have come.
    """
    at = start.double()
    way = wanted.double() - at
    share = torch.ones(len(way), dtype=torch.float64, device=way.device)
    x, asked = wanted, (way != 0).any(dim=1) if asked is None else asked
    detector = detector or Detector.once(parts)
    met = Pairs.none(way.device)
    for attempt in range(len(way) + ROUNDS):
        more = detector.impacts(start, x, floor=floor, asked=asked, tangle=tangle)
        if not len(more.value):
            break
        met, least = met.joined(more), torch.ones_like(share)
        corner = more.corners.long().reshape(-1)
        least.scatter_reduce_(0, corner, more.value.repeat_interleave(4), "amin")
        shorter = share * least if attempt < ROUNDS else torch.where(least < 1.0, 0.0, share)
        # Once time is over all stays where it is.
        known, share = share, torch.zeros_like(share) if is_over() else _spread(shorter, way, parts)
        asked = share < known
        x = torch.where((share < 1.0).unsqueeze(1), (at + share.unsqueeze(1) * way).to(wanted), wanted)
    return Moved(Placed(x), share, met)


def _spread(share: Tensor, way: Tensor, parts: Parts) -> Float[Tensor, " vertices"]:
    """Smaller shares round vertices that are cut short, so that no edge is strained by more than `STRAINS`."""
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
    return torch.minimum(share, (1.0 - late / length.clamp_min(1e-300)).clamp_min(0.0))


def in_the_way(
    start: Float[Tensor, "vertices 3"],
    wanted: Float[Tensor, "vertices 3"],
    parts: Parts,
    *,
    floor: float,
    tangle: Int[Tensor, " vertices"] | None = None,
    detector: Detector | None = None,
    asked: Bool[Tensor, " vertices"] | None = None,
) -> Pairs:
    """The pairs that no plane keeps apart on the straight way to what is wanted, all as for `safe_move`."""
    detector = detector or Detector.once(parts)
    asked = (wanted.double() != start.double()).any(dim=1) if asked is None else asked
    return detector.impacts(start, wanted, floor=floor, asked=asked, tangle=tangle)
