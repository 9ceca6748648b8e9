"""Moves of cloth towards wanted positions that add no crossings, for one level and frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.pairs import Pairs
from ..collide.search import blocking_pairs
from ..deadline import is_over
from ..level import Placed
from .along import ApproachLimits, along
from .cloth import ClothView
from .safe_move import ROUNDS, safe_move

GOES = 3
"""Most tries of the remaining displacements. A single try leaves crossings in frames 18 and 19 of shot 02."""
TRIES = 4
"""Most tries that hold only the worsened tangles to the promise, before all hopeful tangles are held."""


class _MoveOptions(TypedDict):
    """Options of `safe_move`."""

    floor: float
    tangle: Int[Tensor, " vertices"] | None


@dataclass(frozen=True, eq=False)
class Promise:
    """Moves of one level's cloth in one frame that add no crossings.

    Attributes:
        view: The level's cloth.
        floor: Gap that pairs keep, as for `safe_move` [m].
    """

    view: ClothView
    floor: float

    def move(self, start: Placed, wanted: Float[Tensor, "vertices 3"]) -> Placed:
        """Positions as close to the wanted positions as is safe [m], ``wanted`` itself if no pair blocks the move.

        In a tangle of the start, cloth may pass through itself as long as the tangle's number of crossings does not
        grow.
        """
        tangles = self.view.tangles(start)
        if tangles is None or bool(tangles.hopeless.all()):
            x = self._go(start, wanted, None if tangles is None else tangles.label)
            self.view.remember(x, tangles)
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
        """As `move`, but the number of crossings in a tangle may grow for a while."""
        tangles = self.view.tangles(start)
        return self._go(start, wanted, None if tangles is None else tangles.label)

    def _go(self, start: Placed, aim: Tensor, tangle: Int[Tensor, " vertices"] | None) -> Placed:
        """As `move`, without a promise for pairs inside one tangle.

        The remaining displacements are tried again: the blocking vertices may have moved on.
        """
        x = start
        for _ in range(GOES):
            last, x = x, self._go_once(x, aim, tangle)
            if x is aim or torch.equal(x, last) or is_over():
                break
        return x

    def _go_once(self, start: Placed, aim: Tensor, tangle: Int[Tensor, " vertices"] | None) -> Placed:
        """A single try: vertices are projected onto the planes of the blocked pairs, and then shortened.

        Only pairs of vertices with changed ends are checked again.
        """
        parts = self.view.parts
        options = _MoveOptions(floor=self.floor, tangle=tangle)
        moves, asked = (aim != start).any(dim=1), self.view.asked
        met = blocking_pairs(parts, start, aim, **options, asked=moves if asked is None else asked)
        if not len(met.value):
            return Placed(aim)
        at, ends = start.double(), aim
        wanted, free = aim.double() - at, moves.unsqueeze(1) & parts.level.free
        planes = ApproachLimits.of(at, aim.double(), met, self.floor)
        for _ in range(ROUNDS):
            last, way = ends, along(wanted, planes, free=free, threads=parts.level.threads)
            ends = self.view.closed((at + way).to(aim))
            met = blocking_pairs(parts, start, ends, **options, asked=_corners(met, (ends != last).any(dim=1)))
            if not len(met.value):
                return Placed(ends)
            planes = planes.joined(ApproachLimits.of(at, ends.double(), met, self.floor, corners=True))
        asked = _corners(met, torch.zeros_like(moves))
        return safe_move(start, ends, parts, **options, asked=asked).x


def _corners(met: Pairs, others: Bool[Tensor, " vertices"]) -> Bool[Tensor, " vertices"]:
    """Mask of the corners of pairs and of other vertices."""
    asked = others.clone()
    asked[met.corners.long().reshape(-1)] = True
    return asked
