"""One frame's contact as the solve of a level sees it: bodies and cloth together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.sweep import Listed
from ..forces.contact import Contact
from ..forces.seam import Seam
from ..forces.self_contact import SelfContact, Spheres
from ..integrate.metric import Metric
from ..level import Level
from .bodies import FrameBodies, LevelBodies, moves
from .cloth import ClothContact, ClothView
from .cloth_mesh import ClothMesh
from .last_resort import FIRST, returned, taken_back, widened
from .mend import smoothed
from .metric import HeldMetric
from .promise import Promise
from .repair import repaired_cage
from .seams import Seams
from .settings import ContactSettings
from .squeeze import squeezed

FINISHES = 3
"""How often cloth is pushed along, mended and pushed out in turn, while more crosses than before bodies pushed."""
SQUEEZED = 2.0
"""Distance to which cloth is moved apart then, in thicknesses: what bodies push moves faces, whose middles sag."""
HOLDS = 6
"""How often more of what is between overlapping parts of a body is left there, while pushing it out makes it cross."""
MIXED = 4
"""Rings round what crosses in a warm start that start from the coarse levels instead; it fades over as many more."""
SMOOTHINGS = 8
"""Passes that smooth wrinkles of cloth between overlapping parts."""
FLOOR = 0.06
"""Of the thickness: gaps under it shrink by a tenth a move at most."""
PUSHES = 4
"""How often cloth that walks is pushed out of bodies and moved there in turn."""
Touch = Contact | SelfContact | Spheres
"""A term that stands for something near."""


@dataclass(eq=False)
class LevelContact:
    """One level's view of what it may touch.

    Attributes:
        bodies: Its view of the bodies, or None when there are none.
        cloth: Its view of the cloth, or None when cloth is not to touch cloth.
        rounds: How often in the level's steps pairs and planes are found anew.
        seam: What is sewn together, or None without seams.
        mended: Whether what was asked for last to be uncrossed had to be taken back.
    """

    bodies: LevelBodies | None
    cloth: ClothView | None
    rounds: int
    seam: Seam | None = None
    mended: bool = False
    promise: Promise | None = None
    target: Tensor | None = None
    _held: HeldMetric | None = None

    def metric(self, plain: Metric, terms: Sequence[Touch], x: Float[Tensor, "vertices 3"]) -> Metric | HeldMetric:
        """The metric of a level whose cloth is held by what touches at x [m]; the same one while it serves."""
        plain = plain if self.seam is None else plain.merged(self.seam.label)
        if not terms:
            return plain
        stiff = 3.0 * torch.stack([term.diagonal(x) for term in terms]).sum(dim=0)
        if self.tangled:
            return HeldMetric(plain, stiff, factored=False)
        if self._held is None and not bool((stiff > 0).any()):
            return plain  # Things are near, but nothing pushes yet.
        if self._held is None:
            self._held = HeldMetric(plain, stiff)
        elif not self._held.serves(stiff):
            self._held = HeldMetric(plain, torch.maximum(stiff, self._held.stiff))
        return self._held

    @property
    def tangled(self) -> bool:
        """Whether cloth crossed cloth where the terms were asked for last."""
        return self.cloth is not None and self.cloth.tangled

    def crosses(self, x: Float[Tensor, "vertices 3"]) -> bool:
        """Whether cloth crosses cloth at positions x [m]."""
        return self.cloth is not None and self.cloth.look(x).crossings.count > 0

    def terms(
        self, x: Float[Tensor, "vertices 3"], *, keep_pairs: bool = False, listed: Listed | None = None
    ) -> tuple[Touch, ...]:
        """The forces of what is near positions x [m]; empty where nothing is. Pairs are kept as by `ClothView.term`."""
        self.let_through(x)
        bodies = None if self.bodies is None else self.bodies.term(x)
        cloth = None if self.cloth is None else self.cloth.term(x, keep_pairs=keep_pairs, listed=listed)
        return tuple(term for term in (bodies, cloth) if term is not None)

    def look_in_folds(self, wanted: bool) -> None:
        """As `ClothView.look_in_folds`, where there is cloth."""
        if self.cloth is not None:
            self.cloth.look_in_folds(wanted)

    def closed(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions with their seams closed [m]."""
        return x if self.seam is None else self.seam.closed(x)

    def let_through(self, x: Tensor) -> None:
        """Let cloth at x [m] through bodies that are between it and its target."""
        if self.bodies is not None and self.target is not None:
            self.bodies.let_through(x, self.target)

    def moved(self, x: Tensor, wanted: Tensor, listed: Listed | None = None) -> Tensor:
        """Positions as near to wanted ones as is safe [m], seams closed."""
        wanted = self.closed(wanted)
        return wanted if self.promise is None else self.promise.move(x, wanted, listed=listed)

    def listed(self, x: Tensor, known: Listed | None) -> Listed | None:
        """As `Promise.listed`; None without cloth."""
        return None if self.promise is None else self.promise.listed(x, known)

    def uncrossed(
        self, x: Float[Tensor, "vertices 3"], start: Float[Tensor, "vertices 3"]
    ) -> Float[Tensor, "vertices 3"]:
        """Positions x [m], taken back towards the start where they cross; x itself if the start crosses too."""
        if self.cloth is None or not self.cloth.keeps_sides:
            return x
        good = self.cloth.look(start)
        out = x if good.crossings.count else self.cloth.mend(x, good).x
        self.mended = out is not x
        return out


