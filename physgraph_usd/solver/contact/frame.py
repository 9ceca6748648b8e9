"""One frame's contact for the solve of a level: bodies and cloth together."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.crossings import Crossings, Pierced, all_crossings, crossings
from ..deadline import is_over
from ..forces.seam import Seam
from ..level import Level, Placed
from .apart import drawn_apart
from .bodies import FrameBodies, LevelBodies
from .cloth import ClothContact, LevelContact
from .cloth_mesh import ClothMesh
from .repair import repaired_cage
from .report import measured, swallowed
from .settings import ContactSettings
from .tangles import Tangles

STALLED = 4
"""Number of rounds or passes whose progress decides whether more follow: of untangling, and of moving out of bodies."""
PAYS = 0.1
"""Least fraction of the cloth in bodies that `STALLED` passes must move out for more to follow: at a slower pace, over
forty passes would follow. A suit in a random pose made 30 passes with 3.5% less cloth in its body after them."""


class FrameContact:
    """Contact of a group with bodies and cloth in one frame."""

    def __init__(
        self,
        levels: Sequence[Level],
        coarse: Float[Tensor, "coarse 3"],
        *,
        bodies: FrameBodies | None,
        cloth: ClothContact,
        thickness: Sequence[float],
        settings: ContactSettings,
        seams: Sequence[Seam | None] = (),
        given_up: Bool[Tensor, " coarse"] | None = None,
    ) -> None:
        """Take the frame.

        Args:
            coarse: Cage positions [m], recentred.
            bodies: The bodies, or None without bodies.
            thickness: Thickness of each garment's cloth [m].
            settings: Contact settings, with the stiffness in SI.
            seams: The seam of each level, None for a level without seams; () for no seams at all.
            given_up: Mask of the pieces of the cage that the last frame gave up; None for none.
        """
        self._last_given_up = given_up
        self._levels, self._coarse, self._settings = tuple(levels), coarse, settings
        self._bodies, self._cloth, self._seams = bodies, cloth, seams
        thick = torch.tensor(thickness, dtype=coarse.dtype)
        self._thickness, self._gap = thick.to(coarse.device), float(thick.mean())
        self._views: dict[int, LevelContact] = {}

    @property
    def aim(self) -> Float[Tensor, "coarse 3"]:
        """The cage followed by the fine cloth [m]: the input, repaired between overlapping parts of a body.

        Crossings of the cage are removed if all of them can be: the guide would draw cloth through itself.
        """
        return self._aimed[0]

    @property
    def untangled(self) -> Float[Tensor, "coarse 3"]:
        """The cage with pieces moved back to their side of the cloth [m]: the start of a cold frame."""
        return self._aimed[1]

    @cached_property
    def _cage(self) -> tuple[ClothMesh, Crossings, LevelBodies | None, Pierced, Tensor | None]:
        """The cage's mesh, crossings, view of the bodies, crossings with bodies, and vertices inside each body."""
        cage, bodies, x = self._levels[0], self._bodies, self._coarse.double()
        mesh = self._cloth.mesh(cage, self._seam_at(cage), bodies, itself=self._settings.cloth == "pairs")
        contours, pierced = all_crossings(mesh.parts, x if bodies is None else torch.cat([x, bodies.points]))
        if bodies is None:
            return mesh, contours, None, pierced, None
        view = LevelBodies(cage, bodies, mesh.pieces)
        inside = view.inside(self._coarse, pierced)
        return mesh, contours, view, pierced, inside if bool(inside.any()) else None

    @cached_property
    def given_up(self) -> Bool[Tensor, " coarse"] | None:
        """Mask of the pieces of the cage that the last frame gave up and that still cross; None without any.

        Cloth that the last frame solved is never given up because of a crossing of the cage.
        """
        if self._last_given_up is None or not (self.crossed and self._last_given_up.any()):
            return None
        mesh, contours, *_ = self._cage
        given_up = mesh.padded(self._last_given_up)
        tangled = Tangles.find(mesh, contours, torch.zeros_like(given_up)).label >= 0
        return mesh.pieces_with(given_up & tangled, over=0.0)

    def after_cage(self, x: Float[Tensor, "coarse 3"]) -> FrameContact:
        """This contact without the pieces that are mostly tangled in the cage x [m] of a cold frame."""
        tangled = self.at(self._levels[0]).tangled_pieces(x)
        if tangled is None:
            return self
        out = copy(self)
        out.given_up, out._views = tangled, {}
        return out

    @cached_property
    def _repaired(self) -> Float[Tensor, "coarse 3"]:
        """The cage, repaired between overlapping parts of a body [m]."""
        mesh, _, bodies, _, inside = self._cage
        if bodies is None or inside is None:
            return self._coarse
        return repaired_cage(self._levels[0], self._coarse, bodies=bodies, inside=inside, mesh=mesh)

    @cached_property
    def _aimed(self) -> tuple[Float[Tensor, "coarse 3"], Float[Tensor, "coarse 3"]]:
        """`aim` and `untangled`."""
        seam, aim = self._seam_at(self._levels[0]), self._repaired
        mesh, contours, *_ = self._cage
        contours = contours if aim is self._coarse else crossings(mesh.parts, aim)
        queried = None if self.given_up is None else ~self.given_up
        if queried is not None:
            contours = contours.where(queried[mesh.corners_of(contours)].any(dim=1))
        apart, remaining = drawn_apart(mesh, aim, contours, gap=self._gap, queried=queried)
        pair = (aim if remaining else apart), apart
        aim, apart = (points if seam is None or points is self._coarse else seam.closed(points) for points in pair)
        return aim, apart

    @property
    def swallowed(self) -> list[tuple[float, str]]:
        """As `report.swallowed` of the cage; empty without bodies."""
        _, _, bodies, _, inside = self._cage
        return [] if bodies is None else swallowed(bodies, self._coarse, inside)

    @property
    def crossed(self) -> bool:
        """True if the cage crosses itself."""
        return self._cage[1].count > 0

    def at(self, level: Level) -> LevelContact:
        """The cached view of one level. Distances at rest use the rest shape without ease.

        Vertices that depend only on given-up vertices of the cage are given up too.
        """
        if level.index not in self._views:
            level = self._levels[level.index]
            seam, base = self._seam_at(level), level.base.apply(self.aim)
            self._views[level.index] = LevelContact(
                self._cloth,
                level,
                base=base,
                thickness=self._thickness,
                settings=self._settings,
                bodies=self._bodies,
                seam=seam,
                given_up=None if self.given_up is None else _share_of(level, ~self.given_up) == 0.0,
                doubtful=None if self._doubtful is None else _share_of(level, self._doubtful) > 0.0,
            )
        return self._views[level.index]

    @cached_property
    def _doubtful(self) -> Bool[Tensor, " coarse"] | None:
        """Mask of the cage's vertices around crossings and repairs; None without any."""
        mesh, contours, _, pierced, inside = self._cage
        if not contours.count and not pierced.count and inside is None and self.aim is self._coarse:
            return None
        mask = mesh.crossed(contours) | mesh.crossed(pierced.crossings) | (self.aim != self._coarse).any(dim=1)
        mask = mask if inside is None else mask | inside.any(dim=0)
        return mesh.grown(mask, 1) if bool(mask.any()) else None

    def _seam_at(self, level: Level) -> Seam | None:
        return self._seams[level.index] if self._seams else None

    def finish(self, x: Placed) -> tuple[Placed, dict[str, object]]:
        """Move the solved cloth out of bodies.

        Returns:
            Positions [m], x itself if no vertex had to move; and the report of the moves.
        """
        moved: dict[str, object] = {}
        if self.aim is not self._coarse:
            moved["repaired"] = _moves(self._coarse, self.aim)
        # First all cloth inside is moved, then only vertices inside: an edge's way out may put a vertex inside.
        view = self.at(self._levels[-1])
        projected, passes = _out_of_bodies(view, x, vertices=False)
        out, vertex_passes = _out_of_bodies(view, projected, vertices=True)
        if self._bodies is not None:
            moved["projected"] = _moves(x, out) | {"passes": passes + vertex_passes}
        return out, moved

    def is_out(self, x: Placed) -> bool:
        """Whether no cloth is inside or through a body at x [m]."""
        return not any(self.at(self._levels[-1]).look(x).in_bodies)

    def measure(self, x: Float[Tensor, "vertices 3"]) -> tuple[dict[str, object], Bool[Tensor, " vertices"]]:
        """Penetrations and crossings before and after, as plain values, and a mask of the vertices of crossing cloth.

        Args:
            x: The result [m].
        """
        view, level = self.at(self._levels[-1]), self._levels[-1]
        before, smooth = (view.closed(base.apply(self._coarse)) for base in (level.base, level.smooth_base))
        return measured(view, before, x, smooth=smooth)


