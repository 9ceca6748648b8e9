"""Collision detection of one level's cloth: near pairs, impacts on straight paths, and crossings.

A broad phase is reused until cloth leaves the searched paths or a required patch is no longer monotone. Within a broad
phase, a list of near pairs is reused while vertices hardly move.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.threads import argument
from .boxes import average_paths, bound_parts, motion_of, room_for_boxes
from .broad_phase import ClusterPairs, launch
from .narrow_phase import Pairs, Reach, find, find_pairs, of_list
from .parts import Parts

SLACK = 0.25
"""Distance that vertices may leave the paths of a broad phase, in mean edges."""
LIST_RADIUS = 0.1
"""Approach of two clusters for which a list of near pairs stays valid for moves, as a fraction of each cluster's
shortest edge; half as much for forces."""
KNOWN = 4
"""Size of the cache of float64 copies of positions."""
FEW = 0.25
"""Largest fraction of queried clusters for which a move outside the broad phase gets its own search of only these
clusters."""
SPARE = 1.05
"""Safety factor of the list radius, for rounded distances."""
IMPACTS, NEAR = 4, 16
"""Room for pairs of parts per two clusters before the pairs are counted: few pairs impact, many are near."""


@dataclass(frozen=True, eq=False)
class _Listed:
    """List of near pairs, valid while no two clusters approach by more than allowed.

    Attributes:
        found: Broad phase of the list.
        x: Positions at the last check [m], float64.
        drift: Upper bound of each cluster pair's approach between listing and last check [m].
        pairs: The pairs of parts.
        owner: The cluster pair of each pair of parts.
    """

    found: ClusterPairs
    x: Tensor
    drift: Tensor
    pairs: Pairs
    owner: Tensor

    @cached_property
    def doubtful(self) -> Pairs:
        """Pairs of parts in clusters without a proof that they stay apart on the paths."""
        return self.pairs.where(~self.found.apart[self.owner])


class _Places:
    """Cache of float64 copies of positions, valid until the source tensor is written to."""

    def __init__(self) -> None:
        self._known: list[tuple[Tensor, int, Tensor]] = []

    def of(self, x: Tensor) -> Tensor:
        """Positions x in double precision, the same tensor at each call for the same x."""
        for known, version, double in self._known:
            if known is x and version == x._version:
                return double
        self._known = [*self._known[-KNOWN + 1 :], (x, x._version, x.to(torch.float64, copy=True))]
        return self._known[-1][2]


class Detector:
    """Collision detector of one level's cloth. Its caches affect only the speed, never the set of pairs."""

    def __init__(
        self, parts: Parts, near: Reach | None = None, *, slack: float = SLACK, farther: float = LIST_RADIUS
    ) -> None:
        """Start with empty caches.

        Args:
            parts: Table of vertex, edge and face pairs that may be in contact.
            near: Search radii of near pairs, if needed.
            slack: Distance that vertices may leave the paths of a broad phase, in mean edges.
            farther: Margin of the list of near pairs, in each vertex's shortest edge.
        """
        self.parts, self.reach = parts, near
        nothing = torch.zeros_like(parts.shortest)
        self._radius = nothing if near is None else near.radius.double()
        self._half = 0.0 if near is None else near.half
        self._may = torch.where(parts.shortest.isfinite(), farther * parts.shortest, nothing)
        self._slack = torch.full_like(nothing, slack * parts.spacing)
        self._places = _Places()
        self._found: ClusterPairs | None = None
        self._served: Tensor | None = None
        self._listed: _Listed | None = None
        self._boxes: tuple[ClusterPairs, Tensor, Any] | None = None

    @staticmethod
    def once(parts: Parts, near: Reach | None = None) -> Detector:
        """A detector for a single query, without margins for later queries."""
        return Detector(parts, near, slack=0.0, farther=0.0)

    def near(self, x: Float[Tensor, "vertices 3"]) -> Pairs:
        """All near pairs at x [m], and some pairs slightly farther apart."""
        assert self.reach is not None
        at = self._places.of(x)
        found, last, reach = self._broad(at, None), self._listed, self.reach
        limits = {"radius": self._radius, "play": reach.play, "slack": SPARE * self._may, "half": reach.half}
        motion = motion_of(at, torch.zeros_like(at), **limits)
        if last is None or last.found is not found:
            pairs, owner = self._narrow(found, found.pairs, motion, at, room=NEAR)
            self._listed = _Listed(found, at, torch.zeros_like(found.allowed), pairs, owner)
            return pairs
        drift = last.drift + found.nearer(last.x, at)
        stale = drift > 0.5 * found.allowed
        pairs, owner = last.pairs, last.owner
        if bool(stale.any()):
            which, kept = torch.nonzero(stale).squeeze(1), torch.nonzero(~stale[owner]).squeeze(1)
            more, of = self._narrow(found, found.pairs[which], motion, at, room=NEAR)
            pairs, owner = pairs.where(kept).joined(more), torch.cat([owner[kept], which[of]])
            drift = torch.where(stale, 0.0, drift)
        self._listed = _Listed(found, at, drift, pairs, owner)
        return pairs

    def impacts(
        self,
        start: Float[Tensor, "vertices 3"],
        end: Float[Tensor, "vertices 3"],
        *,
        floor: float,
        asked: Bool[Tensor, " vertices"],
        tangle: Int[Tensor, " vertices"] | None = None,
    ) -> Pairs:
        """All pairs of parts that would come too near on straight paths.

        Args:
            start: Positions [m].
            end: End positions [m].
            floor: Gap that pairs keep [m]; a pair that is already closer keeps most of its distance.
            asked: Vertices of which each queried pair must contain at least one.
            tangle: The tangle of each vertex, int32, -1 outside tangles; pairs inside a single tangle are skipped; or
                None.
        """
        if _is_known_empty(asked):
            return Pairs.none(asked.device)
        at, to = self._places.of(start), self._places.of(end)
        path = to - at
        found, last = self._broad(at, to, asked), self._listed
        near, asks = Pairs.none(at.device), ~found.apart
        motion = motion_of(at, path, asked=asked, tangle=tangle)
        motion.floor = floor
        if last is not None and last.found is found:
            near = of_list(self.parts, last.doubtful, motion)
            asks &= last.drift + found.nearer(last.x, at, to) > found.allowed
        return near.joined(self._narrow(found, found.pairs, motion, at, room=IMPACTS, asked=asks)[0])

    def still(self, kernel: wp.Kernel, x: Float[Tensor, "vertices 3"]) -> Pairs:
        """Pairs of parts that a kernel with the parameters of `find_pairs` finds at x [m]."""
        at = self._places.of(x)
        found = self._broad(at, None)
        motion = motion_of(at, torch.zeros_like(at))
        return self._narrow(found, found.pairs, motion, at, room=IMPACTS, kernel=kernel, asked=~found.apart)[0]

    def _broad(self, at: Tensor, to: Tensor | None, asked: Tensor | None = None) -> ClusterPairs:
        """Pairs of clusters valid for a move or for positions.

        If few vertices are queried, pairs without a queried vertex may be missing.
        """
        last = to if to is not None else at
        known = self._found is not None and ((to is None and last is self._served) or self._found.covers(at, to))
        if self._found is None or not known:
            radius = self._radius if self.reach is None else self._radius + SPARE * self._may
            limits = {"radius": radius, "allowed": self._may, "half": self._half}
            clusters = None if asked is None else self.parts.with_any(asked)
            if clusters is not None and float(clusters.float().mean()) < FEW:
                none = torch.zeros_like(self._slack)
                return ClusterPairs.find(self.parts, at, to, **limits, slack=none, asked=clusters)
            self._found = ClusterPairs.find(self.parts, at, to, **limits, slack=self._slack_for(at, to))
        self._served = last
        return self._found

    def _slack_for(self, at: Tensor, to: Tensor | None) -> Tensor:
        """Path tolerance of a new broad phase [m]: vertices that move far will move on, by up to an edge."""
        return self._slack if to is None else self._slack + (to - at).norm(dim=1).clamp_max(self.parts.spacing)

    def _narrow(
        self,
        found: ClusterPairs,
        clusters: Int[Tensor, "clusters 2"],
        motion: Any,
        at: Tensor,
        *,
        room: int,
        kernel: wp.Kernel = find_pairs,
        asked: Bool[Tensor, " clusters"] | None = None,
    ) -> tuple[Pairs, Int[Tensor, " pairs"]]:
        """Pairs of parts among the queried cluster pairs of a broad phase, and the cluster pair of each."""
        if asked is not None and _is_known_empty(asked):
            return Pairs.none(at.device), found.pairs[:0, 0].long()
        active = argument(found.active)
        if self._boxes is None or self._boxes[0] is not found or self._boxes[1] is not at:
            self._boxes = found, at, room_for_boxes(self.parts) if self._boxes is None else self._boxes[2]
            launch(self.parts, bound_parts, len(found.active), motion, active, self._boxes[2])
        launch(self.parts, average_paths, len(found.active), motion, active, self._boxes[2])
        return find(self.parts, clusters, kernel, motion, self._boxes[2], room=room, asked=asked)


def _is_known_empty(asked: Tensor) -> bool:
    """True if the query is known to be empty; on CUDA the check would wait longer than it saves."""
    return not asked.is_cuda and not bool(asked.any())
