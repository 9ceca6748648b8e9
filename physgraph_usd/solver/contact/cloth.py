"""A level's contact in a frame: near pairs, crossings, forces that keep parts apart, and moves without new crossings.

Penalty springs carry the load; safe moves (`promise`) guarantee that nothing newly crosses. Springs act on all near
pairs, not only on the nearest pairs: otherwise cloth that pushes at one point and is blocked at another would lock.

All searches work on the corners of the cloth, then of the bodies, as one array in float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.crossings import Crossings, Pierced, all_crossings
from ..colliders.base import Solid
from ..forces.seam import Seam
from ..forces.self_contact import SelfContact
from ..level import Level, Placed
from ..scene import Garment
from .bodies import Chords, FrameBodies, LevelBodies
from .broad_phase import touch_one_another
from .cloth_mesh import RINGS, ClothMesh
from .promise import Promise
from .settings import ContactSettings
from .springs import ClothSprings
from .tangles import OUT, Tangles, chords_of, gaps_out

KEPT_GAP = 0.06
"""Gap below which gaps shrink by at most a tenth a move, as a fraction of the thickness."""

_Begin = tuple[Tensor, Tensor | None]
"""Corners in the start frame [m], and a mask of the exempt cloth in it, or None."""


@dataclass(frozen=True, eq=False)
class ContactState:
    """Crossings at positions.

    Attributes:
        x: Positions of the cloth [m].
        version: The version counter of x when its crossings were found.
        corners: Positions of the cloth, then of the bodies' corners [m], float64.
        crossings: Crossings of cloth with cloth, without given-up cloth.
        tangles: The crossings with the cloth around; None without crossings and given-up cloth.
        pierced: Crossings of cloth and bodies.
        inside: Mask of the vertices inside each body, shape (B, V); None without such vertices.
        exempt: Mask of the cloth inside or through a body, False for the bodies' corners; None without such cloth.
    """

    x: Tensor
    version: int
    corners: Float[Tensor, "all 3"]
    crossings: Crossings
    tangles: Tangles | None
    pierced: Pierced
    inside: Bool[Tensor, "bodies vertices"] | None = None
    exempt: Bool[Tensor, " all"] | None = None

    @staticmethod
    def clean(x: Tensor, corners: Tensor, given_up: Tangles | None = None) -> ContactState:
        """The state of positions without crossings outside given-up cloth."""
        return ContactState(x, x._version, corners, Crossings.none(x.device), given_up, Pierced.none(x.device))

    @property
    def in_bodies(self) -> tuple[int, int]:
        """Number of vertices inside bodies, and of crossings with bodies."""
        return 0 if self.inside is None else int(self.inside.sum()), self.pierced.count

    @cached_property
    def hopeful(self) -> Crossings:
        """Crossings of cloth with cloth outside hopeless tangles."""
        return self.crossings if self.tangles is None else self.tangles.hopeful(self.crossings)

    @property
    def is_clean(self) -> bool:
        """Whether no cloth crosses cloth or bodies, given-up cloth excepted."""
        return self.crossings.count == 0 and self.exempt is None


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
        """A level's mesh with a seam and bodies; cached while both stay equal.

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
        last_key, mesh = self._meshes.get(level.index, ((), None))
        if mesh is None or key != last_key:
            mesh = ClothMesh(level, meets, sewn, solids=solids)
            self._meshes[level.index] = key, mesh
        return mesh


