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
from ..collide.pairs import Reach
from ..collide.parts import Parts
from ..collide.search import near_parts
from ..colliders.base import Solid
from ..forces.seam import Seam
from ..forces.self_contact import PairConstraints, SelfContact
from ..level import Level
from ..scene import Garment
from .bodies import ON_SURFACE, Chords, FrameBodies, LevelBodies
from .broad_phase import touch_one_another
from .cloth_mesh import ClothMesh
from .settings import ContactSettings
from .springs import HALF, MARGIN, ClothSprings, NearSprings
from .tangles import OUT, Tangles, chords_of, gaps_out

BESIDE = 1
"""Rings around crossings with a body within which cloth may pass through it."""


class ClothContact:
    """Contact data of a whole shot: each level's mesh, built on first use."""

    def __init__(self, levels: Sequence[Level], garments: Sequence[Garment]) -> None:
        """Build the table of garments in mutual contact.

        Args:
            levels: Levels of the group, cage first.
            garments: The garments.
        """
        self.meets = np.array([[_meet(a, b) for b in garments] for a in garments], dtype=bool)
        self._meshes: dict[int, tuple[tuple[object, ...], ClothMesh]] = {}

    def mesh(self, level: Level, seam: Seam | None, bodies: FrameBodies | None, *, itself: bool) -> ClothMesh:
        """A level's mesh with the given seam and bodies; cached while these stay equal.

        Args:
            level: The level.
            seam: Sewn vertices; None without seams.
            bodies: The bodies of the frame, or None.
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
            mesh = ClothMesh(level, meets, sewn, solids)
            self._meshes[level.index] = key, mesh
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
    pierced: Pierced | None = None
    inside: Tensor | None = None
    touching: Tensor | None = None


def _clean(x: Tensor) -> _Looked:
    """Positions at which nothing crosses."""
    return _Looked(x, x._version, Crossings.none(x.device), None)


class ClothView:
    """One level's cloth and the bodies near it in one frame.

    Attributes:
        mesh: The level's mesh, sewn as in this frame.
        frame: The bodies of the frame, or None.
        given_up: Mask of the vertices of tangles that are given up, None without such tangles. Parts whose vertices are
            all given up are not searched for contact or crossings with one another.
        keeps_sides: True if moves are promised to add no crossings of cloth with cloth.
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
        bodies: FrameBodies | None = None,
        seam: Seam | None = None,
        given_up: Bool[Tensor, " vertices"] | None = None,
        is_clean: bool = False,
    ) -> None:
        """Take the frame.

        Args:
            lasting: Contact data of the shot.
            level: The level.
            base: The upsampled cage [m]; distances between parts in the cage are not widened.
            thickness: Thickness of each garment [m].
            settings: Contact settings, in SI.
            bodies: The bodies of the frame, or None.
            seam: Sewn vertices, which stay together; None without seams.
            given_up: As the attribute.
            is_clean: Whether the upsampled cage is known to cross nothing.
        """
        self.given_up = given_up
        self.keeps_sides = settings.cloth == "pairs" and bool(lasting.meets.any())
        self.mesh = lasting.mesh(level, seam, bodies, itself=self.keeps_sides)
        self._level, self._settings, self._thickness = level, settings, thickness
        self._base, self._seam, self.frame = base, seam, bodies
        self._base_is_clean, self._looked = is_clean, cast("_Looked | None", None)
        self.came_near: bool | None = None

    @cached_property
    def bodies(self) -> LevelBodies | None:
        """The level's view of the bodies; cloth between overlapping parts of a body in the cage stays there."""
        if self.frame is None:
            return None
        bodies = LevelBodies(self._level, self.frame, self.mesh.pieces)
        inside = self._at_base.inside
        return bodies if inside is None else bodies.losing(self._base, inside)

    @cached_property
    def _at_base(self) -> _Looked:
        """Crossings, tangles and vertices inside bodies of the upsampled cage that is followed."""
        return _clean(self._base) if self._base_is_clean else self._found(self._base)

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
        none = self._base.new_zeros((0, 3)).double()
        return none if self.frame is None else self.frame.points

    def with_bodies(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "all 3"]:
        """Positions of the cloth and of the bodies' corners [m], float64."""
        return torch.cat([x.double(), self.corners])

    @cached_property
    def _owner(self) -> Tensor:
        """Garment of each vertex, then number of each body's corners as further garments."""
        sizes = [len(each.points) for each in (() if self.frame is None else self.frame.solids)]
        bodies = torch.arange(len(sizes)).repeat_interleave(torch.tensor(sizes, dtype=torch.int64))
        own = self._level.vertex_garment.long()
        return torch.cat([own, bodies.to(own) + len(self._level.spans)])

    @cached_property
    def _keep(self) -> Tensor:
        """Distance kept by two garments, or by a garment and a body [m]."""
        count = len(self._level.spans)
        mean = 0.5 * (self._thickness.unsqueeze(0) + self._thickness.unsqueeze(1))
        if self.frame is None:
            return mean
        offsets = torch.as_tensor(self.frame.offsets).to(mean)
        out = mean.new_zeros((count + offsets.shape[1],) * 2)
        out[:count, :count], out[:count, count:], out[count:, :count] = mean, offsets, offsets.T
        return out

    @cached_property
    def _springs(self) -> ClothSprings:
        """Contact spring finder of this frame."""
        return ClothSprings(self.mesh, self._base, self.corners, self._owner, self._keep)

    @cached_property
    def near(self) -> Reach:
        """Search radii of contact springs: half the distance kept, and half of `MARGIN` edges, a vertex [m]."""
        play = 0.5 * MARGIN * self._level.spacing.double()
        thickness = 0.5 * self._thickness.double()
        radius = thickness[self._level.vertex_garment.long()] + play
        if self.frame is not None:
            beyond = self._keep[: len(thickness), len(thickness) :].double() - thickness.unsqueeze(1)
            of_body = beyond.amax(dim=0).clamp_min(0.0) + play.max()
            radius = torch.cat([radius, of_body[self._owner[len(play) :] - len(thickness)]])
            play = torch.nn.functional.pad(play, (0, len(radius) - len(play)))
        return Reach(radius, play, HALF)

    @cached_property
    def asked(self) -> Bool[Tensor, " all"] | None:
        """Mask of the vertices that are not given up, True for the bodies' corners; None for all of the cloth."""
        return None if self.given_up is None else ~self.padded(self.given_up)

    def crossings(self, x: Float[Tensor, "vertices 3"]) -> Crossings:
        """Crossings at x [m], without given-up cloth; cached for the same tensor until its version changes."""
        return self._look(x).crossings

    def inside(self, x: Float[Tensor, "vertices 3"]) -> Bool[Tensor, "bodies vertices"] | None:
        """The vertices inside each body at x [m]; None if none is."""
        return self._look(x).inside

    def _look(self, x: Tensor) -> _Looked:
        """Cached crossings, tangles and vertices inside bodies at x."""
        if self._looked is None or self._looked.x is not x or self._looked.version != x._version:
            self._looked = self._found(x)
        return self._looked

    def _found(self, x: Tensor) -> _Looked:
        """Crossings, tangles and vertices inside bodies at x."""
        bodies = None if self.frame is None else LevelBodies(self._level, self.frame, self.mesh.pieces)
        pierced = inside = None
        if bodies is None:
            found = crossings(self.parts, x, self.asked)
        else:
            found, pierced = all_crossings(self.parts, self.with_bodies(x), self.asked)
            inside = bodies.inside(x, pierced)
            inside = inside if bool(inside.any()) else None
        lost = torch.zeros_like(self._level.free[:, 0]) if self.given_up is None else self.given_up
        if self.given_up is not None:
            kept = ~lost[self.mesh.corners_of(found)].all(dim=1)
            found = Crossings(found.edge[kept], found.face[kept])
        tangles = Tangles.find(self.mesh, found, lost) if found.count or self.given_up is not None else None
        return _Looked(x, x._version, found, tangles, pierced, inside)

    def tangles(self, x: Float[Tensor, "vertices 3"]) -> Tangles | None:
        """Tangles at x [m]: crossings and the cloth around them; None without crossings and given-up cloth."""
        return self._look(x).tangles

    def exempt(self, x: Float[Tensor, "vertices 3"]) -> Bool[Tensor, " all"] | None:
        """Mask of the cloth inside, through or on a body at x [m], False for the bodies' corners; None if none is."""
        looked = self._look(x)
        if looked.pierced is None or (looked.inside is None and not looked.pierced.count):
            return self.padded(looked.touching)
        some = self.mesh.grown(self.mesh.crossed(looked.pierced.crossings), BESIDE)
        some = some if looked.inside is None else some | looked.inside.any(dim=0)
        return self.padded(some if looked.touching is None else some | looked.touching)

    def in_bodies(self, x: Float[Tensor, "vertices 3"]) -> int:
        """Number of vertices inside bodies, and of crossings with bodies, at x [m]."""
        looked = self._look(x)
        inside = 0 if looked.inside is None else int(looked.inside.sum())
        return inside + (0 if looked.pierced is None else looked.pierced.count)

    def _within(self, x: Tensor) -> tuple[Tensor, Chords | None]:
        """The vertices inside each body, and the places inside on edges and faces whose corners are outside."""
        looked, bodies = self._look(x), self.bodies
        assert bodies is not None
        none = torch.zeros((len(bodies.frame.touching), len(x)), dtype=torch.bool, device=x.device)
        inside = none if looked.inside is None else looked.inside
        return inside, chords_of(self.mesh, looked.pierced, self.with_bodies(x), inside) if looked.pierced else None

    def _on_bodies(self, near: NearSprings) -> Bool[Tensor, "bodies vertices"]:
        """The vertices on the faces of each body; no shortest vector tells where they belong, but the face's normal."""
        count, pairs = self._level.vertex_count, near.near
        on = pairs.face & (pairs.way.norm(dim=1) < ON_SURFACE) & (pairs.corners[:, 0] < count)
        corners = pairs.corners[on].long()
        bodies = 0 if self.frame is None else len(self.frame.touching)
        out = torch.zeros((bodies, count), dtype=torch.bool, device=pairs.corners.device)
        out[self._owner[corners[:, 3]] - len(self._level.spans), corners[:, 0]] = True
        return out

    def pushed_out(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """As `LevelBodies.pushed_out`; x itself if no cloth is inside or through a body."""
        if self.bodies is None or not self.in_bodies(x):
            return x
        return self.bodies.pushed_out(x, *self._within(x))

    def padded(self, some: Bool[Tensor, " vertices"] | None) -> Bool[Tensor, " all"] | None:
        """A mask of vertices with False for the bodies' corners."""
        return None if some is None else torch.nn.functional.pad(some, (0, len(self.corners)))

    def is_clean(self, x: Float[Tensor, "vertices 3"]) -> bool:
        """Whether nothing crosses at x [m], neither cloth, but where it is given up, nor bodies."""
        return self._look(x).crossings.count == 0 and self.exempt(x) is None

    def remember(self, x: Float[Tensor, "vertices 3"], given_up: Tangles | None = None) -> None:
        """Record that nothing crosses at x [m] but given-up cloth, as after a safe move from such positions."""
        self._looked = replace(_clean(x), tangles=given_up)

    def terms(self, x: Float[Tensor, "vertices 3"]) -> tuple[SelfContact, ...]:
        """Contact forces with bodies and between near cloth at x [m], with crossings drawn apart; () without any."""
        looked, at = self._look(x), self.with_bodies(x)
        pairs = near_parts(self.parts, at, self.near, asked=self.asked, inside=self.exempt(x))
        near = self._springs.find(at, pairs)
        with_body = near.near.corners.amax(dim=1) >= self._level.vertex_count
        pushes = self._springs.constraints(near.where(with_body), at, self._settings.stiffness)
        touching = self._on_bodies(near.where(with_body))
        if bool(touching.any()):
            self._looked = replace(looked, touching=touching.any(dim=0))
        if self.bodies is not None and (self.in_bodies(x) or bool(touching.any())):
            inside, chords = self._within(x)
            pushes = pushes.with_more(self.bodies.pulls(x, inside | touching, chords))
        gaps = self._gaps(x, near.where(~with_body), at)
        found, tangles = looked.crossings, looked.tangles
        found = found if tangles is None else tangles.hopeful(found)
        if found.count:
            step, stiffness = OUT * float(self._level.spacing.mean()), self._settings.cloth_stiffness
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
        return self._springs.constraints(near, at, self._settings.cloth_stiffness)

    def measure(
        self, before: Float[Tensor, "vertices 3"], x: Float[Tensor, "vertices 3"]
    ) -> tuple[dict[str, object], Bool[Tensor, " vertices"]]:
        """Penetrations and crossings before and after, as plain values, and the vertices of crossing cloth after.

        Positions that safe moves reached from a start without crossings have none and are not searched again.

        Args:
            before: The upsampled cage [m].
            x: The result [m].
        """
        first, last = self._at_base if torch.equal(before, self._base) else self._found(before), self._look(x)
        said: dict[str, object] = {}
        if self.bodies is not None and self.frame is not None:
            sides = ((before, first), (x, last))
            given = [(at, looked.inside, looked.pierced) for at, looked in sides]
            said["bodies"] = self.bodies.measured(*given)
        kept, tangles = last.crossings, last.tangles
        kept = kept if tangles is None else tangles.hopeful(kept)
        found = kept if self.given_up is None else crossings(self.parts, x)
        if self.keeps_sides:
            base = first.crossings if self.given_up is None else crossings(self.parts, before)
            crossed = {
                name: {"crossings": each.count, "between_garments": int(np.triu(self.mesh.between(each), 1).sum())}
                for name, each in (("before", base), ("after", found))
            }
            crossed["after"]["given_up"] = found.count - kept.count
            near = bool(self.came_near) or any(each["crossings"] for each in crossed.values())
            said["cloth"] = {"near": near, **crossed}
        return said, self.mesh.crossed(found)
