"""Cloth that bodies push onto other cloth moves that along: bodies and pairs of near parts push in turn."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .cloth_mesh import ClothMesh
from .nearest import Pairs

TURNS = 24
"""How often pairs and bodies push in turn."""
AROUND = 2
"""Rings round what bodies moved whose pairs are looked at."""
REACH = 2.0
"""How far off pairs are looked for at most, in mean edges."""
FAR = 4.0
"""Move by bodies, in mean edges, from which nothing is pushed along: sides at the start then say nothing."""
FLAT = 1e-7
"""Distance under which two parts have no direction from one to the other [m]."""

Push = Callable[[Float[Tensor, "vertices 3"]], Float[Tensor, "vertices 3"]]
"""Positions with what is inside bodies moved out [m]."""


def squeezed(
    mesh: ClothMesh,
    start: Float[Tensor, "vertices 3"],
    x: Float[Tensor, "vertices 3"],
    *,
    push_out: Push,
    gap: float,
) -> Float[Tensor, "vertices 3"]:
    """Move what bodies push onto other cloth, and that cloth, until either is where it was to the other.

    Args:
        mesh: The cloth of one level.
        start: Positions before bodies pushed, in which nothing new crosses [m].
        x: Positions after it [m].
        push_out: How bodies push.
        gap: Distance that parts keep at most [m]; what was closer stays as close.

    Returns:
        Positions [m]; x itself where bodies moved it too far.
    """
    shift = (x - start).norm(dim=1)
    edge, far = float(mesh.level.spacing.mean()), float(shift.max())
    if far > FAR * edge:
        return x
    reach = gap + min(2.0 * far, REACH * edge)
    mesh.move(start)
    pairs = mesh.pairs(mesh.grown(shift > 0, AROUND), torch.full_like(shift, reach))
    if not len(pairs.corners):
        return x
    planes = _Planes(pairs, start, mesh.level.free[:, 0], gap)
    for _ in range(TURNS):
        apart = planes.push(x)
        if apart is x:
            break
        x = push_out(apart)
    return x


class _Planes:
    """Which side of one another the parts of each pair are to stay on."""

    def __init__(self, pairs: Pairs, start: Tensor, free: Bool[Tensor, " vertices"], gap: float) -> None:
        """Take sides as they are at start [m]."""
        corners = pairs.corners.long()
        way = (pairs.weight.unsqueeze(2) * start[corners]).sum(dim=1)
        distance = way.norm(dim=1)
        kept = distance > FLAT
        self._corners, self._weight = corners[kept], pairs.weight[kept] * free[corners[kept]]
        self._all = pairs.weight[kept]
        self._normal = way[kept] / distance[kept].unsqueeze(1)
        self._least = distance[kept].clamp_max(gap)
        self._mass = self._weight.square().sum(dim=1)

    def push(self, x: Tensor) -> Tensor:
        """Each pair at least as far apart as it is to be, several pairs of a vertex averaged; x itself if all are."""
        way = (self._all.unsqueeze(2) * x[self._corners]).sum(dim=1)
        lack = self._least - (way * self._normal).sum(dim=1)
        near = (lack > FLAT) & (self._mass > 0)
        if not bool(near.any()):
            return x
        scale = (lack[near] / self._mass[near]).unsqueeze(1) * self._normal[near]
        move = self._weight[near].unsqueeze(2) * scale.unsqueeze(1)
        total, count = torch.zeros_like(x), torch.zeros_like(x[:, :1])
        which = self._corners[near].reshape(-1)
        total.index_put_((which,), move.reshape(-1, 3), accumulate=True)
        count.index_put_((which,), torch.ones_like(count[which]), accumulate=True)
        return x + total / count.clamp_min(1.0)
