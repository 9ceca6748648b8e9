"""Moves of one level's cloth in one frame that make nothing cross."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..collide.parts import Parts
from ..collide.sweep import Listed
from .cloth import ClothView
from .safe_move import safe_move

REACH = 0.15
"""Edges that cloth may go before near pairs are listed anew."""
GOES = 3
"""How often a move is taken up again where something was in the way: what was in the way may have gone."""
TANGLED, TRIES = 2, 4
"""Rings round what crosses at the start to which nothing is promised but that no more crosses, and how often what
crosses more is held to the promise before all is."""


@dataclass(frozen=True, eq=False)
class Promise:
    """Moves of one level's cloth in one frame that make nothing cross.

    Attributes:
        parts: What may touch what.
        floor: As `safe_move` takes it [m].
        view: The level's cloth.
    """

    parts: Parts
    floor: float
    view: ClothView

    def listed(self, x: Float[Tensor, "vertices 3"], known: Listed | None) -> Listed:
        """The pairs that short moves from x [m] ask; known ones while at least half of their reach is left."""
        if known is not None and known.covers(x, 0.5):
            return known
        return Listed(self.parts, x, near=self.view.near, may=REACH * self.parts.shortest)

    def move(
        self,
        start: Float[Tensor, "vertices 3"],
        wanted: Float[Tensor, "vertices 3"],
        *,
        listed: Listed | None = None,
    ) -> Tensor:
        """Positions as near to what is wanted as is safe [m], ``wanted`` itself where nothing is in the way.

        In a tangle, round what crosses at the start, cloth may pass through itself, so long as no more of it crosses
        after that.
        """
        tangles = self.view.tangles(start.to(wanted), rings=TANGLED)
        if tangles is None:
            x = self._go(start, wanted, None, listed)
            self.view.remember(x)
            return x
        free, before = tangles.label.clone(), tangles.counts(self.view.look(start.to(wanted)).crossings)
        for attempt in range(TRIES):
            x = self._go(start, wanted, free if attempt < TRIES - 1 else None, listed)
            worse = tangles.counts(self.view.look(x).crossings) > before
            if not bool(worse.any()):
                break
            free[worse[tangles.label.long()] & (tangles.label >= 0)] = -1
        return x

    def _go(
        self, start: Tensor, wanted: Tensor, tangle: Int[Tensor, " vertices"] | None, listed: Listed | None
    ) -> Tensor:
        """The same, with nothing promised to what is in a tangle against what is in the same."""
        x = start
        for _ in range(GOES):
            moved = safe_move(x, wanted, self.parts, floor=self.floor, tangle=tangle, listed=listed)
            x, short = moved.x, int(moved.short.sum())
            if not short:
                break
            # What is left of a way goes on along what was in it.
            rest = wanted.double() - x.double()
            against = (rest * moved.clear).sum(dim=1, keepdim=True).clamp_max(0.0)
            wanted = torch.where(
                moved.short.unsqueeze(1), (x.double() + rest - against * moved.clear).to(wanted), wanted
            )
        return x
