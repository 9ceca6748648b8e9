"""Moves of cloth towards wanted positions that add no crossings: cloth that is apart never crosses.

Theorem. Let every vertex-face and edge-edge pair of a mesh, except pairs that share a vertex, have a positive distance
at ``start``. Then every such pair has a positive distance at the result of `safe_move`, and the result has no crossings
that ``start`` did not have: a plane keeps each pair apart on the straight path between the two positions, as rounded
(`collide.separation`), so no pair can have changed sides. The theorem holds for any wanted positions.

Exempt are pairs that touch at the start (`TOUCHES` of `collide.separation`), and pairs with all vertices in a single
given tangle. If the start is in double precision and the wanted positions in single, gaps below single precision's
rounding cannot be returned, and are not promised.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.pairs import Pairs
from ..collide.parts import Parts
from ..collide.search import blocking_pairs
from ..deadline import is_over
from ..level import Placed
from .along import ApproachLimits, along
from .cloth import ClothView
from .cloth_mesh import RINGS

ROUNDS = 4
"""Most passes that shorten blocked displacements. Vertices still blocked afterwards stay at the start, so the passes
end."""

STRAINS, NEGLIGIBLE = 0.5, 0.01
"""Largest strain of an edge between vertices whose displacements are shortened, and the fraction of that change which
is negligible. Without the limit shot 02 needs twice the rounds (53 for 24 in frame 18) and keeps crossings."""


@dataclass(frozen=True, eq=False)
class Before:
    """Bodies in the start frame.

    Attributes:
        corners: Positions of the bodies' corners [m], shape (B, 3), float64.
        inside: Mask of the cloth inside a body there; None if none is.
    """

    corners: Float[Tensor, "corners 3"]
    inside: Bool[Tensor, " vertices"] | None


class _Options(TypedDict):
    """Options of `safe_move`."""

    floor: float
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

    def move(self, start: Placed, wanted: Float[Tensor, "vertices 3"], since: Before | None = None) -> Placed:
        """Positions as close to the wanted positions as is safe [m], ``wanted`` itself if no pair blocks the move.

        In a tangle of the start, cloth may pass through itself as long as the tangle's number of crossings does not
        grow. Cloth inside a body may pass through bodies.

        Args:
            start: Positions [m].
            wanted: Wanted positions [m].
            since: The bodies in the start frame, from which they move; None if they stand. A body passes through cloth
                that cannot give way.
        """
        view, tangles = self.view, self.view.tangles(start)
        if tangles is None or bool(tangles.hopeless.all()):
            x, proved = self._go(start, wanted, None if tangles is None else tangles.label, since)
            if proved and view.is_clean(start):
                view.remember(x, tangles)
            return x
        free = tangles.label.clone()
        x, _ = self._go(start, wanted, free, since)
        for whole in (False, True):  # First the worse tangles alone are held, then all.
            worse = tangles.worse(view.crossings(x))
            if not bool(worse.any()):
                break
            free[~tangles.given_up if whole else worse] = -1
            x, _ = self._go(start, wanted, free, since)
        return x

    def draw(self, start: Placed, wanted: Float[Tensor, "vertices 3"]) -> Placed:
        """As `move`, but the number of crossings in a tangle may grow for a while."""
        tangles = self.view.tangles(start)
        return self._go(start, wanted, None if tangles is None else tangles.label, None)[0]

    def _go(
        self, start: Placed, aim: Tensor, tangle: Int[Tensor, " vertices"] | None, since: Before | None
    ) -> tuple[Placed, bool]:
        """As `move`, without a promise for pairs inside one tangle; and whether all pairs with bodies are proved apart.

        Vertices are projected onto the planes of the blocked pairs, and then shortened. Only pairs of vertices with
        changed ends are checked again.
        """
        view, count = self.view, len(aim)
        begin = view.with_bodies(start) if since is None else torch.cat([start.double(), since.corners])
        label = None if tangle is None else torch.nn.functional.pad(tangle, (0, len(view.corners)), value=-1)
        inside = view.exempt(start) if since is None else view.padded(since.inside)
        options = _Options(floor=self.floor, tangle=label, inside=inside)
        end = view.with_bodies(aim)
        near = view.springs.known(start) if since is None else None
        if near is None and label is None and inside is None:
            met = view.springs.blocking(begin, end, aim, floor=self.floor, asked=view.asked)
        else:
            met = blocking_pairs(view.parts, begin, end, **options, asked=self._moving(begin, end), near=near)
        x, proved = self._on(begin, end, met, options, dtype=aim.dtype, halved=since is not None)
        return Placed(aim if x is end else x[:count].to(aim)), proved

    def _moving(self, begin: Tensor, end: Tensor) -> Bool[Tensor, " all"]:
        """Mask of the vertices that move, or of all that are not given up."""
        return (end != begin).any(dim=1) if self.view.asked is None else self.view.asked

    def _on(
        self, begin: Tensor, end: Tensor, met: Pairs, options: _Options, *, dtype: torch.dtype, halved: bool
    ) -> tuple[Tensor, bool]:
        """Positions after a move of cloth and bodies, and whether all pairs with bodies are proved apart.

        Args:
            begin: Positions of cloth and bodies [m], float64.
            end: Wanted positions [m]; those of bodies are reached.
            met: Pairs that block the move.
            dtype: Type to which positions of the cloth are rounded.
            halved: Whether vertices in or around pairs that stay blocked move in two halves: planes may turn once more.
        """
        view, parts, count = self.view, self.view.parts, self.view.parts.level.vertex_count
        if not len(met.value):
            return end, True
        moves = (end != begin).any(dim=1)
        stand = not bool(moves[count:].any())
        free = parts.level.free & moves[:count].unsqueeze(1) if stand else parts.level.free
        free = torch.nn.functional.pad(free, (0, 0, 0, len(end) - count))
        ends, wanted = end, end - begin
        planes = ApproachLimits.of(begin, ends, met, self.floor)
        for _ in range(ROUNDS):
            last, gone = ends, along(wanted, planes, free=free, threads=parts.level.threads)
            cloth = view.closed((begin + gone)[:count].to(dtype))
            ends = torch.cat([cloth.double(), end[count:]])
            met = blocking_pairs(parts, begin, ends, **options, asked=_corners(met, (ends != last).any(dim=1)))
            if not len(met.value):
                return ends, True
            planes = planes.joined(ApproachLimits.of(begin, ends, met, self.floor, corners=True))
        if halved:  # Pairs of other vertices stay apart on both halves of their straight paths.
            late, proved = _corners(met, torch.zeros_like(moves)), True
            late[:count] = view.mesh.grown(late[:count], RINGS)
            late &= moves
            last = torch.where(late.unsqueeze(1), end, ends)
            for aim in (0.5 * (begin + last), last):
                met = blocking_pairs(parts, begin, aim, **options, asked=late)
                begin, one = self._on(begin, aim, met, options, dtype=dtype, halved=False)
                late, proved = late | (begin != aim).any(dim=1), proved and one
            return begin, proved
        if not stand:  # Cloth that stays behind a body that moves on would be in the body.
            options = _Options(**options)
            options["inside"] = torch.arange(len(moves), device=moves.device) < count
        asked = _corners(met, torch.zeros_like(moves))
        return safe_move(begin, ends, parts, **options, asked=asked, dtype=dtype), stand


def _corners(met: Pairs, others: Bool[Tensor, " vertices"]) -> Bool[Tensor, " vertices"]:
    asked = others.clone()
    asked[met.corners.long().reshape(-1)] = True
    return asked


def safe_move(
    start: Float[Tensor, "vertices 3"],
    wanted: Float[Tensor, "vertices 3"],
    parts: Parts,
    *,
    floor: float,
    tangle: Int[Tensor, " vertices"] | None = None,
    inside: Bool[Tensor, " vertices"] | None = None,
    asked: Bool[Tensor, " vertices"] | None = None,
    dtype: torch.dtype | None = None,
) -> Placed:
    """Move vertices towards wanted positions as far as a plane keeps each pair of parts apart.

    Corners of blocked pairs move as far as the plane at the start allows. Pairs with changed vertices are then checked
    again, until no pair is blocked. Only relative motion counts, so layers that move together are not stopped.

    Args:
        start: Start positions, the reference of the promise [m].
        wanted: Wanted positions [m], of the same dtype.
        parts: Table of vertex, edge and face pairs that may be in contact.
        floor: Gap that pairs keep [m]; a pair that is already closer keeps most of its distance.
        tangle: The tangle of each vertex, int32, -1 outside tangles; pairs inside a single tangle have no promise. None
            without tangles.
        inside: Cloth inside a body; its pairs with bodies have no promise. None for none.
        asked: Vertices whose pairs must be checked; pairs without such a vertex are known to be safe. None checks every
            vertex that moves.
        dtype: Type to which positions of the cloth are rounded; None for the type of the wanted positions.

    Returns:
        Positions [m], ``wanted`` itself if no pair is blocked.
    """
    at = start.double()
    way = wanted.double() - at
    share = torch.ones(len(way), dtype=torch.float64, device=way.device)
    x, asked = wanted, (way != 0).any(dim=1) if asked is None else asked
    given = {"floor": floor, "tangle": tangle, "inside": inside}
    cloth, dtype = torch.arange(len(way), device=way.device) < parts.level.vertex_count, dtype or wanted.dtype
    for attempt in range(len(way) + ROUNDS):
        more = blocking_pairs(parts, start, x, asked=asked, **given)
        if not len(more.value):
            break
        least = torch.ones_like(share)
        corner = more.corners.long().reshape(-1)
        least.scatter_reduce_(0, corner, more.value.repeat_interleave(4), "amin")
        shorter = share * least if attempt < ROUNDS else torch.where(least < 1.0, 0.0, share)
        # Once time is over all stays where it is.
        less = torch.zeros_like(share) if is_over() else _spread(shorter, way, parts)
        known, share = share, torch.where(cloth, less, share)  # Bodies go their way.
        asked = share < known
        moved = (at + share.unsqueeze(1) * way).to(dtype).to(wanted)
        x = torch.where((share < 1.0).unsqueeze(1), moved, wanted)
    return Placed(x)


def _spread(share: Tensor, way: Tensor, parts: Parts) -> Float[Tensor, " vertices"]:
    """Fractions reduced around shortened vertices, so that no edge is strained by more than `STRAINS`."""
    length = way.norm(dim=1)
    late = length * (1.0 - share)
    first, second = parts.links.T
    within = STRAINS * parts.lengths
    least = NEGLIGIBLE * within.mean()
    while True:
        new = late.scatter_reduce(0, second, late[first] - within, "amax")
        new = new.scatter_reduce(0, first, new[second] - within, "amax")
        if is_over() or not bool((new > late + least).any()):
            break
        late = new
    out = torch.minimum(share, (1.0 - late / length.clamp_min(1e-300)).clamp_min(0.0))
    sewn, partner = parts.links[parts.lengths == 0].T  # Seams stay closed to the last bit.
    out = out.scatter_reduce(0, partner, out[sewn], "amin")
    return out.scatter_reduce(0, sewn, out[partner], "amin")
