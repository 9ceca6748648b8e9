"""Contact of a group's cloth with itself and with bodies: near pairs, crossings, and the force that keeps parts apart.

Penalty springs carry the load but guarantee nothing; `promise` does. The springs act on all near pairs, not only on the
nearest: otherwise cloth that pushes at a place and is held at another would stay locked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.crossings import Crossings, Pierced, all_crossings, crossings
from ..collide.parts import Parts
from ..colliders.base import Solid
from ..forces.seam import Seam
from ..forces.self_contact import PairConstraints, SelfContact
from ..level import Level
from ..scene import Garment
from .bodies import Chords, FrameBodies, LevelBodies
from .broad_phase import touch_one_another
from .cloth_mesh import RINGS, ClothMesh
from .settings import ContactSettings
from .springs import ClothSprings, NearSprings
from .tangles import OUT, Tangles, chords_of, gaps_out


@dataclass(frozen=True, eq=False)
class ContactState:
    """Crossings at positions, with the tensor's version counter when they were found.

    Attributes:
        x: The positions [m].
        version: The counter.
        crossings: Crossings of cloth with cloth, without given-up cloth.
        tangles: These with the cloth around them; None without crossings and given-up cloth.
        pierced: Crossings of cloth and bodies; None without bodies.
        inside: The vertices inside each body, shape (B, V); None if none is.
    """

    x: Tensor
    version: int
    crossings: Crossings
    tangles: Tangles | None
    pierced: Pierced | None = None
    inside: Tensor | None = None

    @staticmethod
    def clean(x: Tensor) -> ContactState:
        """Positions at which nothing crosses."""
        return ContactState(x, x._version, Crossings.none(x.device), None)

    @property
    def in_bodies(self) -> tuple[int, int]:
        """Number of vertices inside bodies, and of crossings with bodies."""
        inside = 0 if self.inside is None else int(self.inside.sum())
        return inside, 0 if self.pierced is None else self.pierced.count

    def exempt(self, mesh: ClothMesh) -> Bool[Tensor, " vertices"] | None:
        """Mask of the cloth inside or through a body; None if none is."""
        if self.pierced is None or not any(self.in_bodies):
            return None
        some = mesh.grown(mesh.crossed(self.pierced.crossings), RINGS)
        return some if self.inside is None else some | self.inside.any(dim=0)


class ClothContact:
    """Contact data of a whole shot: each level's mesh, built on first use."""

    def __init__(self, levels: Sequence[Level], garments: Sequence[Garment]) -> None:
        """Build the table of garments in mutual contact.

        Args:
            levels: Levels of the group, cage first.
        """
        self.meets = np.array([[_meet(a, b) for b in garments] for a in garments], dtype=bool)
        self._meshes: dict[int, tuple[tuple[object, ...], ClothMesh]] = {}

    def mesh(self, level: Level, seam: Seam | None, bodies: FrameBodies | None, *, itself: bool) -> ClothMesh:
        """A level's mesh with the given seam and bodies; cached while these stay equal.

        Args:
            seam: Sewn vertices; None without seams.
            itself: False for cloth that is in contact with bodies only.
        """
        sewn = np.zeros((0, 2), np.int64) if seam is None else seam.pairs
        solids: tuple[Solid, ...] = () if bodies is None else bodies.solids
        meets = self.meets if itself else np.zeros_like(self.meets)
        if bodies is not None:
            feels = np.isfinite(bodies.offsets)
            none = np.zeros((len(solids), len(solids)), bool)
            meets = np.block([[meets, feels], [feels.T, none]])
        key = (sewn.tobytes(), meets.tobytes(), *map(id, solids))
        known, mesh = self._meshes.get(level.index, ((), None))
        if mesh is None or key != known:
            mesh = ClothMesh(level, meets, sewn, solids=solids)
            self._meshes[level.index] = key, mesh
        return mesh


def _meet(a: Garment, b: Garment) -> bool:
    """True if two garments are in contact; for a garment with itself, its self-contact setting."""
    if a is b:
        return a.self_contact
    return touch_one_another(a, b)