class LevelContact:
    """One level's contact with bodies and cloth in one frame.

    Attributes:
        mesh: The level's cloth and the bodies, sewn as in this frame.
        seam: Sewn vertices, which stay together; None without seams.
        frame: The bodies of the frame, or None.
        given_up: Mask of the pieces of cloth that are given up, False for the bodies' corners; None for none. Parts
            whose vertices are all given up are not searched for contact or crossings with one another.
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
        doubtful: Bool[Tensor, " vertices"] | None,
    ) -> None:
        """Take the frame.

        Args:
            base: The upsampled cage [m]; distances between parts in the cage are not widened.
            thickness: Thickness of each garment [m].
            settings: Contact settings, in SI.
            doubtful: Mask of the vertices that follow crossing parts of the cage; None if the cage has no crossings.
        """
        self.keeps_sides = settings.cloth == "pairs" and bool(lasting.meets.any())
        self.mesh = lasting.mesh(level, seam, bodies, itself=self.keeps_sides)
        self.seam, self.frame = seam, bodies
        self.given_up, self._doubtful = (
            None if mask is None else self.mesh.padded(mask) for mask in (given_up, doubtful)
        )
        self._queried = None if self.given_up is None else ~self.given_up
        self._base, self._settings, self._thickness = base, settings, thickness
        self._all_bodies = None if bodies is None else LevelBodies(level, bodies, self.mesh.pieces)
        self._looked = tuple[ContactState, ...]()
        self.came_near: bool | None = None

    @cached_property
    def bodies(self) -> LevelBodies | None:
        """The level's view of the bodies; cloth between overlapping parts of a body in the cage stays there."""
        bodies, inside = self._all_bodies, self.at_base.inside
        return bodies if bodies is None or inside is None else bodies.with_buried(self._base, inside)

    @cached_property
    def at_base(self) -> ContactState:
        """The state of the upsampled cage that the cloth follows."""
        return self.of_cage(self._base)

    @cached_property
    def _springs(self) -> ClothSprings:
        """Finder of near pairs and contact springs in this frame."""
        return ClothSprings(self.mesh, self._base, self._thickness, self.frame)

    def closed(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions with their seams closed [m]."""
        return x if self.seam is None else self.seam.closed(x)

    def of_cage(self, x: Float[Tensor, "vertices 3"]) -> ContactState:
        """As `look` for an upsampled cage [m], searched only around crossings of the cage itself.

        With given-up cloth all is searched, so that crossings of that cloth with bodies count here as in `look`.
        """
        if self._doubtful is None:
            return ContactState.clean(x, self._corners(x))
        return self.detect(x, self._doubtful if self.given_up is None else None)

    def look(self, x: Float[Tensor, "vertices 3"]) -> ContactState:
        """Crossings at x [m]; cached for the last two tensors until their versions change."""
        known = next((state for state in self._looked if state.x is x and state.version == x._version), None)
        return self._keep(self.detect(x)) if known is None else known

    def _keep(self, state: ContactState) -> ContactState:
        """The state, kept for `look`."""
        self._looked = (state, *self._looked[:1])
        return state

    def remember(self, x: Float[Tensor, "vertices 3"], given_up: Tangles | None = None) -> None:
        """Record that only given-up cloth crosses at x [m], as after a safe move from a clean state."""
        self._keep(ContactState.clean(x, self._corners(x), given_up))

    def _corners(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "all 3"]:
        """Corners of the cloth, then of the bodies in this frame [m], float64."""
        return x.double() if self.frame is None else torch.cat([x.double(), self.frame.points])

    def detect(self, x: Tensor, vertices: Bool[Tensor, " all"] | None = None) -> ContactState:
        """Crossings, tangles and cloth inside bodies at x [m], of some vertices or, with None, of all; not cached."""
        mesh, corners, given_up = self.mesh, self._corners(x), self.given_up
        queried = self._queried if vertices is None else vertices if self._queried is None else vertices & self._queried
        crossings, pierced = all_crossings(mesh.parts, corners, queried)
        inside = None if self._all_bodies is None else self._all_bodies.inside(x, pierced)
        inside = inside if inside is not None and bool(inside.any()) else None
        tangles = None
        if crossings.count or given_up is not None:
            given_up = mesh.padded(torch.zeros_like(x[:, 0], dtype=torch.bool)) if given_up is None else given_up
            crossings = crossings.where(~given_up[mesh.corners_of(crossings)].all(dim=1))
            tangles = Tangles.find(mesh, crossings, given_up)
        exempt = None
        if pierced.count or inside is not None:
            exempt = mesh.grown(mesh.crossed(pierced.crossings), RINGS)
            exempt = mesh.padded(exempt if inside is None else exempt | inside.any(dim=0))
        return ContactState(x, x._version, corners, crossings, tangles, pierced, inside, exempt)

    def tangled_pieces(self, x: Float[Tensor, "vertices 3"]) -> Bool[Tensor, " vertices"] | None:
        """Mask of the connected pieces of cloth with most of their vertices in tangles at x [m]; None without any."""
        tangles = self.look(x).tangles
        return None if tangles is None else self.mesh.pieces_with(tangles.label >= 0, over=0.5)

    def pushed_out(
        self, x: Float[Tensor, "vertices 3"], state: ContactState | None = None, *, vertices: bool = False
    ) -> Float[Tensor, "vertices 3"]:
        """As `LevelBodies.pushed_out`, or for vertices alone; x [m] itself if no cloth is inside or through a body.

        Args:
            state: The state of x; None to look.
        """
        state = self.look(x) if state is None else state
        if self.bodies is None or not any(state.in_bodies):
            return x
        inside, chords = _within(self.mesh, self.bodies, state)
        return self.bodies.pushed_out(x, inside, None if vertices else chords)

    def terms(self, x: Float[Tensor, "vertices 3"]) -> tuple[SelfContact, ...]:
        """Contact forces with bodies and between near cloth at x [m], with crossings drawn apart; () without any."""
        state, springs, stiffness = self.look(x), self._springs, self._settings.stiffness
        at, tangles = state.corners, state.tangles
        inside = None if state.inside is None else self.mesh.padded(state.inside.any(dim=0))
        near = springs.find(at, springs.near(x, at, queried=self._queried, inside=inside).pairs)
        near, with_body, touching = springs.sided(near, state.exempt)
        every = springs.constraints(near, at, stiffness)
        pushes, gaps = every.where(with_body), every.where(~with_body)
        if self.bodies is not None and (any(state.in_bodies) or touching is not None):
            within, chords = _within(self.mesh, self.bodies, state)
            within = within if touching is None else within | touching
            pushes = pushes.with_more(self.bodies.pulls(x, within, chords))
        if tangles is not None:  # Crossing parts have no side to keep.
            corners = gaps.corners.long()
            sided = ~self.mesh.crossed(state.crossings)[corners].any(dim=1)
            gaps = gaps.where(sided & ~tangles.given_up[corners].all(dim=1))
        if state.hopeful.count:
            step = OUT * float(self.mesh.level.spacing.mean())
            gaps = gaps.with_more(gaps_out(self.mesh, state.hopeful, x, step=step, stiffness=stiffness))
        self.came_near = bool(self.came_near) or len(gaps.corners) > 0
        named = (("contact", pushes.sharing_room(x)), ("self_contact", gaps))
        return tuple(SelfContact(self.mesh.level, pairs, name) for name, pairs in named if len(pairs.corners))

    def moved(self, start: Placed, wanted: Float[Tensor, "vertices 3"]) -> Placed:
        """Positions as close to the wanted as is safe [m], seams closed; without seams ``wanted`` itself if safe.

        In a tangle of the start, cloth may pass through itself as long as the tangle's number of crossings does not
        grow. Cloth inside a body may pass through bodies.
        """
        return self._moved(start, self.closed(wanted), None)

    def carried(
        self, start: Placed, wanted: Float[Tensor, "vertices 3"], inside: Bool[Tensor, " vertices"] | None
    ) -> Placed:
        """As `moved` from the start frame, with moving bodies, which pass through cloth that cannot give way.

        Args:
            inside: Mask of the cloth inside a body in the start frame; None for none.
        """
        before = None if self.frame is None else self.frame.before
        exempt = None if inside is None else self.mesh.padded(inside)
        start_frame = None if before is None else (torch.cat([start.double(), before]), exempt)
        return self._moved(start, self.closed(wanted), start_frame)

    def drawn(self, start: Placed, wanted: Float[Tensor, "vertices 3"]) -> Placed:
        """As `moved`, but the number of crossings in a tangle may grow for a while."""
        tangles = self.look(start).tangles
        return self._go(start, self.closed(wanted), None if tangles is None else tangles.label, None)[0]

    def _moved(self, start: Placed, wanted: Tensor, start_frame: _Begin | None) -> Placed:
        """As `moved`; ``start_frame`` holds the corners and the exempt cloth in the start frame, or is None."""
        state = self.look(start)
        tangles = state.tangles
        if tangles is None or bool(tangles.hopeless.all()):
            x, proved = self._go(start, wanted, None if tangles is None else tangles.label, start_frame)
            if proved and state.is_clean:
                self.remember(x, tangles)
            return x
        free = tangles.label.clone()
        x, _ = self._go(start, wanted, free, start_frame)
        for hold_all in (False, True):  # First only the worse tangles are held, then all.
            worse = tangles.worse(self.look(x).crossings)
            if not bool(worse.any()):
                break
            free[~tangles.given_up if hold_all else worse] = -1
            x, _ = self._go(start, wanted, free, start_frame)
        return x

    @cached_property
    def _kept_gap(self) -> float:
        """Gap kept by safe moves [m]."""
        return KEPT_GAP * float(self._thickness.min())

    def _go(self, start: Placed, aim: Tensor, tangle: Tensor | None, start_frame: _Begin | None) -> tuple[Placed, bool]:
        """As `moved`, without a promise for pairs in one tangle; and whether all pairs with bodies are proved apart."""
        state, end, springs = self.look(start), self._corners(aim), self._springs
        begin, exempt = start_frame or (state.corners, state.exempt)
        near = springs.cached(start) if start_frame is None else None
        promise = Promise(self.mesh, self.seam, self._kept_gap, tangle, exempt)
        if near is None and tangle is None and exempt is None:
            blocking = springs.blocking(begin, end, aim, floor=promise.floor, queried=self._queried)
        else:
            queried = (end != begin).any(dim=1) if self._queried is None else self._queried
            blocking = promise.blocking(begin, end, queried, near=near)
        x, proved = promise.safe_corners(begin, end, blocking, halved=start_frame is not None, near=near)
        return Placed(aim if x is end else x[: len(aim)].to(aim)), proved


def _within(mesh: ClothMesh, bodies: LevelBodies, state: ContactState) -> tuple[Tensor, Chords]:
    """The vertices inside each body, and the points inside on edges and faces whose corners are outside."""
    size = len(bodies.frame.touching), len(state.x)
    inside = state.x.new_zeros(size, dtype=torch.bool) if state.inside is None else state.inside
    return inside, chords_of(mesh, state.pierced, state.corners, inside)


def _meet(a: Garment, b: Garment) -> bool:
    """True if two garments are in contact; for a garment with itself, its self-contact setting."""
    return a.self_contact if a is b else touch_one_another(a, b)
