"""Contact of a group's cloth with itself: what is near, what crosses, and the force that keeps parts apart.

Penalty springs carry the load and promise nothing; `promise` does. They see all pairs of parts that are near, not the
nearest alone: cloth that pushes with one part and is held by another would stay locked there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.crossings import Crossings, crossings
from ..collide.detector import Detector
from ..collide.narrow_phase import Reach
from ..collide.parts import Parts
from ..forces.seam import Seam
from ..forces.self_contact import PairConstraints, SelfContact
from ..level import Level
from ..scene import Garment
from .broad_phase import touch_one_another
from .cloth_mesh import ClothMesh
from .settings import ContactSettings
from .springs import HALF, MARGIN, ClothSprings
from .tangles import Tangles, gaps_out

TANGLED = 2
"""Rings round what crosses to which nothing is promised but that no more crosses."""
OUT = 0.5
"""How far crossing parts are moved past one another in a round, in mean edges."""


class ClothContact:
    """What lasts over the shot: each level's mesh, built when first needed."""

    def __init__(self, levels: Sequence[Level], garments: Sequence[Garment]) -> None:
        """Note which garments feel which.

        Args:
            levels: The group's levels, cage first.
            garments: The garments.
        """
        self.meets = np.array([[_meet(a, b) for b in garments] for a in garments], dtype=bool)
        self._meshes: dict[int, tuple[bytes, ClothMesh]] = {}

    def mesh(self, level: Level, seam: Seam | None) -> ClothMesh:
        """A level's mesh, sewn as given; the last one where that is sewn alike."""
        sewn = np.zeros((0, 2), np.int64) if seam is None else seam.pairs
        key, mesh = self._meshes.get(level.index, (b"", None))
        if mesh is None or key != sewn.tobytes():
            mesh = ClothMesh(level, self.meets, sewn)
            self._meshes[level.index] = sewn.tobytes(), mesh
        return mesh


def _meet(a: Garment, b: Garment) -> bool:
    """Whether two garments feel one another."""
    if a is b:
        return a.self_contact
    return touch_one_another(a, b)


@dataclass(frozen=True, eq=False)
class _Looked:
    """What crosses at positions, and how often these had been written to."""

    x: Tensor
    version: int
    crossings: Crossings
    tangles: Tangles | None


class ClothView:
    """One level's cloth in one frame.

    Attributes:
        mesh: The level's mesh, sewn as in this frame.
        keeps_sides: Whether nothing passes through anything: not by spheres, which are no promise.
        came_near: Whether parts were near one another wherever `term` looked; None where it never did.
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
    ) -> None:
        """Take the frame.

        Args:
            lasting: The group's cloth.
            level: The level.
            base: The upsampled cage [m]: distances that it has are not widened.
            thickness: Of each garment [m].
            settings: How contact is solved, in SI.
            seam: What is sewn together, and stays so; or None without seams.
        """
        self.mesh, self.keeps_sides = lasting.mesh(level, seam), settings.cloth == "pairs"
        self._lasting, self._level, self._settings, self._thickness = lasting, level, settings, thickness
        self._base, self._seam = base, seam
        self._looked: _Looked | None = None
        self.came_near: bool | None = None

    @property
    def parts(self) -> Parts:
        """What may touch what, sewn as in this frame."""
        return self.mesh.parts

    def closed(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions with their seams closed [m]."""
        return x if self._seam is None else self._seam.closed(x)

    @property
    def gap(self) -> float:
        """Distance at which cloth is laid over cloth [m]."""
        return float(self._thickness.mean())

    @cached_property
    def detector(self) -> Detector:
        """What detects in this frame."""
        return Detector(self.parts, self.near)

    @cached_property
    def _springs(self) -> ClothSprings:
        """What says which near parts have a spring."""
        return ClothSprings(self._level, self._base, self._thickness, self._settings.cloth_stiffness)

    @cached_property
    def near(self) -> Reach:
        """How near parts are that may push one another before they are looked for again."""
        play = 0.5 * MARGIN * self._level.spacing.double()
        thickness = 0.5 * self._thickness.double()[self._level.vertex_garment.long()]
        return Reach(thickness + play, play, HALF)

    def crossings(self, x: Float[Tensor, "vertices 3"]) -> Crossings:
        """What crosses at x [m]; the answer is kept for the same tensor, unless it was written to since."""
        return self._look(x).crossings

    def _look(self, x: Tensor) -> _Looked:
        """What is known of x, looked for where it is not known."""
        if self._looked is None or self._looked.x is not x or self._looked.version != x._version:
            found = crossings(self.parts, x, detector=self.detector)
            corners = self.mesh.corners_of(found)
            tangles = Tangles.find(self.mesh, corners, rings=TANGLED) if found.count else None
            self._looked = _Looked(x, x._version, found, tangles)
        return self._looked

    def tangles(self, x: Float[Tensor, "vertices 3"]) -> Tangles | None:
        """What crosses at x [m] and what lies round it; None where nothing does."""
        return self._look(x).tangles

    def remember(self, x: Float[Tensor, "vertices 3"]) -> None:
        """Take it that nothing crosses at x [m]: it was reached safely from where nothing did."""
        self._looked = _Looked(x, x._version, Crossings.none(x.device), None)

    def term(self, x: Float[Tensor, "vertices 3"], *, all_crossings: bool = False) -> SelfContact | None:
        """The force between parts that are near one another, or None where no parts are; what crosses is drawn out.

        Args:
            x: Positions [m].
            all_crossings: Whether even tangles that are hopeless are drawn out.
        """
        found, tangles = self.crossings(x), self.tangles(x)
        gaps = self._gaps(x, found, all_crossings=all_crossings)
        found = found if tangles is None or all_crossings else tangles.hopeful(found)
        if found.count:
            step, stiffness = OUT * float(self._level.spacing.mean()), self._settings.cloth_stiffness
            gaps = gaps.with_more(gaps_out(self.mesh, found, x, step=step, stiffness=stiffness))
        self.came_near = bool(self.came_near) or len(gaps.corners) > 0
        return SelfContact(self._level, gaps) if len(gaps.corners) else None

    def _gaps(self, x: Tensor, found: Crossings, *, all_crossings: bool) -> PairConstraints:
        """The springs between all parts that are near and do not cross."""
        near = self._springs.find(x, self.detector.near(x))
        if found.count:
            corners, tangles = near.near.corners.long(), self.tangles(x)
            kept = ~self.mesh.crossed(found)[corners].any(dim=1)
            kept &= tangles is None or all_crossings or ~tangles.given_up[corners].all(dim=1)
            near = near.where(kept)
        return self._springs.constraints(near)

    def measure(
        self, before: Float[Tensor, "vertices 3"] | None, x: Float[Tensor, "vertices 3"]
    ) -> tuple[dict[str, dict[str, int]], Bool[Tensor, " vertices"]]:
        """Crossings before and after, as plain values, and the vertices of those after.

        Positions that safe moves reached from a start without crossings have none and are not searched again.

        Args:
            before: The upsampled cage [m]; None where the cage does not cross itself, and nothing is searched.
            x: The result [m].
        """
        found = self.crossings(x)
        first = Crossings.none(x.device) if before is None else crossings(self.parts, before)
        said = {
            name: {"crossings": each.count, "between_garments": int(np.triu(self.mesh.between(each), 1).sum())}
            for name, each in (("before", first), ("after", found))
        }
        return said, self.mesh.crossed(found)