class ClothView:
    """One level's cloth and the bodies near it in one frame.

    Attributes:
        mesh: The level's mesh, sewn as in this frame.
        frame: The bodies of the frame, or None.
        given_up: Mask of the pieces of cloth that are given up; None for none. Parts whose vertices are all given up
            are not searched for contact or crossings with one another.
        keeps_sides: True if moves are promised to add no crossings of cloth with cloth.
        came_near: True if parts were near one another in any call of `terms`; None before the first call.
    """

    def __init__(
        self,
        lasting: ClothContact,
        level: Level,
        *,
        base: Float[Tensor, "vertices 3"],
        thickness: Float[Tensor, " garments"],
        settings: ContactSettings,
        bodies: FrameBodies | None = None,
        seam: Seam | None = None,
        given_up: Bool[Tensor, " vertices"] | None = None,
        doubtful: Bool[Tensor, " vertices"] | None = None,
    ) -> None:
        """Take the frame.

        Args:
            lasting: Contact data of the shot.
            base: The upsampled cage [m]; distances between parts in the cage are not widened.
            thickness: Thickness of each garment [m].
            settings: Contact settings, in SI.
            seam: Sewn vertices, which stay together; None without seams.
            given_up: As the attribute.
            doubtful: Mask of the vertices that the cage places near what crosses in it; None if unknown.
        """
        self.given_up = given_up
        self.keeps_sides = settings.cloth == "pairs" and bool(lasting.meets.any())
        self.mesh = lasting.mesh(level, seam, bodies, itself=self.keeps_sides)
        self._level, self._settings, self._thickness = level, settings, thickness
        self._base, self._seam, self.frame = base, seam, bodies
        self._doubtful, self._looked = doubtful, cast("ContactState | None", None)
        self.came_near: bool | None = None

    @cached_property
    def bodies(self) -> LevelBodies | None:
        """The level's view of the bodies; cloth between overlapping parts of a body in the cage stays there."""
        if self.frame is None:
            return None
        bodies = LevelBodies(self._level, self.frame, self.mesh.pieces)
        inside = self.at_base.inside
        return bodies if inside is None else bodies.losing(self._base, inside)

    @cached_property
    def at_base(self) -> ContactState:
        """Crossings, tangles and vertices inside bodies of the upsampled cage that is followed."""
        return self.of_cage(self._base)

    def of_cage(self, x: Float[Tensor, "vertices 3"]) -> ContactState:
        """As `look` for an upsampled cage [m], searched only around what crosses in the cage itself."""
        known_clean = self._doubtful is not None and not bool(self._doubtful.any())
        return ContactState.clean(x) if known_clean else self.found(x, self._doubtful)

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
    def corners(self) -> Float[Tensor, "corners 3"]:
        """Positions of the bodies' corners in this frame [m], float64."""
        return self._base.new_zeros((0, 3)).double() if self.frame is None else self.frame.points

    def with_bodies(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "all 3"]:
        """Positions of the cloth and of the bodies' corners [m], float64."""
        return torch.cat([x.double(), self.corners])

    @cached_property
    def springs(self) -> ClothSprings:
        """Finder of near pairs and contact springs in this frame."""
        return ClothSprings(self.mesh, self._base, self._thickness, self.frame)

    @cached_property
    def asked(self) -> Bool[Tensor, " all"] | None:
        """Mask of the vertices that are not given up, True for the bodies' corners; None for all of the cloth."""
        count = len(self.corners)
        return None if self.given_up is None else torch.nn.functional.pad(~self.given_up, (0, count), value=True)

    def crossings(self, x: Float[Tensor, "vertices 3"]) -> Crossings:
        """Crossings at x [m], without given-up cloth; cached for the same tensor until its version changes."""
        return self.look(x).crossings

    def look(self, x: Tensor) -> ContactState:
        """Cached crossings, tangles and vertices inside bodies at x."""
        if self._looked is None or self._looked.x is not x or self._looked.version != x._version:
            self._looked = self.found(x)
        return self._looked

    def found(self, x: Tensor, some: Bool[Tensor, " vertices"] | None = None) -> ContactState:
        """Crossings, tangles and vertices inside bodies at x, of the given vertices; of all when None."""
        asked = self.asked if some is None else self.padded(some if self.given_up is None else some & ~self.given_up)
        bodies = None if self.frame is None else LevelBodies(self._level, self.frame, self.mesh.pieces)
        pierced = inside = None
        if bodies is None:
            found = crossings(self.parts, x, asked)
        else:
            found, pierced = all_crossings(self.parts, self.with_bodies(x), asked)
            inside = bodies.inside(x, pierced)
            inside = inside if bool(inside.any()) else None
        lost = torch.zeros_like(self._level.free[:, 0]) if self.given_up is None else self.given_up
        if self.given_up is not None:
            kept = ~lost[self.mesh.corners_of(found)].all(dim=1)
            found = Crossings(found.edge[kept], found.face[kept])
        tangles = Tangles.find(self.mesh, found, lost) if found.count or self.given_up is not None else None
        return ContactState(x, x._version, found, tangles, pierced, inside)

    def tangles(self, x: Float[Tensor, "vertices 3"]) -> Tangles | None:
        """Tangles at x [m]: crossings and the cloth around them; None without crossings and given-up cloth."""
        return self.look(x).tangles

    def exempt(self, x: Float[Tensor, "vertices 3"]) -> Bool[Tensor, " all"] | None:
        """Mask of the cloth inside, through or on a body at x [m], False for the bodies' corners; None if none is."""
        return self.padded(self.look(x).exempt(self.mesh))

    def in_bodies(self, x: Float[Tensor, "vertices 3"]) -> tuple[int, int]:
        """Number of vertices inside bodies, and of crossings with bodies, at x [m]."""
        return self.look(x).in_bodies

    def _within(self, x: Tensor) -> tuple[Tensor, Chords | None]:
        """The vertices inside each body, and the places inside on edges and faces whose corners are outside."""
        looked, bodies = self.look(x), self.bodies
        assert bodies is not None
        none = torch.zeros((len(bodies.frame.touching), len(x)), dtype=torch.bool, device=x.device)
        inside = none if looked.inside is None else looked.inside
        return inside, chords_of(self.mesh, looked.pierced, self.with_bodies(x), inside) if looked.pierced else None

    def pushed_out(self, x: Float[Tensor, "vertices 3"], *, vertices: bool = False) -> Float[Tensor, "vertices 3"]:
        """As `LevelBodies.pushed_out`, or for vertices alone; x [m] itself if no cloth is inside or through a body."""
        if self.bodies is None or not any(self.in_bodies(x)):
            return x
        inside, chords = self._within(x)
        return self.bodies.pushed_out(x, inside, None if vertices else chords)

    def padded(self, some: Bool[Tensor, " vertices"] | None) -> Bool[Tensor, " all"] | None:
        """A mask of vertices with False for the bodies' corners."""
        return None if some is None else torch.nn.functional.pad(some, (0, len(self.corners)))

    def is_clean(self, x: Float[Tensor, "vertices 3"]) -> bool:
        """Whether nothing crosses at x [m], neither cloth, but where it is given up, nor bodies."""
        return self.look(x).crossings.count == 0 and self.exempt(x) is None

    def remember(self, x: Float[Tensor, "vertices 3"], given_up: Tangles | None = None) -> None:
        """Record that nothing crosses at x [m] but given-up cloth, as after a safe move from such positions."""
        self._looked = replace(ContactState.clean(x), tangles=given_up)

    def terms(self, x: Float[Tensor, "vertices 3"]) -> tuple[SelfContact, ...]:
        """Contact forces with bodies and between near cloth at x [m], with crossings drawn apart; () without any."""
        looked, at = self.look(x), self.with_bodies(x)
        inside = None if looked.inside is None else self.padded(looked.inside.any(dim=0))
        near = self.springs.find(at, self.springs.near(x, at, asked=self.asked, inside=inside).pairs)
        near, with_body, touching = self.springs.sided(near, self.exempt(x))
        pushes = self.springs.constraints(near.where(with_body), at, self._settings.stiffness)
        if self.bodies is not None and (any(self.in_bodies(x)) or bool(touching.any())):
            inside, chords = self._within(x)
            pushes = pushes.with_more(self.bodies.pulls(x, inside | touching, chords))
        pushes = pushes.sharing_room(x)
        gaps = self._gaps(x, near.where(~with_body), at)
        found, tangles = looked.crossings, looked.tangles
        found = found if tangles is None else tangles.hopeful(found)
        if found.count:
            step, stiffness = OUT * float(self._level.spacing.mean()), self._settings.stiffness
            gaps = gaps.with_more(gaps_out(self.mesh, found, x, step=step, stiffness=stiffness))
        self.came_near = bool(self.came_near) or len(gaps.corners) > 0
        named = (("contact", pushes), ("self_contact", gaps))
        return tuple(SelfContact(self._level, each, name) for name, each in named if len(each.corners))

    def _gaps(self, x: Tensor, near: NearSprings, at: Tensor) -> PairConstraints:
        """Springs between all near parts of the cloth that do not cross."""
        tangles = self.tangles(x)
        if tangles is not None:
            corners = near.near.corners.long()
            kept = ~self.mesh.crossed(self.crossings(x))[corners].any(dim=1)
            near = near.where(kept & ~tangles.given_up[corners].all(dim=1))
        return self.springs.constraints(near, at, self._settings.stiffness)
