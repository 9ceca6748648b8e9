"""Moves of one level's cloth in one frame that make nothing cross."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TypedDict

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.detector import Detector
from ..collide.narrow_phase import Pairs
from ..deadline import is_over
from ..level import Placed
from .along import Planes, along
from .cloth import ClothView
from .safe_move import in_the_way, kept, safe_move

LONG = 1.0
"""Mean edges by which cloth may be cut short: what a move loses comes in the next round."""
ROUNDS = 4
"""How often it is found what else is in the way of vertices that go along what was, before they are cut short."""
GOES, GAINS = 3, 0.5
"""How often what is left of each way is gone: what was in the way may have gone too; no more where a go has left over
so much of what was left before it."""
TRIES = 4
"""How often tangles in which more crosses are held to the promise, before all are."""


class _MoveOptions(TypedDict):
    """What `safe_move` takes besides positions and parts."""

    floor: float
    tangle: Int[Tensor, " vertices"] | None
    detector: Detector


@dataclass(frozen=True, eq=False)
class Promise:
    """Moves of one level's cloth in one frame that make nothing cross.

    Attributes:
        view: The level's cloth.
        floor: As `safe_move` takes it [m].
    """

    view: ClothView
    floor: float

    def move(self, start: Placed, wanted: Float[Tensor, "vertices 3"]) -> Placed:
        """Positions as near to what is wanted as is safe [m], ``wanted`` itself where nothing is in the way.

        In a tangle, round what crosses at the start, cloth may pass through itself, so long as no more of it crosses
        after that.
        """
        tangles = self.view.tangles(start)
        if tangles is None:
            x = self._go(start, wanted, None)
            self.view.remember(x)
            return x
        free = tangles.label.clone()
        x = self._go(start, wanted, free)
        for attempt in range(TRIES):
            worse = tangles.worse(self.view.crossings(x))
            if not bool(worse.any()):
                break
            free[worse if attempt < TRIES - 1 else ~tangles.given_up] = -1
            x = self._go(start, wanted, free)
        return x

    def draw(self, start: Placed, wanted: Float[Tensor, "vertices 3"]) -> Placed:
        """The same where tangles may come to cross more for a while."""
        tangles = self.view.tangles(start)
        return self._go(start, wanted, None if tangles is None else tangles.label)

    def _go(self, start: Placed, aim: Tensor, tangle: Int[Tensor, " vertices"] | None) -> Placed:
        """The same, with nothing promised to what is in a tangle against what is in the same.

        Where something is in the way each vertex goes along it; what was cut short goes on from where it came to.
        """
        parts = self.view.parts
        options = _MoveOptions(floor=self.floor, tangle=tangle, detector=self.view.detector)
        met = in_the_way(start, aim, parts, **options)
        if not len(met.value):
            return Placed(aim)
        x, late = start, torch.inf
        for go in range(GOES):
            known = late
            x, late = self._along(x, aim, met, options)
            if late <= LONG * parts.spacing or late > GAINS * known or go == GOES - 1 or is_over():
                break
            met = in_the_way(x, aim, parts, **options)
        return x

    def _along(self, start: Placed, aim: Tensor, met: Pairs, options: _MoveOptions) -> tuple[Placed, float]:
        """Where cloth comes that goes along what is in its way, and by how much it was cut short at most [m].

        What has changed since it was asked last is asked again, and nothing else.

        Args:
            start: Where it is [m].
            aim: Where it is to go [m].
            met: The pairs in the way.
            options: As `safe_move` takes them.
        """
        parts, at, ends = self.view.parts, start.double(), aim
        wanted, free = aim.double() - at, (aim != start).any(dim=1, keepdim=True) & parts.level.free
        keeps = partial(kept, spacing=parts.spacing, floor=self.floor)
        way, planes = wanted, Planes.of(at, None, met, keeps)
        for _ in range(ROUNDS):
            if not len(met.value):
                return Placed(aim if torch.equal(ends, aim) else ends), 0.0
            last, way = ends, along(wanted, planes, free=free, threads=parts.level.threads)
            ends = self.view.closed((at + way).to(aim))
            met = in_the_way(start, ends, parts, **options, asked=_corners(met, (ends != last).any(dim=1)))
            planes = planes.joined(Planes.of(at, ends.double() - at, met, keeps))
        moved = safe_move(start, ends, parts, **options, asked=_corners(met, torch.zeros_like(free[:, 0])))
        return moved.x, float(((1.0 - moved.share) * way.norm(dim=1)).max())


def _corners(met: Pairs, others: Bool[Tensor, " vertices"]) -> Bool[Tensor, " vertices"]:
    """The corners of pairs, and other vertices."""
    asked = others.clone()
    asked[met.corners.long().reshape(-1)] = True
    return asked
