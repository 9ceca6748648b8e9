"""Contact of a group's cloth with itself: the planes that parts see in one another, and the mending of new crossings.

Penalty springs keep parts apart but promise nothing. The promise is `ClothView.mend`: positions are taken back towards
the last good ones round each edge that newly passes through a face, until no more edges do so than before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..forces.self_contact import Gaps, SelfContact
from ..level import Level
from ..scene import Garment
from .broad_phase import touch_one_another
from .cloth_mesh import ClothMesh, Crossings, Pairs
from .regions import Regions

LEAST_OFFSET = 0.25
"""Part of the thickness that parts keep where the input has them closer."""
ZONE = 2
"""Rings round a crossing of the input within which crossings may wander."""
SMOOTHINGS = 4
"""Passes that smooth the move round new crossings before any takes it back: a smooth move crosses nothing."""
MENDS = 8
"""Most passes in all; after them the whole group goes back."""
TURNED = 0.5
"""Cosine beyond which the way from one part to another counts as turned round since the input: one passed through."""
RETURN = 2.0
"""Most that parts on wrong sides are moved towards one another in a round, in thicknesses."""
FRONTAL = 0.3
"""Cosine to the inner garment's normal under which a pair of ordered garments is beside it, not through it."""


@dataclass(frozen=True, eq=False)
class ClothState:
    """Positions whose crossings are known.

    Attributes:
        x: Positions [m].
        crossings: What crosses there.
    """

    x: Float[Tensor, "vertices 3"]
    crossings: Crossings


class ClothContact:
    """What lasts over the shot: each level's hierarchy and patches, built when first needed."""

    def __init__(self, levels: Sequence[Level], garments: Sequence[Garment]) -> None:
        """Note which garments feel which.

        Args:
            levels: The group's levels, cage first.
            garments: The garments.
        """
        self._levels = tuple(levels)
        self.meets = np.array([[_meet(a, b) for b in garments] for a in garments], dtype=bool)
        order = [np.nan if garment.layer is None else float(garment.layer) for garment in garments]
        outward = [-1.0 if garment.flipped else 1.0 for garment in garments]
        device, dtype = levels[0].device, levels[0].dtype
        self.order, self.outward = (torch.tensor(each, dtype=dtype, device=device) for each in (order, outward))
        self._meshes: dict[int, ClothMesh] = {}
        self._regions: dict[int, Regions] = {}

    def mesh(self, level: Level) -> ClothMesh:
        """The hierarchy of a level."""
        if level.index not in self._meshes:
            self._meshes[level.index] = ClothMesh(level, self.meets)
        return self._meshes[level.index]

    def regions(self, level: Level) -> Regions:
        """The patches of a level."""
        if level.index not in self._regions:
            self._regions[level.index] = Regions(self._levels[0], level, self.meets)
        return self._regions[level.index]


def _meet(a: Garment, b: Garment) -> bool:
    """Whether two garments feel one another."""
    if a is b:
        return a.self_contact
    return touch_one_another(a, b)


