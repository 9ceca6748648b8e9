"""Contact of a group's cloth with itself: near pairs, crossings, and the force that keeps parts apart.

Penalty springs carry the load but guarantee nothing; `promise` does. The springs act on all near pairs, not only on the
nearest: otherwise cloth that pushes at a place and is held at another would stay locked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.crossings import Crossings, crossings
from ..collide.pairs import Reach
from ..collide.parts import Parts
from ..collide.search import near_parts
from ..forces.seam import Seam
from ..forces.self_contact import PairConstraints, SelfContact
from ..level import Level
from ..scene import Garment
from .broad_phase import touch_one_another
from .cloth_mesh import ClothMesh
from .settings import ContactSettings
from .springs import HALF, MARGIN, ClothSprings
from .tangles import OUT, Tangles, gaps_out


class ClothContact:
    """Cloth contact data of a whole shot: each level's mesh, built on first use."""

    def __init__(self, levels: Sequence[Level], garments: Sequence[Garment]) -> None:
        """Build the table of garments in mutual contact.

        Args:
            levels: Levels of the group, cage first.
            garments: The garments.
        """
        self.meets = np.array([[_meet(a, b) for b in garments] for a in garments], dtype=bool)
        self._meshes: dict[int, tuple[bytes, ClothMesh]] = {}

    def mesh(self, level: Level, seam: Seam | None) -> ClothMesh:
        """A level's mesh with the given seam; cached while the sewn pairs stay equal."""
        sewn = np.zeros((0, 2), np.int64) if seam is None else seam.pairs
        key, mesh = self._meshes.get(level.index, (b"", None))
        if mesh is None or key != sewn.tobytes():
            mesh = ClothMesh(level, self.meets, sewn)
            self._meshes[level.index] = sewn.tobytes(), mesh
        return mesh


def _meet(a: Garment, b: Garment) -> bool:
    """True if two garments are in contact; for a garment with itself, its self-contact setting."""
    if a is b:
        return a.self_contact
    return touch_one_another(a, b)


@dataclass(frozen=True, eq=False)
class _Looked:
    """Crossings at positions, with the tensor's version counter when they were found."""

    x: Tensor
    version: int
    crossings: Crossings
    tangles: Tangles | None


