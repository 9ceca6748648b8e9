"""The planes that vertices see in one body: the closest one, and in a crease of the body another.

The closest plane alone lets a vertex in a crease through the other side of it, where it is found only in the next
round, and the first side forgotten: the vertex goes to and fro and never rests.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..forces.contact import Planes

NARROW, WIDE = -0.5, 0.7
"""Cosines of two planes' normals between which they may be the sides of a crease: a narrower one has no room."""


@dataclass(frozen=True, eq=False)
class Seen:
    """At most one plane a vertex.

    Attributes:
        there: Whether there is one, shape (V,).
        normal: Unit normals, shape (V, 3).
        height: n . c [m], shape (V,).
        offset: Distance to keep [m], shape (V,).
    """

    there: Bool[Tensor, " vertices"]
    normal: Float[Tensor, "vertices 3"]
    height: Float[Tensor, " vertices"]
    offset: Float[Tensor, " vertices"]

    @staticmethod
    def none(x: Float[Tensor, "vertices 3"]) -> Seen:
        """No planes."""
        zero = torch.zeros_like(x[:, 0])
        return Seen(zero > 0, torch.zeros_like(x), zero, zero.clone())

    def planes(self) -> Planes:
        """Those that there are."""
        which = torch.nonzero(self.there).squeeze(1)
        return Planes(which.to(torch.int32), self.normal[which], (self.height + self.offset)[which])

    def where(self, these: Bool[Tensor, " vertices"], other: Seen) -> Seen:
        """These planes at some vertices, and others elsewhere."""
        return Seen(
            torch.where(these, self.there, other.there),
            torch.where(these.unsqueeze(1), self.normal, other.normal),
            torch.where(these, self.height, other.height),
            torch.where(these, self.offset, other.offset),
        )

    def cosine(self, other: Seen) -> Float[Tensor, " vertices"]:
        """Of the normals."""
        return (self.normal * other.normal).sum(dim=1)


@dataclass(frozen=True, eq=False)
class Sight:
    """What vertices see of one body.

    Attributes:
        at: Where each vertex was then [m], shape (V, 3).
        closest: The plane of the closest point.
        crease: The other side of the crease that a vertex lies in.
    """

    at: Float[Tensor, "vertices 3"]
    closest: Seen
    crease: Seen

    @staticmethod
    def none(x: Float[Tensor, "vertices 3"]) -> Sight:
        """Nothing yet."""
        return Sight(x, Seen.none(x), Seen.none(x))

    def renewed(
        self,
        x: Float[Tensor, "vertices 3"],
        still: Bool[Tensor, " vertices"],
        *,
        vertex: Int[Tensor, " near"],
        normal: Float[Tensor, "near 3"],
        signed: Float[Tensor, " near"],
        offset: Float[Tensor, " near"],
        hollow: Float[Tensor, " vertices"] | None,
    ) -> Sight:
        """What vertices see now.

        Args:
            x: Where they are [m].
            still: Which of them keep what they saw.
            vertex: Which of the others are near the body.
            normal: Unit normals of their closest planes.
            signed: Distances to them [m].
            offset: Distances to keep [m].
            hollow: How far in front of the plane seen before the closest point is in a crease [m]; None for never.
        """
        found, surface = Seen.none(x), torch.zeros_like(x)
        surface[vertex] = x[vertex] - normal * signed.unsqueeze(1)
        found.there[vertex], found.normal[vertex], found.offset[vertex] = True, normal, offset
        found.height[vertex] = (normal * surface[vertex]).sum(dim=1)
        if not bool(self.closest.there.any()):
            return Sight(x, found, Seen.none(x))
        crease = Seen.none(x) if hollow is None else self._other_side(found, surface, hollow)
        at = torch.where(still.unsqueeze(1), self.at, x)
        return Sight(at, self.closest.where(still, found), self.crease.where(still, crease))

    def _other_side(self, found: Seen, surface: Tensor, hollow: Tensor) -> Seen:
        """The planes seen before in front of which what is closest now lies: the body is hollow there."""
        other = self.closest.where(self.closest.cosine(found) < WIDE, self.crease)
        cosine = other.cosine(found)
        in_front = (other.normal * surface).sum(dim=1) > other.height + hollow
        there = found.there & other.there & in_front & (cosine > NARROW) & (cosine < WIDE)
        return Seen(there, other.normal, other.height, other.offset)