def _moves(start: Tensor, end: Tensor) -> dict[str, object]:
    """Number of displaced vertices and largest displacement, given start and end positions [m], shape (V, 3)."""
    if end is start:
        return {"vertices": 0, "largest_mm": 0.0}
    shifts = (end - start).norm(dim=1)
    return {"vertices": int((shifts > 0).sum()), "largest_mm": round(1e3 * float(shifts.max()), 4)}


def _out_of_bodies(view: LevelContact, start: Placed, *, vertices: bool) -> tuple[Placed, int]:
    """Positions moved safely out of bodies [m], the start itself if no cloth had to move, and the number of passes.

    In all passes together, a vertex moves at most the distance of its first push plus a mean edge: cloth pinched
    between two limbs, pushed out of each limb into the other in turns, would form spikes. Passes end if the last
    `STALLED` passes moved out less than `PAYS` of the cloth; the best positions are returned.

    Args:
        start: Positions [m].
        vertices: Whether only vertices inside are moved and counted, not edges and faces through a body.
    """

    def count(x: Placed) -> int:
        inside, crossings = view.look(x).in_bodies
        return inside if vertices else inside + crossings

    x, best, reach, left = start, start, None, [count(start)]
    while left[-1] and _pays(left) and not is_over():
        wanted = view.pushed_out(x, vertices=vertices)
        shift = wanted - start
        far = shift.norm(dim=1, keepdim=True)
        reach = far + view.mesh.level.rest_length.mean() if reach is None else reach
        x = view.moved(x, torch.where(far > reach, start + shift * (reach / far), wanted))
        best = x if count(x) < min(left) else best
        left.append(count(x))
    return best, len(left) - 1


def _pays(left: Sequence[int]) -> bool:
    """Whether more passes follow, given the numbers of cloth in bodies at the start and after each pass."""
    return len(left) <= STALLED or min(left[-STALLED:]) <= (1.0 - PAYS) * min(left[:-STALLED])


def _share_of(level: Level, mask: Bool[Tensor, " coarse"]) -> Float[Tensor, " vertices"]:
    """Sum of the weights of some cage vertices in each vertex of a level."""
    return torch.as_tensor(level.from_coarse @ mask.cpu().numpy().astype(np.float64), device=level.device)