class ClothView:
    """One level's cloth in one frame.

    Attributes:
        mesh: The level's mesh, sewn as in this frame.
        given_up: Mask of the vertices of tangles that are given up, None without such tangles. Parts whose vertices are
            all given up are not searched for contact or crossings.
        keeps_sides: True if moves are promised to add no crossings.
        came_near: True if parts were near one another in any call of `term`; None before the first call.
    """

    def __init__(
        self,
        lasting: ClothContact,
        level: Level,
        *,
        base: Float[Tensor, "vertices 3"],
        thickness: Float[Tensor, " garments"],
        settings: ContactSettings,
        seam: Seam | None = None,
        given_up: Bool[Tensor, " vertices"] | None = None,
    ) -> None:
        """Take the frame.

        Args:
            lasting: Cloth contact data of the shot.
            level: The level.
            base: The upsampled cage [m]; distances between parts in the cage are not widened.
            thickness: Thickness of each garment [m].
            settings: Contact settings, in SI.
            seam: Sewn vertices, which stay together; None without seams.
            given_up: As the attribute.
        """
        self.given_up = given_up
        self.mesh, self.keeps_sides = lasting.mesh(level, seam), settings.cloth == "pairs"
        self._lasting, self._level, self._settings, self._thickness = lasting, level, settings, thickness
        self._base, self._seam = base, seam
        self._looked: _Looked | None = None
        self.came_near: bool | None = None

    @property
    def parts(self) -> Parts:
        """Table of vertex, edge and face pairs that may be in contact, sewn as in this frame."""
        return self.mesh.parts

    def closed(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions with their seams closed [m]."""
        return x if self._seam is None else self._seam.closed(x)

    @property
    def gap(self) -> float:
        """Distance left between cloth and cloth when pieces are moved back [m]."""
        return float(self._thickness.mean())

    @cached_property
    def _springs(self) -> ClothSprings:
        """Contact spring finder of this frame."""
        return ClothSprings(self._level, self._base, self._thickness, self._settings.cloth_stiffness)

    @cached_property
    def near(self) -> Reach:
        """Search radii of contact springs: half the thickness, and half of `MARGIN` edges, a vertex [m]."""
        play = 0.5 * MARGIN * self._level.spacing.double()
        thickness = 0.5 * self._thickness.double()[self._level.vertex_garment.long()]
        return Reach(thickness + play, play, HALF)

    @property
    def asked(self) -> Bool[Tensor, " vertices"] | None:
        """Mask of the vertices that are not given up; None for all."""
        return None if self.given_up is None else ~self.given_up

    def crossings(self, x: Float[Tensor, "vertices 3"]) -> Crossings:
        """Crossings at x [m], without given-up cloth; cached for the same tensor until its version changes."""
        return self._look(x).crossings

    def _look(self, x: Tensor) -> _Looked:
        """Cached crossings and tangles at x."""
        if self._looked is None or self._looked.x is not x or self._looked.version != x._version:
            found = crossings(self.parts, x, self.asked)
            lost = torch.zeros_like(self.mesh.level.free[:, 0]) if self.given_up is None else self.given_up
            tangles = Tangles.find(self.mesh, found, lost) if found.count or self.given_up is not None else None
            self._looked = _Looked(x, x._version, found, tangles)
        return self._looked

    def tangles(self, x: Float[Tensor, "vertices 3"]) -> Tangles | None:
        """Tangles at x [m]: crossings and the cloth around them; None without crossings and given-up cloth."""
        return self._look(x).tangles

    def remember(self, x: Float[Tensor, "vertices 3"], given_up: Tangles | None = None) -> None:
        """Record that x [m] has no crossings outside given-up tangles, as after a safe move from such positions."""
        self._looked = _Looked(x, x._version, Crossings.none(x.device), given_up)

    def term(self, x: Float[Tensor, "vertices 3"]) -> SelfContact | None:
        """Contact force between near parts at x [m], with crossings drawn apart; None if no parts are near."""
        found, tangles = self.crossings(x), self.tangles(x)
        gaps = self._gaps(x, found)
        found = found if tangles is None else tangles.hopeful(found)
        if found.count:
            step, stiffness = OUT * float(self._level.spacing.mean()), self._settings.cloth_stiffness
            gaps = gaps.with_more(gaps_out(self.mesh, found, x, step=step, stiffness=stiffness))
        self.came_near = bool(self.came_near) or len(gaps.corners) > 0
        return SelfContact(self._level, gaps) if len(gaps.corners) else None

    def _gaps(self, x: Tensor, found: Crossings) -> PairConstraints:
        """Springs between all near parts that do not cross."""
        near = self._springs.find(x, near_parts(self.parts, x, self.near, asked=self.asked))
        tangles = self.tangles(x)
        if tangles is not None:
            corners = near.near.corners.long()
            kept = ~self.mesh.crossed(found)[corners].any(dim=1)
            kept &= ~tangles.given_up[corners].all(dim=1)
            near = near.where(kept)
        return self._springs.constraints(near)

    def measure(
        self, before: Float[Tensor, "vertices 3"] | None, x: Float[Tensor, "vertices 3"]
    ) -> tuple[dict[str, dict[str, int]], Bool[Tensor, " vertices"]]:
        """Crossings before and after, as plain values, and the vertices of those after.

        Positions that safe moves reached from a start without crossings have none and are not searched again.

        Args:
            before: The upsampled cage [m]; None if it is known not to cross.
            x: The result [m].
        """
        kept, tangles = self.crossings(x), self.tangles(x)
        kept = kept if tangles is None else tangles.hopeful(kept)
        found = kept if self.given_up is None else crossings(self.parts, x)
        first = Crossings.none(x.device) if before is None else crossings(self.parts, before)
        said = {
            name: {"crossings": each.count, "between_garments": int(np.triu(self.mesh.between(each), 1).sum())}
            for name, each in (("before", first), ("after", found))
        }
        said["after"]["given_up"] = found.count - kept.count
        return said, self.mesh.crossed(found)
