"""The planes that near parts of cloth see in one another: on which side each belongs, and how far from it it stays."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..forces.self_contact import Gaps
from .cloth_mesh import ClothMesh, Crossings
from .nearest import Pairs

LEAST_OFFSET = 0.25
"""Part of the thickness that parts keep where the input has them closer."""
WELDED = 0.02
"""Part of the thickness under which the input has two points as one: a seam, which is not pushed open."""
TURNED = 0.5
"""Cosine beyond which the way from one part to another counts as turned round since the input: one passed through."""
OUT = 0.5
"""How far crossing parts are moved past one another in a round, in mean edges."""
FRONTAL = 0.3
"""Cosine to the inner garment's normal under which a pair of ordered garments is beside it, not through it."""


@dataclass(frozen=True, eq=False)
class GapFinder:
    """One level's cloth in one frame, as it tells sides and distances.

    Attributes:
        mesh: The cloth.
        base: The upsampled cage [m]: distances that it has are not widened.
        order: Layer of each garment, the outer ones higher, NaN without one, shape (G,).
        outward: 1 where a garment's normals point outwards, -1 where inwards, shape (G,).
        thickness: Of each garment [m], shape (G,).
        stiffness: Of what keeps parts apart [N/m^3].
    """

    mesh: ClothMesh
    base: Float[Tensor, "vertices 3"]
    order: Float[Tensor, " garments"]
    outward: Float[Tensor, " garments"]
    thickness: Float[Tensor, " garments"]
    stiffness: float

    def gaps(
        self,
        pairs: Pairs,
        x: Float[Tensor, "vertices 3"],
        *,
        start: Float[Tensor, "vertices 3"],
        crossings: Crossings,
    ) -> Gaps:
        """Planes between parts, each on the side that it had at the start or, if ordered, that it should have.

        Args:
            pairs: What is near what.
            x: Positions [m].
            start: Positions whose sides are right, unless what crosses there says otherwise [m].
            crossings: What crosses at x.
        """
        corners = pairs.corners.long()
        garment = self.mesh.level.vertex_garment[corners[:, [0, 3]]].long()
        ordered = self.order[garment[:, 0]] != self.order[garment[:, 1]]
        ordered &= ~self.order[garment].isnan().any(dim=1)
        if crossings.count:
            # What crosses has no side to keep: it is drawn out.
            kept = ~self.mesh.crossed(crossings)[corners].any(dim=1) | ordered
            pairs = Pairs(pairs.corners[kept], pairs.weight[kept], pairs.face[kept])
            corners, garment, ordered = corners[kept], garment[kept], ordered[kept]
        way, at_input, at_start = ((pairs.weight.unsqueeze(2) * at[corners]).sum(dim=1) for at in (x, self.base, start))
        normal = torch.nn.functional.normalize(way, dim=1, eps=1e-30)
        wrong = (normal * at_start).sum(dim=1) < -TURNED * at_start.norm(dim=1)
        if bool(ordered.any()):
            wrong = torch.where(ordered, self._on_wrong_side(pairs, garment, normal, distance=way.norm(dim=1)), wrong)
        normal = torch.where(wrong.unsqueeze(1), -normal, normal)
        offset = self._offsets(garment, at_input.norm(dim=1), way.norm(dim=1), wrong=wrong, ordered=ordered)
        area = self.mesh.level.vertex_area[corners]
        share = torch.where(pairs.face, area[:, 0], area.amin(dim=1) / 3.0)
        return Gaps(pairs.corners, pairs.weight, normal.contiguous(), offset.contiguous(), self.stiffness * share)

    def _offsets(
        self, garment: Tensor, at_input: Tensor, now: Tensor, *, wrong: Tensor, ordered: Tensor
    ) -> Float[Tensor, " pairs"]:
        """How far apart pairs are to stay [m], by their distances in the input and now."""
        thickness = self.thickness[garment].mean(dim=1)
        offset = torch.minimum(thickness, torch.maximum(at_input, LEAST_OFFSET * thickness))
        offset = torch.where(at_input < WELDED * thickness, torch.zeros_like(offset), offset)
        offset = torch.where(wrong & ordered, thickness, offset)
        # What is on the wrong side comes back a little each round: all at once would tear the cloth.
        most = OUT * float(self.mesh.level.spacing.mean())
        return torch.where(wrong, torch.minimum(offset, most - now), offset)

    def _on_wrong_side(
        self, pairs: Pairs, garment: Tensor, normal: Tensor, *, distance: Tensor
    ) -> Bool[Tensor, " pairs"]:
        """Whether the outer of two ordered garments lies inside the inner one, and nowhere nearer outside it."""
        # A vertex-face pair has one corner first, an edge-edge pair two.
        split = torch.where(pairs.face, 1, 2).unsqueeze(1)
        is_first = torch.arange(4, device=normal.device).unsqueeze(0) < split
        cosine = self._cosine_outwards(pairs, garment, normal, is_first=is_first)
        met = pairs.corners.long() * len(self.order) + torch.where(is_first, garment[:, 1:], garment[:, :1])
        outside = torch.where(cosine > FRONTAL, distance, torch.full_like(distance, torch.inf))
        nearest = distance.new_full((self.mesh.level.vertex_count * len(self.order),), torch.inf)
        nearest.scatter_reduce_(0, met.reshape(-1), outside.repeat_interleave(4), "amin")
        return (cosine < -FRONTAL) & (distance < nearest[met].amin(dim=1))

    def _cosine_outwards(
        self, pairs: Pairs, garment: Tensor, normal: Tensor, *, is_first: Tensor
    ) -> Float[Tensor, " pairs"]:
        """Of the way from the inner to the outer one of two ordered garments with the inner one's outward normal."""
        order = self.order[garment]
        first_is_outer = order[:, 0] > order[:, 1]
        side = self.mesh.normals().to(normal)[pairs.corners.long()]
        inner = torch.where(first_is_outer.unsqueeze(1), ~is_first, is_first)
        out = (side * inner.unsqueeze(2)).sum(dim=1)
        out = torch.nn.functional.normalize(out, dim=1, eps=1e-30)
        owner = torch.where(first_is_outer, garment[:, 1], garment[:, 0])
        cosine = (out * normal).sum(dim=1) * self.outward[owner]
        return torch.where(first_is_outer, cosine, -cosine)
