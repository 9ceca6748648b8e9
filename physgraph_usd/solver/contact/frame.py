"""One frame's contact for the solve of a level: bodies and cloth together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.crossings import Crossings, crossings
from ..deadline import is_over
from ..forces.contact import Contact
from ..forces.seam import Seam
from ..forces.self_contact import SelfContact
from ..integrate.base import Preconditioner
from ..integrate.metric import Metric
from ..level import Level, Placed, unhindered
from .apart import drawn_apart
from .bodies import FrameBodies, LevelBodies
from .cloth import ClothContact, ClothView
from .cloth_mesh import ClothMesh
from .metric import HeldMetric
from .promise import Promise
from .push_out import moves, projected, pushed_out
from .repair import repaired_cage
from .settings import ContactSettings
from .tangles import Tangles

FLOOR = 0.06
"""Gap below which gaps shrink by at most a tenth a move, as a fraction of the thickness."""
PUSHES = 4
"""Most rounds of pushing cloth out of bodies and moving it there safely."""
Touch = Contact | SelfContact
"""A contact force term."""


@dataclass(frozen=True, eq=False)
class LevelContact:
    """One level's contact with bodies and cloth.

    Attributes:
        bodies: The level's view of the bodies, or None without bodies.
        cloth: The level's view of the cloth, or None without cloth contact.
        seam: Sewn vertices, or None without seams.
        promise: Safe moves of the cloth, or None if cloth may cross cloth.
    """

    bodies: LevelBodies | None
    cloth: ClothView | None
    seam: Seam | None = None
    promise: Promise | None = None

    def metric(
        self,
        plain: Metric,
        terms: Sequence[Touch],
        x: Float[Tensor, "vertices 3"],
        *,
        known: Preconditioner | None = None,
    ) -> Metric | HeldMetric:
        """The level's metric with the contact stiffness at x [m]; the known metric while its stiffness suffices."""
        plain = plain if self.seam is None else plain.merged(self.seam.label)
        if not terms:
            return plain
        last = known if isinstance(known, HeldMetric) else None
        stiff = 3.0 * torch.stack([term.diagonal(x) for term in terms]).sum(dim=0)
        if last is None or self.comes_apart(x):
            return HeldMetric(plain, stiff) if bool((stiff > 0).any()) else plain  # Things are near, but none pushes.
        return last if last.serves(stiff) else HeldMetric(plain, torch.maximum(stiff, last.stiff))

    def crosses(self, x: Float[Tensor, "vertices 3"]) -> bool:
        """True if cloth crosses cloth at positions x [m] and the cloth has a promise."""
        return self.promise is not None and self.promise.view.crossings(x).count > 0

    def comes_apart(self, x: Float[Tensor, "vertices 3"]) -> bool:
        """True if x has crossings in hopeful tangles."""
        tangles = None if self.promise is None else self.promise.view.tangles(x)
        return tangles is not None and not bool(tangles.hopeless.all())

    def begun(self, x: Float[Tensor, "vertices 3"]) -> Placed:
        """Start positions of a level [m], seams closed. Crossings here come from the input or from the level below."""
        return Placed(self.closed(x))

    def laid_back(self, x: Placed) -> Placed:
        """Positions with cut-off pieces moved back to their side of the cloth [m], if fewer parts cross then."""
        if self.promise is None or not self.comes_apart(x):
            return x
        view = self.promise.view
        out = drawn_apart(view.mesh, x, view.crossings(x), gap=view.gap, asked=view.asked)[0]
        return x if out is x else Placed(self.closed(out))

    def remember(self, x: Float[Tensor, "vertices 3"]) -> None:
        """As `ClothView.remember`, if there is a promise."""
        if self.promise is not None:
            self.promise.view.remember(x)

    def terms(self, x: Float[Tensor, "vertices 3"]) -> tuple[LevelContact, tuple[Touch, ...]]:
        """The view from positions x [m], and the contact forces there, empty without contact."""
        seen, body = (None, None) if self.bodies is None else self.bodies.seen(x)
        cloth = None if self.cloth is None else self.cloth.term(x)
        return replace(self, bodies=seen), tuple(term for term in (body, cloth) if term is not None)

    def closed(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions with their seams closed [m]."""
        return x if self.seam is None else self.seam.closed(x)

    def moved(self, x: Placed, wanted: Float[Tensor, "vertices 3"]) -> Placed:
        """Positions as close to the wanted positions as is safe [m], seams closed."""
        wanted = self.closed(wanted)
        return unhindered(wanted) if self.promise is None else self.promise.move(x, wanted)

    def drawn(self, x: Placed, wanted: Float[Tensor, "vertices 3"]) -> Placed:
        """As `moved`, but the number of crossings in a tangle may grow for a while."""
        wanted = self.closed(wanted)
        return unhindered(wanted) if self.promise is None else self.promise.draw(x, wanted)

    def out_of_bodies(self, x: Placed) -> tuple[Placed, int]:
        """Positions moved safely out of bodies [m], x itself if no vertex had to move, and the number of passes.

        Faces are not lifted over corners of bodies if all cloth is given up: lifts of layers that cross never end.
        """
        passes, bodies = 0, self.bodies
        lost = None if self.cloth is None else self.cloth.given_up
        push = projected if lost is None or not bool(lost.all()) else pushed_out
        for _ in range(PUSHES if bodies is not None else 0):
            assert bodies is not None
            bodies, out, more = push(bodies, x)
            start, x, passes = x, self.moved(x, out), passes + more
            if out is start or x is out or is_over():
                break
        return x, passes


class FrameContact:
    """Contact of a group with bodies and cloth in one frame."""

    def __init__(
        self,
        levels: Sequence[Level],
        coarse: Float[Tensor, "coarse 3"],
        *,
        bodies: FrameBodies | None,
        cloth: ClothContact | None,
        thickness: Sequence[float],
        settings: ContactSettings,
        seams: Sequence[Seam | None] = (),
        lost: Bool[Tensor, " coarse"] | None = None,
    ) -> None:
        """Take the frame.

        Args:
            levels: Levels of the group.
            coarse: Cage positions [m], recentred.
            bodies: The bodies, or None without bodies.
            cloth: The group's cloth, or None without cloth contact.
            thickness: Thickness of each garment's cloth [m].
            settings: Contact settings, with the stiffness in SI.
            seams: The seam of each level, None for a level without seams; () for no seams at all.
            lost: Mask of the cage's vertices that the last frame gave up; None for none.
        """
        self._lost = lost
        self._levels, self._coarse, self._settings = tuple(levels), coarse, settings
        self._bodies, self._cloth, self._seams = bodies, cloth, seams
        self._thickness = torch.tensor(thickness, dtype=coarse.dtype, device=coarse.device)
        self._views: dict[int, LevelContact] = {}

    @property
    def aim(self) -> Float[Tensor, "coarse 3"]:
        """The cage followed by the fine cloth [m]: the input, repaired between overlapping parts of a body.

        Crossings of the cage are removed if all of them can be: the guide would draw cloth through itself.
        """
        return self._aimed[0]

    @property
    def given_up(self) -> Bool[Tensor, " coarse"] | None:
        """Mask of the cage's vertices in tangles that are given up; None without such tangles."""
        return self._aimed[2]

    @cached_property
    def _aimed(self) -> tuple[Float[Tensor, "coarse 3"], bool | None, Bool[Tensor, " coarse"] | None]:
        """The cage to follow [m], True if the input has crossings or None if not searched, and `given_up`."""
        cage, out, crosses, lost = self._levels[0], self._coarse, None, None
        if self._cloth is None:
            return out, crosses, lost
        seam = self._seam_at(cage)
        mesh = self._cloth.mesh(cage, seam)
        if self._bodies is not None:
            out = repaired_cage(cage, out, bodies=self._bodies.at(cage, self._levels[-1]), mesh=mesh)
        if self._settings.cloth == "pairs":
            found = crossings(mesh.parts, out)
            crosses = found.count > 0 if out is self._coarse else None
            if found.count:
                tangles = Tangles.find(mesh, found, torch.zeros_like(cage.free[:, 0]))
                lost = tangles.giving_up(self._lost)
                lost = lost if bool(lost.any()) else None
            out = self._drawn_apart(mesh, out, found, None if lost is None else ~lost)
        return (out if seam is None or out is self._coarse else seam.closed(out)), crosses, lost

    def _drawn_apart(
        self, mesh: ClothMesh, x: Tensor, found: Crossings, asked: Bool[Tensor, " coarse"] | None
    ) -> Float[Tensor, "coarse 3"]:
        """The cage [m] without its crossings at vertices that are not given up, if all these can be removed."""
        if asked is not None:
            kept = asked[mesh.corners_of(found)].any(dim=1)
            found = Crossings(found.edge[kept], found.face[kept])
        apart, left = drawn_apart(mesh, x, found, gap=float(self._thickness.mean()), asked=asked)
        return apart if found.count and not left else x

    @property
    def depths(self) -> list[tuple[float, str]]:
        """As `FrameBodies.depths`; empty without bodies."""
        return [] if self._bodies is None else self._bodies.depths(self._levels[-1])

    @cached_property
    def crossed(self) -> bool:
        """True if the cage crosses itself."""
        cage, (_, known, lost) = self._levels[0], self._aimed
        if known is None:
            return lost is not None or self.at(cage).crosses(cage.base.apply(self._coarse))
        return known

    def at(self, level: Level) -> LevelContact:
        """The cached view of one level. Distances at rest use the rest shape without ease."""
        if level.index not in self._views:
            level = self._levels[level.index]
            bodies = None if self._bodies is None else self._bodies.at(level, self._levels[-1])
            base = level.base.apply(self.aim)
            seam = self._seam_at(level)
            bodies = None if bodies is None else replace(bodies.losing(base), seam=seam)
            cloth = promise = None
            if self._cloth is not None:
                own = {"base": base, "thickness": self._thickness, "settings": self._settings, "seam": seam}
                own["given_up"] = self._given_up_at(level)
                cloth = ClothView(self._cloth, level, **own)
                promise = Promise(cloth, FLOOR * float(self._thickness.min())) if cloth.keeps_sides else None
            self._views[level.index] = LevelContact(bodies, cloth, seam, promise)
        return self._views[level.index]

    def _given_up_at(self, level: Level) -> Bool[Tensor, " vertices"] | None:
        """Mask of a level's vertices that depend only on given-up vertices of the cage."""
        if self.given_up is None:
            return None
        kept = level.from_coarse @ (~self.given_up).cpu().numpy().astype(np.float64)
        return torch.as_tensor(kept == 0.0, device=level.device)

    @property
    def _is_clean(self) -> bool:
        """Whether the upsampled cage is known not to cross: its triangles lie in those of a cage that does not."""
        cage = self._levels[0]
        has_quads = len(cage.membrane) > len(cage.triangles)
        return not (has_quads or any(self._seams) or self.crossed)

    def _seam_at(self, level: Level) -> Seam | None:
        """The seam of a level."""
        return self._seams[level.index] if self._seams else None

    def finish(self, x: Placed) -> tuple[Placed, dict[str, object]]:
        """Move the solved cloth out of bodies.

        Returns:
            Positions [m], x itself if no vertex had to move; and the report of the moves.
        """
        moved: dict[str, object] = {}
        if self.aim is not self._coarse:
            shift = (self.aim - self._coarse).norm(dim=1)
            moved["repaired"] = {"vertices": int((shift > 0).sum()), "largest_mm": round(1e3 * float(shift.max()), 4)}
        out, passes = self.at(self._levels[-1]).out_of_bodies(x)
        if self._bodies is not None:
            moved["projected"] = moves(x, out, passes)
        return out, moved

    def measure(self, x: Float[Tensor, "vertices 3"]) -> tuple[dict[str, object], Bool[Tensor, " vertices"]]:
        """Penetrations and crossings before and after, as plain values, and a mask of the vertices of crossing cloth.

        Args:
            x: The result [m].
        """
        finest = self._levels[-1]
        view, crossing = self.at(finest), torch.zeros_like(finest.free[:, 0])
        base = finest.base.apply(self._coarse)
        said: dict[str, object] = {}
        if self._bodies is not None:
            said |= self._bodies.measure(finest, base, x, view=view.bodies)
        if view.cloth is not None:
            cloth, crossing = view.cloth.measure(None if self._is_clean else view.closed(base), x)
            near = view.cloth.came_near
            near = view.cloth.term(x) is not None if near is None else near
            said["cloth"] = {"near": near or any(each["crossings"] for each in cloth.values()), **cloth}
        return said, crossing
