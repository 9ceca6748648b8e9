"""Garments in an order: which near parts lie on the wrong side of one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.near import NearPairs
from ..level import Level
from ..mesh.stencil import add_at
from ..scene import Garment

FRONTAL = 0.3
"""Cosine to the inner garment's normal under which a pair of ordered garments is beside it, not through it."""


@dataclass(frozen=True, eq=False)
class Layers:
    """The order of a group's garments.

    Attributes:
        order: Layer of each garment, the outer ones higher, NaN without one, shape (G,).
        outward: 1 where a garment's normals point outwards, -1 where inwards, shape (G,).
    """

    order: Float[Tensor, " garments"]
    outward: Float[Tensor, " garments"]

    @staticmethod
    def of(garments: Sequence[Garment], cage: Level) -> Layers | None:
        """The order of garments; None where no two of them have different layers."""
        if len({garment.layer for garment in garments} - {None}) < 2:
            return None
        order = [float("nan") if garment.layer is None else float(garment.layer) for garment in garments]
        outward = [-1.0 if garment.flipped else 1.0 for garment in garments]
        order_and_side = (torch.tensor(each, dtype=cage.dtype, device=cage.device) for each in (order, outward))
        return Layers(*order_and_side)

    def wrong(self, level: Level, near: NearPairs, x: Float[Tensor, "vertices 3"]) -> Bool[Tensor, " pairs"]:
        """Whether the outer of two ordered garments lies inside the inner one, and nowhere nearer outside it."""
        corners = near.corners.long()
        garment = level.vertex_garment[corners[:, [0, 3]]].long()
        order = self.order[garment]
        ordered = (order[:, 0] != order[:, 1]) & ~order.isnan().any(dim=1)
        first_is_outer = order[:, 0] > order[:, 1]
        # A vertex-face pair has one corner first, an edge-edge pair two.
        split = torch.where(near.face, 1, 2).unsqueeze(1)
        is_first = torch.arange(4, device=x.device).unsqueeze(0) < split
        inner = torch.where(first_is_outer.unsqueeze(1), ~is_first, is_first)
        out = (_vertex_normals(level, x)[corners] * inner.unsqueeze(2)).sum(dim=1)
        way = torch.where(first_is_outer.unsqueeze(1), near.way, -near.way)
        owner = torch.where(first_is_outer, garment[:, 1], garment[:, 0])
        cosine = torch.nn.functional.cosine_similarity(out, way, dim=1, eps=1e-30) * self.outward[owner]
        distance = near.way.norm(dim=1)
        met = corners * len(self.order) + torch.where(is_first, garment[:, 1:], garment[:, :1])
        outside = torch.where(ordered & (cosine > FRONTAL), distance, torch.inf)
        nearest = distance.new_full((level.vertex_count * len(self.order),), torch.inf)
        nearest.scatter_reduce_(0, met.reshape(-1), outside.repeat_interleave(4), "amin")
        return ordered & (cosine < -FRONTAL) & (distance < nearest[met].amin(dim=1))


def _vertex_normals(level: Level, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
    """Area-weighted normals of the authored winding [m^2]."""
    corner = level.triangles.long()
    area = torch.linalg.cross(x[corner[:, 1]] - x[corner[:, 0]], x[corner[:, 2]] - x[corner[:, 0]])
    return add_at(torch.zeros_like(x), corner.T.reshape(-1), area.repeat(3, 1))