class FrameContact:
    """What a group may touch in one frame."""

    def __init__(
        self,
        levels: Sequence[Level],
        coarse: Float[Tensor, "coarse 3"],
        *,
        bodies: FrameBodies | None,
        cloth: ClothContact | None,
        thickness: Sequence[float],
        settings: ContactSettings,
        seams: Seams | None = None,
    ) -> None:
        """Look at the upsampled cage.

        Args:
            levels: The group's levels.
            coarse: Cage positions [m], recentred.
            bodies: The bodies, or None when there are none.
            cloth: The group's cloth, or None when cloth is not to touch cloth.
            thickness: Of each garment's cloth [m].
            settings: How contact is solved, with k_c itself as its stiffness.
            seams: What the input has at one place, or None when nothing is.
        """
        self._levels, self._coarse, self._settings = tuple(levels), coarse, settings
        self._aim: Tensor | None = None
        self._held: Tensor | None = None
        self._bodies, self._cloth = bodies, cloth
        self._thickness = torch.tensor(thickness, dtype=coarse.dtype, device=coarse.device)
        self._views: dict[int, LevelContact] = {}
        self._seams = seams

    @property
    def aim(self) -> Float[Tensor, "coarse 3"]:
        """The cage that the fine cloth follows [m]: the input, but where that is pinched or crosses."""
        if self._aim is None:
            self._aim = self._coarse
            if self._cloth is not None:
                cage = self._levels[0]
                bodies = None if self._bodies is None else self._bodies.at(cage, self._levels[-1])
                repaired = repaired_cage(
                    cage,
                    self._coarse,
                    bodies=bodies,
                    mesh=self._cloth.mesh(cage),
                    gap=float(self._thickness.mean()),
                    crosses=self.crossed,
                )
                seam = self._seam_at(cage, self._coarse)
                self._aim = repaired if seam is None or repaired is self._coarse else seam.closed(repaired)
        return self._aim

    @property
    def crossed(self) -> bool:
        """Whether the cage crosses itself."""
        return self._crossed

    @cached_property
    def _crossed(self) -> bool:
        """The same, found once."""
        cage = self._levels[0]
        view = self._cloth_at(cage, cage.base.apply(self._coarse))
        return view is not None and view.before.crossings.count > 0

    def at(self, level: Level) -> LevelContact:
        """The view of one level, the same at each call."""
        if level.index not in self._views:
            bodies = None if self._bodies is None else self._bodies.at(level, self._levels[-1])
            base = level.base.apply(self.aim)
            seam, cloth = self._seam_at(level, base), self._cloth_at(level, base)
            if bodies is not None:
                bodies.seam = seam
                bodies.lose(base)
            if cloth is not None and level is self._levels[-1] and self._judge is not None:
                cloth.allowed = self._judge.before
            promise = None
            if cloth is not None and self._settings.promise:
                promise = Promise(cloth.parts, FLOOR * float(self._thickness.min()), cloth)
            self._views[level.index] = LevelContact(bodies, cloth, self._settings.rounds, seam, promise=promise)
        return self._views[level.index]

    @property
    def crowding(self) -> float:
        """Part of the finest vertices that have cloth near them in the upsampled cage; 1 where it crosses."""
        finest = self._levels[-1]
        view, base = self.at(finest), finest.base.apply(self.aim)
        term = None if view.cloth is None else view.cloth.term(base)
        if term is None or view.cloth is None:
            return 0.0
        return 1.0 if view.cloth.tangled else float(term.near(finest).to(base).mean())

    def mixed(self, x: Float[Tensor, "vertices 3"], other: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions of the finest level [m], and other ones round what crosses there."""
        cloth = self.at(self._levels[-1]).cloth
        if cloth is None:
            return x
        x = cloth.closed(x)
        near = cloth.round_crossings(x, rings=MIXED)
        return cloth.closed(returned(self._cloth_mesh, x, other, where=near, rings=MIXED))

    def forget(self) -> None:
        """Look at the finest level as if it had never been looked at: its cloth keeps the sides that it sees first."""
        self._views.pop(self._levels[-1].index, None)

    def _cloth_at(self, level: Level, base: Float[Tensor, "vertices 3"]) -> ClothView | None:
        """A new view of one level's cloth, upsampled to given positions [m]."""
        if self._cloth is None:
            return None
        seam = self._seam_at(level, base)
        base = base if seam is None else seam.closed(base)
        return ClothView(self._cloth, level, base, thickness=self._thickness, settings=self._settings, seam=seam)

    def _seam_at(self, level: Level, base: Float[Tensor, "vertices 3"]) -> Seam | None:
        """What is sewn together at a level, upsampled to given positions [m]."""
        return None if self._seams is None else self._seams.at(level, base)

    def finish(
        self, x: Float[Tensor, "vertices 3"]
    ) -> tuple[Float[Tensor, "vertices 3"], Float[Tensor, "vertices 3"], dict[str, object]]:
        """Take back what newly crosses and push the solved cloth out of bodies.

        Returns:
            Positions [m], x itself where nothing had to move; the same before bodies pushed, where the next frame
            starts: it is where forces rest, so that equal frames stay equal; and what had to move.
        """
        view = self.at(self._levels[-1])
        if view.promise is not None:
            return self._pushed(view, x)
        moved: dict[str, object] = {}
        if self.aim is not self._coarse:
            shift = (self.aim - self._coarse).norm(dim=1)
            moved["repaired"] = {"vertices": int((shift > 0).sum()), "largest_mm": round(1e3 * float(shift.max()), 4)}
        mended, x, passes = self._mended(view, view.closed(x))
        if view.bodies is not None:
            moved["projected"] = moves(mended, x, passes)
        return x, mended, moved

    def _pushed(self, view: LevelContact, solved: Tensor) -> tuple[Tensor, Tensor, dict[str, object]]:
        """Cloth moved safely out of bodies."""
        bodies, x, passes = view.bodies, solved, 0
        moved: dict[str, object] = {}
        if bodies is not None:
            self._hold(bodies, None)
            for _ in range(PUSHES):
                view.let_through(x)
                out, more = bodies.project(x)
                passes += more
                x = view.moved(x, out)
                if x is out:
                    break
            moved["projected"] = moves(solved, x, passes)
        return x, solved, moved

    def _mended(self, view: LevelContact, solved: Tensor) -> tuple[Tensor, Tensor, int]:
        """Cloth before and after bodies pushed what was mended, and their passes."""
        cloth, bodies = view.cloth, view.bodies
        mended = solved if cloth is None else cloth.mend(solved).x
        x, passes = mended, 0
        if bodies is not None:
            self._hold(bodies, None)
            x, passes = bodies.project(mended)
            if cloth is not None and cloth.look(x).crossings.count:
                x = self._least_crossed(cloth, bodies, mended, x)
        x = self._not_worse(cloth, bodies, mended, x) if cloth is not None and cloth.worse(x) else x
        return mended, x if cloth is None or bodies is None else self._laid_smooth(cloth, bodies, x), passes

    def _laid_smooth(self, cloth: ClothView, bodies: LevelBodies, x: Tensor) -> Tensor:
        """Cloth between overlapping parts without its wrinkles, where it goes through more of a body than the input.

        Not where it then crosses itself in more places than the input does.
        """
        lost = [each for each in bodies.lost if each is not None]
        if not lost:
            return x
        count = bodies.crossings(x)
        if count <= bodies.crossings(self._levels[-1].base.apply(self._coarse)):
            return x
        smooth = smoothed(self._cloth_mesh, x, torch.stack(lost).any(dim=0), passes=SMOOTHINGS)
        out = bodies.push_out(cloth.closed(smooth))
        return x if cloth.worse(out) or bodies.crossings(out) >= count else out

    def _least_crossed(self, cloth: ClothView, bodies: LevelBodies, mended: Tensor, x: Tensor) -> Tensor:
        """Push cloth along that bodies push onto; where more crosses than in the input even then, leave more of it.

        Between overlapping parts of a body there is no room: what is pushed out there piles up in the crease.
        """
        least = cloth.look(mended).crossings.count
        if cloth.look(x).crossings.count <= least:
            return x
        best = ((cloth.worse(x), cloth.look(x).crossings.count), x, self._held)
        held, out, pushed = torch.zeros_like(self._levels[-1].free[:, 0]), x, x
        for attempt in range(HOLDS):
            for _ in range(FINISHES):
                out = self._pushed_along(bodies, mended, out)
                found = (cloth.worse(out), cloth.look(out).crossings.count)
                better = found < best[0]
                if better:
                    best = (found, out, self._held)
                if found <= (False, least):
                    return out
                if not better:
                    break
                out = bodies.project(cloth.mend(out).x)[0]
            if not best[0][0]:
                break
            held = held | cloth.round_crossings(best[1], rings=attempt)
            self._hold(bodies, held)
            before, out = pushed, bodies.project(mended)[0]
            if torch.equal(out, before):
                break  # None of them is between overlapping parts.
            pushed = out
        self._hold(bodies, best[2])
        return best[1]

    def _pushed_along(self, bodies: LevelBodies, start: Tensor, x: Tensor) -> Tensor:
        """Cloth that bodies pushed onto other cloth, and that cloth, moved until both have room."""
        mesh = self._cloth_mesh
        return bodies.project(squeezed(mesh, start, x, push_out=bodies.push_out, gap=self._apart))[0]

    def _hold(self, bodies: LevelBodies, held: Bool[Tensor, " vertices"] | None) -> None:
        """Leave vertices where they are between overlapping parts of a body."""
        self._held = held
        bodies.hold(held)

    def _not_worse(self, cloth: ClothView, bodies: LevelBodies | None, mended: Tensor, x: Tensor) -> Tensor:
        """The last resort where more crosses than in the input: cloth goes back, but not into bodies."""
        back = taken_back(cloth, self._cloth_mesh, x, (cloth.look(mended), cloth.allowed or cloth.before))
        if bodies is None:
            return back
        tried = [x, bodies.project(back)[0]]
        tried.append(self._pushed_along(bodies, back, tried[-1]))
        out = min(tried, key=lambda each: (cloth.worse(each), cloth.look(each).crossings.count))
        # Skin through cloth shows more than cloth through cloth: what cannot have both stays out of the body.
        return out if not cloth.worse(out) else self._as_input(cloth, bodies, x, out)

    def _as_input(self, cloth: ClothView, bodies: LevelBodies, x: Tensor, worst: Tensor) -> Tensor:
        """More and more of the cloth as the input has it, pushed out, until no more crosses; else what was there."""
        good, mesh = (cloth.allowed or cloth.before).x, self._cloth_mesh
        where, rings, crossing = torch.zeros_like(self._levels[-1].free[:, 0]), FIRST, worst
        while not bool(where.all()):
            where = widened(mesh, where, cloth.round_crossings(crossing, rings=0), rings)
            crossing = bodies.project(returned(mesh, x, good, where=where, rings=rings))[0]
            if not cloth.worse(crossing):
                return crossing
            rings = min(2 * rings, len(x))
        return worst

    @cached_property
    def _cloth_mesh(self) -> ClothMesh:
        """The finest level's faces; asked for only where cloth touches cloth."""
        assert self._cloth is not None
        return self._cloth.mesh(self._levels[-1])

    @property
    def _apart(self) -> float:
        """Distance to which cloth that bodies push together is moved apart [m]."""
        return SQUEEZED * float(self._thickness.mean())

    @cached_property
    def _judge(self) -> ClothView | None:
        """The finest level's cloth as the input has it, where another cage is followed; else None."""
        finest = self._levels[-1]
        return None if self.aim is self._coarse else self._cloth_at(finest, finest.base.apply(self._coarse))

    def measure(self, x: Float[Tensor, "vertices 3"]) -> tuple[dict[str, object], Bool[Tensor, " vertices"]]:
        """What is in bodies and what crosses, before and after, as plain values, and vertices of cloth that crosses.

        Args:
            x: The result [m].
        """
        finest = self._levels[-1]
        view, crossing = self._judge or self.at(finest).cloth, torch.zeros_like(finest.free[:, 0])
        said: dict[str, object] = {}
        if self._bodies is not None:
            base = finest.base.apply(self._coarse)
            bodies = self.at(finest).bodies
            lost = () if bodies is None else bodies.lost
            said |= self._bodies.measure(finest, base, x, held=self._held, lost=lost)
        if view is not None:
            cloth, crossing = view.measure(x)
            said |= {"cloth": cloth} if cloth else {}
        return said, crossing
