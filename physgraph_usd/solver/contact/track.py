"""Cached distances between one level's cloth and one body, updated only where they may have changed.

Immutable: an update returns a new track, and the old track still gives the same answers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..colliders.base import Nearest, Surface
from ..colliders.sign import MARGIN, ROUNDING, behind, is_clear
from ..level import Level
from .measure import Pierced, is_between, pierced, pinched

ON_SURFACE = 1e-6
"""Distance under which the direction to the closest point is rounding and the face's normal is taken [m]."""


@dataclass(frozen=True, eq=False)
class Track:
    """Cached distances between one level and one surface.

    Attributes:
        surface: The surface.
        shift: From the group's coordinates to the surface's [m], shape (3,).
        offset: Distance to keep [m], shape (V,).
        side: Start side of each vertex for open surfaces, shape (V,); zeros for closed surfaces.
        at: Positions of the cached distances [m], shape (V, 3).
        known: Signed distances at `at`; for positive distances possibly lower bounds [m], shape (V,).
        longest: Longest push of a vertex out from between overlapping parts [m].
        lost: Vertices between overlapping parts in the input, which stay while inside, shape (V,), or None.
        inside: First closest points of the vertices with negative distances; or None.
    """

    surface: Surface
    shift: Tensor
    offset: Tensor
    side: Tensor
    at: Tensor
    known: Tensor
    longest: float
    lost: Tensor | None = None
    inside: Nearest | None = None

    def pierced(self, level: Level, x: Tensor) -> Pierced:
        """Intersections of the cloth at x [m] with the body."""
        bound = (self.known.abs() - (x - self.at).norm(dim=1)).clamp_min(0.0)
        return pierced(self.surface, level, x + self.shift, bound)

    def least(self, x: Tensor) -> Tensor:
        """Lower bounds of the signed distances at x [m]."""
        return self.known - MARGIN * (x - self.at).norm(dim=1) - ROUNDING

    def refresh(self, x: Tensor, within: Tensor) -> tuple[Track, Tensor, Tensor, Tensor]:
        """Update vertices that may be nearer than a distance given for each vertex [m].

        Returns:
            The new track; indices of the updated vertices, without pinched vertices; their unit normals away from the
            surface; and their signed distances.
        """
        moved = (x - self.at).norm(dim=1)
        which = torch.nonzero(self.known - moved < within).squeeze(1)
        if not len(which):
            return self, which, x[which], moved[which]
        asked = x[which] + self.shift
        limit = self._limit(which, within[which], moved[which])
        found = self.surface.closest(asked, limit)
        sign = self._signs(which, found, asked, moved[which])
        at, known = self.at.clone(), self.known.clone()
        at[which], known[which] = x[which], torch.minimum(found.distance, limit) * sign
        distance, point, outward = found.distance.clone(), found.point.clone(), found.normal.clone()
        within = torch.nonzero(sign < 0).squeeze(1)
        kept = distance.isfinite()
        if len(within):
            near = found.some(within)
            way = self.surface.exit(asked[within], near)
            distance[within], point[within], outward[within] = way.distance, way.point, way.normal
            lost = None if self.lost is None else self.lost[which[within]]
            kept[within] = ~pinched(self.surface, asked[within], near, way, longest=self.longest, lost=lost)
        away = (asked - point) / distance.clamp_min(ON_SURFACE).unsqueeze(1) * sign.unsqueeze(1)
        outward = outward * self._outward(which).unsqueeze(1)
        normal = torch.where((distance > ON_SURFACE).unsqueeze(1), away, outward)
        normal = torch.nn.functional.normalize(normal, dim=1, eps=1e-30)
        kept = torch.nonzero(kept).squeeze(1)
        return replace(self, at=at, known=known), which[kept], normal[kept], (distance * sign)[kept]

    def between(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Indices of vertices between overlapping parts of a closed surface at x [m]; mask of those in two parts."""
        still = torch.equal(x, self.at)
        moved = torch.zeros_like(self.known) if still else (x - self.at).norm(dim=1)
        which = torch.nonzero((self.known - moved < 0) & self.offset.isfinite()).squeeze(1)
        if not len(which) or not self.surface.closed:
            return which[:0], moved[:0] > 0
        asked, found = x[which] + self.shift, self.inside if still else None
        if found is None or len(found.distance) != len(which):
            found = self.surface.closest(asked, torch.full_like(asked[:, 0], float("inf")))
        if not still:
            within = torch.nonzero(self._signs(which, found, asked, moved[which]) < 0).squeeze(1)
            which, asked, found = which[within], asked[within], found.some(within)
        between = torch.nonzero(is_between(found, self.surface.exit(asked, found))).squeeze(1)
        return which[between], self.surface.inside(asked[between], parts=2)

    def _limit(self, which: Tensor, within: Tensor, moved: Tensor) -> Tensor:
        """Search distance of the closest-point query; for vertices farther outside the bound is enough."""
        limit = torch.maximum(within + self.longest, MARGIN * moved)
        everywhere = torch.full_like(limit, float("inf"))
        return everywhere if self.surface.certain else torch.where(self.known[which] < 0, everywhere, limit)

    def _outward(self, which: Tensor) -> Tensor:
        """1 if face normals point to the allowed side, -1 if the start side is behind them."""
        side = self.side[which]
        return torch.where(side < 0, side, torch.ones_like(side))

    def _signs(self, which: Tensor, found: Nearest, asked: Tensor, moved: Tensor) -> Tensor:
        """1 outside, or on the start side of an open surface; -1 inside, or behind an open surface."""
        if not self.surface.closed:
            return torch.where(behind(found, self.side[which]), -torch.ones_like(moved), torch.ones_like(moved))
        if self.surface.certain:
            return found.side
        known = torch.where(self.known[which] < 0, -torch.ones_like(moved), torch.ones_like(moved))
        may_have_crossed = ~is_clear(self.known[which].abs() + found.distance, moved)
        sign = torch.where(may_have_crossed & (found.side != 0), found.side, known)
        ask = may_have_crossed & (found.side == 0)
        if bool(ask.any()):
            sign[ask] = 1.0 - 2.0 * self.surface.inside(asked[ask]).to(sign)
        return sign
