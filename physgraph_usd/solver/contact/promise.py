"""Moves of cloth towards wanted positions that add no crossings, for one level and frame."""

from __future__ import annotations

from dataclasses import dataclass

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


@dataclass(frozen=True, eq=False)
class Before:
    """Bodies in the start frame.

    Attributes:
        corners: Positions of the bodies' corners [m], shape (B, 3), float64.
        inside: Mask of the cloth inside a body there; None if none is.
    """

    corners: Float[Tensor, "corners 3"]
    inside: Bool[Tensor, " vertices"] | None


@dataclass(frozen=True, eq=False)
class _Way:
    """A wanted move of cloth among bodies, in double precision, cloth first.

    Attributes:
        start: Positions [m], shape (A, 3).
        end: Wanted positions [m].
        dtype: Type to which positions of the cloth are rounded.
        tangle: The tangle of each vertex, -1 outside tangles; or None.
        inside: Cloth inside a body; or None.
    """

    start: Float[Tensor, "all 3"]
    end: Float[Tensor, "all 3"]
    dtype: torch.dtype
    tangle: Int[Tensor, " all"] | None
    inside: Bool[Tensor, " all"] | None


@dataclass(frozen=True, eq=False)
class Promise:
    """Moves of one level's cloth in one frame that add no crossings of cloth with cloth or with bodies.

    Attributes:
        view: The level's cloth and the bodies.
        floor: Gap that pairs keep, as for `safe_move` [m].
    """

    view: ClothView
    floor: float

    def move(
        self, start: Placed, wanted: Float[Tensor, "vertices 3"], since: Before | None = None
    ) -> Placed:
        """Positions as close to the wanted positions as is safe [m], ``wanted`` itself if no pair blocks the move.

        In a tangle of the start, cloth may pass through itself as long as the tangle's number of crossings does not
        grow. Cloth inside a body may pass through bodies.

        Args:
            start: Positions [m].
            wanted: Wanted positions [m].
            since: The bodies in the start frame, from which they move; None if they stand. A body passes through cloth
                that cannot give way.
        """
        tangles = self.view.tangles(start)
        if tangles is None:
            x = self._go(start, wanted, None, since)
            if since is None and self.view.is_clean(start):
                self.view.remember(x)
            return x
        free = tangles.label.clone()
        x = self._go(start, wanted, free, since)
        for attempt in range(TRIES):
            worse = tangles.worse(self.view.crossings(x))
            if not bool(worse.any()):
                break
            free[worse if attempt < TRIES - 1 else ~tangles.given_up] = -1
            x = self._go(start, wanted, free, since)
        return x

    def draw(self, start: Placed, wanted: Float[Tensor, "vertices 3"]) -> Placed:
        """As `move`, but the number of crossings in a tangle may grow for a while."""
        tangles = self.view.tangles(start)
        return self._go(start, wanted, None if tangles is None else tangles.label, None)

    def _go(
        self, start: Placed, aim: Tensor, tangle: Int[Tensor, " vertices"] | None, since: Before | None
    ) -> Placed:
        """As `move`, without a promise for pairs inside one tangle.

        The remaining displacements are tried again: the blocking vertices may have moved on.
        """
        view, x = self.view, start
        exempt = view.exempt(start) if since is None else view.padded(since.inside)
        label = tangle if tangle is None else torch.nn.functional.pad(tangle, (0, len(view.corners)), value=-1)
        end = view.with_bodies(aim)
        for _ in range(GOES):
            begin = view.with_bodies(x) if since is None else torch.cat([x.double(), since.corners])
            last, x, since = x, self._go_once(_Way(begin, end, aim.dtype, label, exempt), aim), None
            if x is aim or torch.equal(x, last) or is_over():
                break
        return x

    def _go_once(self, way: _Way, aim: Tensor) -> Placed:
        """A single try: vertices are projected onto the planes of the blocked pairs, and then shortened.

        Only pairs of vertices with changed ends are checked again.
        """
        parts, start, count = self.view.parts, way.start, len(aim)
        options = {"floor": self.floor, "tangle": way.tangle, "inside": way.inside}
        moves = (way.end != start).any(dim=1)
        met = blocking_pairs(parts, start, way.end, **options, asked=moves)
        if not len(met.value):
            return Placed(aim)
        ends, wanted = way.end, way.end - start
        free = moves.unsqueeze(1).clone()
        free[:count] &= parts.level.free
        free[count:] = False
        planes = ApproachLimits.of(start, ends, met, self.floor)
        for _ in range(ROUNDS):
            last, gone = ends, along(wanted, planes, free=free, threads=parts.level.threads)
            cloth = self.view.closed((start + gone)[:count].to(way.dtype))
            ends = torch.cat([cloth.double(), way.end[count:]])
            met = blocking_pairs(parts, start, ends, **options, asked=_corners(met, (ends != last).any(dim=1)))
            if not len(met.value):
                return Placed(cloth)
            planes = planes.joined(ApproachLimits.of(start, ends, met, self.floor, corners=True))
        if bool(moves[count:].any()):  # Cloth that stays behind a body that moves on would be in the body.
            options["inside"] = torch.arange(len(moves), device=moves.device) < count
        asked = _corners(met, torch.zeros_like(moves))
        moved = safe_move(start, ends, parts, **options, asked=asked, dtype=way.dtype)
        return Placed(moved.x[:count].to(way.dtype))


def _corners(met: Pairs, others: Bool[Tensor, " vertices"]) -> Bool[Tensor, " vertices"]:
    """Mask of the corners of pairs and of other vertices."""
    asked = others.clone()
    asked[met.corners.long().reshape(-1)] = True
    return asked
