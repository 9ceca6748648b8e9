"""The promise: cloth that is apart never crosses.

Theorem. Let every vertex-face and edge-edge pair of a mesh, but for pairs that share a vertex, have a positive distance
at ``start``. Then it has at what `safe_move` returns, and nothing crosses there that did not at ``start``: on the
straight way between the two positions, just as they are rounded, each pair keeps a positive distance, so no pair can
have changed sides. Neither what is wanted, how far it is, nor who wants it matters.

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
from ..collide.impact import TIGHT
from ..collide.narrow_phase import Pairs
from ..collide.parts import Parts
from ..deadline import is_over
from ..level import Placed

KEPT = 0.2
"""Part of its distance that a pair keeps in one move, of more than a mean edge that of an edge: it may come as near as
it likes in several."""
BACK = 0.9
"""Part of the way to an impact that its vertices go: others, cut in turn, may come nearer than they were to."""
STRAINS, LEAST = 0.5, 0.01
"""Part of its length that an edge changes by at most where vertices beside one another are cut, and a change of that
which counts for nothing."""
SHORTENINGS = 16
"""Passes in which vertices that would touch go less far; after them they stay, so that there is an end."""


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
    """Move vertices as far towards wanted positions as no pair of parts comes too near.

    Pairs that would touch are found on the way from the start to the positions to be returned, as they are rounded, and
    their vertices go as far as they may; then the pairs of what has changed are asked again, until none would touch.
    Layers that move together are not held up, since what counts is how they move against each other.

    Args:
        start: Positions in which what is apart stays apart [m].
        wanted: Where to go [m], of the same dtype.
        parts: What may touch what.
        floor: Distance under which a pair keeps nine tenths of what it has [m]: gaps end there.
        tangle: The tangle that each vertex is in, int32, -1 where in none: to what is in one nothing is promised
            against what is in the same; or None.
        detector: What has detected before with the same parts, or None.
        asked: Vertices in all of whose pairs nothing is known of the way; pairs of others are known not to come too
            near on it. None where nothing is known.

    Returns:
        Positions, ``wanted`` itself where nothing is in the way, and how far vertices have come.
    """
    at = start.double()
    way = wanted.double() - at
    share = torch.ones(len(way), dtype=torch.float64, device=way.device)
    x, asked = wanted, (way != 0).any(dim=1) if asked is None else asked
    detector = detector or Detector.once(parts)
    met = Pairs.none(way.device)
    for attempt in range(len(way) + SHORTENINGS):
        more = detector.impacts(start, x, share=KEPT, floor=floor, asked=asked, tangle=tangle)
        if not len(more.value):
            break
        met, least = met.joined(more), torch.ones_like(share)
        corner = more.corners.long().reshape(-1)
        least.scatter_reduce_(0, corner, BACK * more.value.repeat_interleave(4), "amin")
        shorter = share * least if attempt < SHORTENINGS else torch.where(least < 1.0, 0.0, share)
        # When the time is over all stays where it is.
        known, share = share, torch.zeros_like(share) if is_over() else _spread(shorter, way, parts)
        asked = share < known
        x = torch.where((share < 1.0).unsqueeze(1), (at + share.unsqueeze(1) * way).to(wanted), wanted)
    return Moved(Placed(x), share, met)


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
    """The pairs that would come too near on the straight way to what is wanted, all as for `safe_move`."""
    detector = detector or Detector.once(parts)
    asked = (wanted.double() != start.double()).any(dim=1) if asked is None else asked
    return detector.impacts(start, wanted, share=KEPT, floor=floor, asked=asked, tangle=tangle)


def kept(distance: Float[Tensor, " pairs"], *, spacing: float, floor: float) -> Float[Tensor, " pairs"]:
    """What pairs keep of their distances in one move [m].

    Args:
        distance: Their distances [m].
        spacing: Mean edge at rest [m]: of more than that they keep no more than of that.
        floor: As for `safe_move` [m].
    """
    return torch.maximum(KEPT * distance.clamp_max(spacing), (TIGHT * distance).clamp_max(floor))


def _spread(share: Tensor, way: Tensor, parts: Parts) -> Float[Tensor, " vertices"]:
    """Less of their ways where what lies beside is cut short, so that no edge is strained by more than `STRAINS`."""
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