class ClothView:
    """One level's cloth in one frame."""

    def __init__(
        self,
        lasting: ClothContact,
        level: Level,
        base: Float[Tensor, "vertices 3"],
        *,
        thickness: Float[Tensor, " garments"],
        stiffness: float,
    ) -> None:
        """Take the frame.

        Args:
            lasting: The group's cloth.
            level: The level.
            base: The upsampled cage [m]: distances that it has are not widened.
            thickness: Of each garment [m].
            stiffness: k_c [N/m^3].
        """
        self._lasting, self._level, self._base = lasting, level, base
        self._mesh, self._regions = lasting.mesh(level), lasting.regions(level)
        self._thickness, self._stiffness = thickness, stiffness
        self._reach = float(thickness.max()) + float(level.spacing.mean())

    @cached_property
    def before(self) -> ClothState:
        """The upsampled cage."""
        return self.look(self._base)

    @cached_property
    def _crossing(self) -> Bool[Tensor, " vertices"]:
        """Vertices of what crosses in the upsampled cage: sides have no meaning there."""
        crossing = torch.zeros_like(self._level.free[:, 0])
        crossing[self._mesh.corners_of(self.before.crossings).reshape(-1)] = True
        return crossing

    def look(self, x: Float[Tensor, "vertices 3"]) -> ClothState:
        """Find what crosses at x."""
        busy = self._regions.busy(x, 0.0)
        if not bool(busy.any()):
            none = torch.zeros(0, dtype=torch.int64, device=x.device)
            return ClothState(x, Crossings(none, none, 0))
        self._mesh.move(x)
        return ClothState(x, self._mesh.crossings(busy))

    def term(self, x: Float[Tensor, "vertices 3"]) -> SelfContact | None:
        """The force between parts that are near one another, or None where no parts are."""
        busy = self._regions.busy(x, self._reach)
        if not bool(busy.any()):
            return None
        self._mesh.move(x)
        pairs = self._mesh.pairs(busy, torch.full_like(self._level.spacing, self._reach))
        gaps = self._gaps(pairs, x)
        return SelfContact(self._level, gaps) if len(gaps.corners) else None

    def mend(self, x: Float[Tensor, "vertices 3"], good: ClothState | None = None) -> ClothState:
        """Smooth the move from good positions, and then take it back, wherever something crosses that did not.

        Args:
            x: Positions to mend [m].
            good: Positions to fall back on; the upsampled cage when None.

        Returns:
            Positions with no more crossings than the good ones have, and none away from where those had some; where
            that cannot be had, the positions found that have the fewest.
        """
        good = good or self.before
        zone = torch.zeros_like(self._crossing)
        zone[self._mesh.corners_of(good.crossings).reshape(-1)] = True
        zone = self._mesh.grown(zone, ZONE)
        best = state = self.look(x)
        shift = x - good.x
        for attempt in range(MENDS):
            corners = self._mesh.corners_of(state.crossings)
            new = ~zone[corners].all(dim=1)
            if state.crossings.count > good.crossings.count:
                new = torch.ones_like(new)
            if not bool(new.any()):
                return state
            back = torch.zeros_like(zone)
            back[corners[new].reshape(-1)] = True
            if attempt < SMOOTHINGS:
                shift = self._smoothed(shift, self._mesh.grown(back, attempt + 1), passes=4 << attempt)
            else:
                shift = shift * self._falling_off(back, attempt - SMOOTHINGS + 1)
            state = self.look(good.x + shift)
            best = min(best, state, key=lambda each: each.crossings.count)
        return best

    def measure(self, x: Float[Tensor, "vertices 3"]) -> dict[str, dict[str, int]]:
        """What crosses before and after, as plain values.

        Args:
            x: The result [m].
        """
        said = {}
        for name, state in (("before", self.before), ("after", self.look(x))):
            table = self._mesh.between(state.crossings)
            apart = int(np.triu(table, 1).sum())
            said[name] = {"crossings": state.crossings.count, "between_garments": apart}
        return said

    def _smoothed(self, shift: Tensor, where: Bool[Tensor, " vertices"], *, passes: int) -> Tensor:
        """Displacements averaged over neighbours again and again within a region; held outside."""
        which = np.flatnonzero((where & self._level.free[:, 0]).cpu().numpy())
        rows = self._mesh.beside[which]
        share = 1.0 / np.maximum(np.asarray(rows.sum(axis=1)), 1.0)
        values = shift.cpu().numpy().copy()
        for _ in range(passes):
            values[which] = share * (rows @ values)
        return torch.as_tensor(values).to(shift)

    def _falling_off(self, back: Bool[Tensor, " vertices"], rings: int) -> Float[Tensor, "vertices 1"]:
        """0 within some rings of given vertices, rising to 1 over as many rings more."""
        inner = self._mesh.grown(back, rings - 1)
        kept = 1.0 - inner.to(self._base)
        for step in range(rings):
            inner_next = self._mesh.grown(inner, 1)
            kept = torch.where(inner_next & ~inner, torch.full_like(kept, (step + 1) / (rings + 1)), kept)
            inner = inner_next
        return kept.unsqueeze(1)

    def _gaps(self, pairs: Pairs, x: Float[Tensor, "vertices 3"]) -> Gaps:
        """Planes between parts, each on the side that it has in the upsampled cage or, if ordered, that it should."""
        corners = pairs.corners.long()
        garment = self._level.vertex_garment.long()[corners[:, [0, 3]]]
        ordered = self._lasting.order[garment[:, 0]] != self._lasting.order[garment[:, 1]]
        ordered &= ~self._lasting.order[garment].isnan().any(dim=1)
        kept = ~self._crossing[corners].any(dim=1) | ordered
        pairs = Pairs(pairs.corners[kept], pairs.weight[kept], pairs.face[kept])
        corners, garment, ordered = corners[kept], garment[kept], ordered[kept]
        way, at_input = ((pairs.weight.unsqueeze(2) * at[corners]).sum(dim=1) for at in (x, self._base))
        normal = torch.nn.functional.normalize(way, dim=1, eps=1e-30)
        distance = at_input.norm(dim=1)
        turned = (normal * at_input).sum(dim=1) < -TURNED * distance
        wrong = torch.where(ordered, self._on_wrong_side(pairs, garment, normal), turned)
        normal = torch.where(wrong.unsqueeze(1), -normal, normal)
        thickness = self._thickness[garment].mean(dim=1)
        offset = torch.minimum(thickness, torch.maximum(distance, LEAST_OFFSET * thickness))
        offset = torch.where(wrong & ordered, thickness, offset)
        # What is on the wrong side comes back a little each round: all at once would tear the cloth.
        offset = torch.where(wrong, torch.minimum(offset, RETURN * thickness - way.norm(dim=1)), offset)
        area = self._level.vertex_area[corners]
        share = torch.where(pairs.face, area[:, 0], area.amin(dim=1) / 3.0)
        return Gaps(pairs.corners, pairs.weight, normal.contiguous(), offset.contiguous(), self._stiffness * share)

    def _on_wrong_side(self, pairs: Pairs, garment: Tensor, normal: Tensor) -> Bool[Tensor, " pairs"]:
        """Whether the outer of two ordered garments lies inside the inner one."""
        order = self._lasting.order[garment]
        first_is_outer = order[:, 0] > order[:, 1]
        side = self._mesh.normals().to(normal)[pairs.corners.long()]
        # A vertex-face pair has one corner first, an edge-edge pair two.
        split = torch.where(pairs.face, 1, 2).unsqueeze(1)
        is_first = torch.arange(4, device=normal.device).unsqueeze(0) < split
        inner = torch.where(first_is_outer.unsqueeze(1), ~is_first, is_first)
        out = (side * inner.unsqueeze(2)).sum(dim=1)
        out = torch.nn.functional.normalize(out, dim=1, eps=1e-30)
        owner = torch.where(first_is_outer, garment[:, 1], garment[:, 0])
        cosine = (out * normal).sum(dim=1) * self._lasting.outward[owner]
        cosine = torch.where(first_is_outer, cosine, -cosine)
        return cosine < -FRONTAL
