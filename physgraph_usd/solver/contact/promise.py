"""Moves of one level's cloth in one frame that make nothing cross."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..collide.narrow_phase import Pairs
from ..deadline import is_over
from ..level import Placed
from ..mesh.stencil import add_at
from .along import along
from .cloth import ClothView
from .safe_move import in_the_way, safe_move

WIDTHS = (16.0, 8.0, 4.0, 2.0)
"""Cells in which cloth is carried together where something is in the way of its own ways, in edge lengths."""
LONG = 1.0
"""Mean edges beyond which a move is carried together: what a shorter one loses comes in the next round."""
GOES = 3
"""How often what is then left of each way is gone: what was in the way may have gone too."""
TRIES = 4
"""How often tangles in which more crosses are held to the promise, before all are."""


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
        """The same where tangles may come to cross more for a while, and garments are brought in their order."""
        tangles = self.view.tangles(start, order=True)
        return self._go(start, wanted, None if tangles is None else tangles.label)

    def _go(self, start: Placed, aim: Tensor, tangle: Int[Tensor, " vertices"] | None) -> Placed:
        """The same, with nothing promised to what is in a tangle against what is in the same.

        First goes what cloth in a place has in common of its ways, in ever smaller places: layers that move together
        hold nothing up. Then each vertex goes what is left of its own way, along what was in it.
        """
        given = {"floor": self.floor, "tangle": tangle, "detector": self.view.detector}
        parts, moves = self.view.parts, (aim != start).any(dim=1, keepdim=True)
        met = in_the_way(start, aim, parts, **given)
        if not len(met.value):
            return Placed(aim)
        is_long = float((aim - start).norm(dim=1).max()) > LONG * parts.spacing
        x, met = start, Pairs.none(start.device) if is_long else met
        for width in (*(WIDTHS if is_long else ()), *(0.0,) * GOES):
            at, rest = x.double(), aim.double() - x.double()
            if width:
                way = moves * carried(at, rest, width=width * parts.spacing)
            else:
                way = along(at, rest, met, free=moves & parts.level.free, threads=parts.level.threads)
            moved = safe_move(x, self.view.closed((at + way).to(aim)), parts, **given)
            x, met = moved.x, met.joined(moved.met)
            if is_over() or (not width and not bool(moved.short.any())):
                break
        return Placed(aim) if torch.equal(x, aim) else x


def carried(
    x: Float[Tensor, "vertices 3"], way: Float[Tensor, "vertices 3"], *, width: float
) -> Float[Tensor, "vertices 3"]:
    """The part of each vertex's way that cloth round it shares, as a smooth field of space (Harlow 1964).

    Ways are averaged in the cells of a grid and read back linearly between their centres, so that two layers which are
    near each other go nearly the same way: such a move brings nothing together, however far it goes.

    Args:
        x: Positions [m], float64.
        way: How far each vertex is to go [m], float64.
        width: Width of the cells [m].
    """
    place = (x - x.amin(dim=0)) / width
    cell = place.floor()
    part, size = place - cell, cell.amax(dim=0).long() + 2
    weights, nodes = [], []
    for corner in itertools.product((0.0, 1.0), repeat=3):
        at = torch.tensor(corner, dtype=torch.float64, device=x.device)
        weights.append((at * part + (1.0 - at) * (1.0 - part)).prod(dim=1))
        index = (cell + at).long()
        nodes.append((index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2])
    weight, node = torch.stack(weights), torch.unique(torch.stack(nodes), return_inverse=True)[1]
    total = way.new_zeros((int(node.max()) + 1, 4))
    share = torch.cat([weight.unsqueeze(2) * way, weight.unsqueeze(2)], dim=2)
    total = add_at(total, node.reshape(-1), share.reshape(-1, 4))
    mean = total[:, :3] / total[:, 3:].clamp_min(1e-300)
    return (weight.unsqueeze(2) * mean[node]).sum(dim=0)
