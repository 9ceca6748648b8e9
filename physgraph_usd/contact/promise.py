"""Moves of one level's cloth in one frame that make nothing cross."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.parts import Parts
from ..collide.sweep import Listed
from .cloth import ClothView
from .safe_move import safe_move

REACH = 0.15
"""Edges that cloth may go before near pairs are listed anew."""
GOES = 3
"""How often a move is taken up again where something was in the way: what was in the way may have gone."""
LATE, RINGS, SPREADS = 0.25, 8, 16
"""Edges that cloth lags behind from where it holds up what is beside it, within so many rings, in so many passes."""
TANGLED = 2
"""Rings round what crosses at the start to which nothing is promised but that no more crosses."""


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
        if known is not None and known.far(x) <= 0.5 * known.reach:
            return known
        return Listed(self.parts, x, REACH * float(self.parts.level.spacing.mean()))

    def move(
        self,
        start: Float[Tensor, "vertices 3"],
        wanted: Float[Tensor, "vertices 3"],
        *,
        listed: Listed | None = None,
    ) -> Tensor:
        """Positions as near to what is wanted as is safe [m], ``wanted`` itself where nothing is in the way.

        Round what crosses at the start cloth may pass through itself, so long as no more crosses after that.
        """
        crossed = self.view.look(start.to(wanted)).crossings
        if not crossed.count:
            return self._go(start, wanted, None, listed)
        x = self._go(start, wanted, self.view.round_crossings(start.to(wanted), rings=TANGLED), listed)
        return x if self.view.look(x).crossings.count <= crossed.count else self._go(start, wanted, None, listed)

    def walk(self, start: Float[Tensor, "vertices 3"], wanted: Float[Tensor, "vertices 3"]) -> Tensor:
        """The same for a far move: what is held up holds up the cloth beside it, so that it is not torn."""
        x = self.move(start, wanted)
        lag = (wanted.double() - x.double()).to(wanted)
        late = lag.norm(dim=1) > LATE * self.parts.level.spacing
        if not bool(late.any()):
            return x
        around = self.view.grown(late, RINGS)
        values, held = lag * late.unsqueeze(1), late.unsqueeze(1)
        for _ in range(SPREADS):
            share = self.view.mean_beside(values, around)
            values = torch.where(held, lag, torch.where(around.unsqueeze(1), share, values))
        return self.move(start, wanted - values)

    def _go(
        self, start: Tensor, wanted: Tensor, exempt: Bool[Tensor, " vertices"] | None, listed: Listed | None
    ) -> Tensor:
        """The same, with nothing promised to some vertices."""
        x = start
        for _ in range(GOES):
            moved = safe_move(x, wanted, self.parts, floor=self.floor, exempt=exempt, listed=listed)
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
