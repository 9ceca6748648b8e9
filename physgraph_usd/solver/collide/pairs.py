"""Pairs of parts: a vertex and a face, or two edges."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Reach:
    """Search radii of near pairs.

    Attributes:
        radius: Two parts are near within the sum of their radii, the largest of their corners' radii [m], shape (V,),
            float64.
        play: Parts of one garment are near only within `half` of their distance at rest plus the sum of their plays,
            the largest of their corners' [m], shape (V,); at most the radius, and 0 for bodies.
        half: Fraction of the distance at rest; a large number omits no pair.
    """

    radius: Float[Tensor, " vertices"]
    play: Float[Tensor, " vertices"]
    half: float


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of parts.

    Attributes:
        corners: A vertex and the corners of a face, or the ends of two edges, shape (N, 4).
        value: For moves, the safe fraction of the paths, in (0, 1); for near pairs, the distance over the search
            distance; shape (N,), float64.
        face: True for a vertex and a face, shape (N,).
    """

    corners: Int[Tensor, "pairs 4"]
    value: Float[Tensor, " pairs"]
    face: Bool[Tensor, " pairs"]

    @staticmethod
    def empty(count: int, device: torch.device | str) -> Pairs:
        """Uninitialized pairs."""
        corners = torch.empty((count, 4), dtype=torch.int32, device=device)
        value = torch.empty(count, dtype=torch.float64, device=device)
        return Pairs(corners, value, torch.empty(count, dtype=torch.bool, device=device))

    def where(self, selected: Bool[Tensor, " pairs"] | Int[Tensor, " kept"]) -> Pairs:
        """The selected pairs."""
        if selected.dtype == torch.bool:  # One conversion for three fields.
            selected = torch.nonzero(selected).squeeze(1)
        return Pairs(*(getattr(self, field.name).index_select(0, selected) for field in fields(self)))

    def joined(self, pairs: Pairs) -> Pairs:
        """These pairs, followed by further pairs."""
        return Pairs(*(torch.cat([getattr(self, field.name), getattr(pairs, field.name)]) for field in fields(self)))


@dataclass(frozen=True, eq=False)
class NearAt:
    """All near pairs at some positions.

    Attributes:
        reach: The search radii.
    """

    pairs: Pairs
    reach: Reach

    def leaving(self, move: Float[Tensor, "vertices 3"], floor: float) -> Bool[Tensor, " vertices"]:
        """Mask of the vertices whose move [m] may bring parts that are not near closer than a floor [m].

        Parts that are not near are farther apart than the sum of their plays. Two parts whose vertices move by at most
        their play less half the floor keep the floor. If a play is less than half the floor, any move counts, and the
        parts keep at least half the floor.
        """
        return move.norm(dim=1) > (self.reach.play - 0.5 * floor).clamp_min(0.0)
