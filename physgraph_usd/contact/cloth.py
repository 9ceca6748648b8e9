"""Contact of a group's cloth with itself: the planes that parts see in one another, and the mending of new crossings.

Penalty springs keep parts apart but promise nothing. `ClothView.mend` takes positions back towards the upsampled cage
round each edge that newly passes through a face; where that does not bring the number of such edges to what it was, the
report's measure says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from ..collide.near import near_pairs
from ..collide.parts import Parts
from ..collide.sweep import Listed, Reach
from ..forces.seam import Seam
from ..forces.self_contact import Gaps, SelfContact, Spheres
from ..level import Level
from ..mesh.topology import joined_by
from ..scene import Garment
from .broad_phase import touch_one_another
from .cloth_mesh import ClothMesh, Crossings
from .gaps import OUT, GapFinder
from .mend import falling_off, smoothed
from .nearest import Nearest, Pairs
from .regions import Regions
from .settings import ContactSettings
from .tangles import Tangles
from .untangle import gaps_out

ZONE = 2
"""Rings round a crossing of the input within which crossings may wander."""
SMOOTHINGS = 4
"""Passes that smooth the move round new crossings before any takes it back: a smooth move crosses nothing."""
MENDS = 8
"""Most passes in all; after them the best positions found are taken."""
TAUT, SLACK = 1.25, 0.5
"""How many times as much mending may strain the cloth beyond some strain: that shows more than a few crossings do."""
SPHERE = 0.8
"""R of the paper's form, in mean edges (PAPER A13)."""
AHEAD = 0.5
"""How much farther than the thickness it is looked for pairs above the cage, in mean edges: the move of a round."""
STALE, FEW, MOST = 0.1, 1e-3, 0.35
"""Pairs are found anew beside vertices that have moved by more than so many edges, unless fewer than this part of them
has, and everywhere where more than the last part has."""
HALF, MARGIN = 0.5, 0.1
"""Of cloth that walks: the part of their distance at rest that pairs keep at most, so that a flat sheet pushes nothing;
and how much farther than the thickness pairs are asked for, in mean edges."""
LOCAL = 0.2
"""Part of the vertices that may have moved for crossings to be looked for beside those only."""
EVERYWHERE = 0.5
"""Part of the vertices in patches that may touch something beyond which all are asked from then on, and no patches."""


@dataclass(frozen=True, eq=False)
class ClothState:
    """Positions whose crossings are known.

    Attributes:
        x: Positions [m].
        crossings: What crosses there.
        near: Whether any parts are near enough to cross.
        version: How often x had been written to.
    """

    x: Float[Tensor, "vertices 3"]
    crossings: Crossings
    near: bool = True
    version: int = 0


@dataclass(frozen=True, eq=False)
class _Found:
    """What is closest to what, and the pairs that it makes."""

    nearest: Nearest
    pairs: Pairs


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
        self._parts: dict[tuple[int, bytes], Parts] = {}

    def parts(self, level: Level, sewn: np.ndarray) -> Parts:
        """What may touch what at a level, sewn at pairs of vertices."""
        key = level.index, sewn.tobytes()
        if key not in self._parts:
            self._parts[key] = Parts(level, self.meets, joined_by(sewn, level.vertex_count) if len(sewn) else None)
        return self._parts[key]

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
    """One level's cloth in one frame.

    Attributes:
        keeps_sides: Whether parts keep their side of one another; in the paper's form they do not.
        tangled: Whether anything crossed where the term was asked for last.
        allowed: What may cross in the end: the input, where another cage is followed; else None.
    """

    def __init__(
        self,
        lasting: ClothContact,
        level: Level,
        base: Float[Tensor, "vertices 3"],
        *,
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
        self.keeps_sides, self._settings = settings.cloth == "pairs", settings
        self._lasting, self._level, self._base = lasting, level, base
        self._regions, self._seam = lasting.regions(level), seam
        self._gap_finder = GapFinder(
            self._mesh, base, lasting.order, lasting.outward, thickness=thickness, stiffness=settings.cloth_stiffness
        )
        self._thickness = thickness
        self._sides: Tensor | None = None
        self._found: _Found | None = None
        self._looked: ClothState | None = None
        self.tangled, self._everywhere = False, False
        self.allowed: ClothState | None = None
        self._in_folds = False
        self._reach = float(thickness.max()) + (AHEAD if level.index else 1.0) * float(level.spacing.mean())

    @property
    def _mesh(self) -> ClothMesh:
        """The level's hierarchy, which all frames share, sewn as in this one."""
        mesh = self._lasting.mesh(self._level)
        mesh.sew(self._sewn)
        return mesh

    @property
    def _sewn(self) -> np.ndarray:
        """Pairs of vertices sewn together, shape (N, 2)."""
        return np.zeros((0, 2), np.int64) if self._seam is None else self._seam.pairs

    @property
    def parts(self) -> Parts:
        """What may touch what, sewn as in this frame."""
        return self._lasting.parts(self._level, self._sewn)

    @cached_property
    def near(self) -> Reach:
        """How near parts are that may push one another before they are looked for again."""
        play = 0.5 * MARGIN * self._level.spacing.double()
        thickness = 0.5 * self._thickness.double()[self._level.vertex_garment.long()]
        return Reach(thickness + play, play, HALF)

    @cached_property
    def before(self) -> ClothState:
        """The upsampled cage; what was looked at last stays known."""
        return self._look(self._base, None)

    def look(self, x: Float[Tensor, "vertices 3"]) -> ClothState:
        """Find what crosses at x; the answer is kept for the same tensor, unless it was written to since."""
        if self._looked is None or self._looked.x is not x or self._looked.version != x._version:
            self._looked = self._look(x, self._looked)
        return self._looked

    def look_in_folds(self, wanted: bool) -> None:
        """From now on make pairs of parts one edge apart in sharp folds, or no more.

        Never at the cage, whose folds are the input's own, nor where the input crosses: of that no side is known.
        """
        wanted = wanted and self._level.index > 0 and not self.before.crossings.count
        if wanted != self._in_folds:
            self._in_folds, self._found = wanted, None

    def closed(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions with their seams closed [m]."""
        return x if self._seam is None else self._seam.closed(x)

    def _look(self, x: Tensor, known: ClothState | None) -> ClothState:
        """Find what crosses; where few vertices have moved since what is known, only beside them."""
        if known is not None and known.near and known.version == known.x._version:
            moved = (x != known.x).any(dim=1)
            if float(moved.to(x.dtype).mean()) < LOCAL:
                self._mesh.move(x)
                return ClothState(x, self._mesh.crossings_since(known.crossings, moved), version=x._version)
        self._mesh.move(x)
        return ClothState(x, self._mesh.crossings(torch.ones_like(self._level.free[:, 0])), version=x._version)

    def _busy(self, x: Tensor, reach: float) -> Bool[Tensor, " vertices"]:
        """Vertices in patches that may come nearer to another than a reach [m], or all of them."""
        if not self._everywhere:
            busy = self._regions.busy(x, reach)
            self._everywhere = float(busy.to(x.dtype).mean()) > EVERYWHERE
            return busy
        return torch.ones_like(self._level.free[:, 0])

    def term(
        self, x: Float[Tensor, "vertices 3"], *, keep_pairs: bool = False, listed: Listed | None = None
    ) -> SelfContact | Spheres | None:
        """The force between parts that are near one another, or None where no parts are.

        Sides are those of the first positions asked for in which nothing crosses; what crosses is drawn out.

        Args:
            x: Positions [m].
            keep_pairs: Whether the pairs of the last positions serve, at their closest points of now, where nothing
                crossed there and no large part of the cloth has moved since.
            listed: Near pairs of cloth that walks, or None.
        """
        if self._settings.cloth == "spheres":
            return self._spheres(x)
        if self._settings.promise:
            return self._complete(x, listed)
        pairs, crossings = self._near(x, keep_pairs=keep_pairs)
        self.tangled = crossings.count > 0
        if self._sides is None or self.tangled:
            self._sides = x
        if pairs is None:
            return None
        gaps = self._gap_finder.gaps(pairs, x, start=self._sides, crossings=crossings)
        return self._pushing(gaps, crossings, x)

    def _pushing(self, gaps: Gaps, crossings: Crossings, x: Tensor) -> SelfContact | None:
        """The force of pairs, and of what draws out what crosses; None where there is neither."""
        if crossings.count:
            step, stiffness = OUT * float(self._level.spacing.mean()), self._settings.cloth_stiffness
            gaps = gaps.with_more(gaps_out(self._mesh, crossings, x, step=step, stiffness=stiffness))
        return SelfContact(self._level, gaps) if len(gaps.corners) else None

    def _complete(self, x: Tensor, listed: Listed | None) -> SelfContact | None:
        """The force between all parts that are near, each on its side; what crosses is drawn out."""
        crossings = self.look(x).crossings
        self.tangled = crossings.count > 0
        crossed = self._mesh.crossed(crossings) if crossings.count else None
        near = near_pairs(self.parts, x, self.near, listed=listed)
        corners = near.corners.long()
        garment = self._level.vertex_garment[corners[:, [0, 3]]].long()
        at_rest = (near.weight.unsqueeze(2) * self._level.rest[corners]).sum(dim=1).norm(dim=1)
        at_rest = torch.where(garment[:, 0] == garment[:, 1], at_rest, torch.inf)
        offset = torch.minimum(self._thickness[garment].mean(dim=1), HALF * at_rest)
        kept = near.way.norm(dim=1) < offset + MARGIN * self._level.spacing[corners].amin(dim=1)
        if crossed is not None:
            kept &= ~crossed[corners].any(dim=1)
        corners, face = corners[kept], near.face[kept]
        area = self._level.vertex_area[corners]
        share = torch.where(face, area[:, 0], area.amin(dim=1) / 3.0)
        gaps = Gaps(
            near.corners[kept],
            near.weight[kept],
            torch.nn.functional.normalize(near.way[kept], dim=1, eps=1e-30).contiguous(),
            offset[kept].contiguous(),
            self._settings.cloth_stiffness * share,
        )
        return self._pushing(gaps, crossings, x)

    def _spheres(self, x: Tensor) -> Spheres | None:
        """The paper's form: every two vertices nearer than R that are no near neighbours (PAPER P10, A13, A27)."""
        level, points = self._level, x.double().cpu().numpy()
        radius = SPHERE * float(level.spacing.mean())
        pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
        if not len(pairs):
            return None
        garment = level.vertex_garment.cpu().numpy()[pairs]
        kept = self._lasting.meets[garment[:, 0], garment[:, 1]]
        kept &= ~np.asarray(self._mesh.within_two[pairs[:, 0], pairs[:, 1]]).ravel().astype(bool)
        pairs = pairs[kept]
        if not len(pairs):
            return None
        area = float(level.vertex_area[torch.as_tensor(pairs, device=x.device).reshape(-1)].sum())
        ends = torch.as_tensor(pairs.astype(np.int32), device=x.device)
        limit = torch.full((len(pairs),), radius, dtype=x.dtype, device=x.device)
        return Spheres(level, ends, radius=limit, stiffness=self._settings.sphere_stiffness, area=area)

    def _near(self, x: Tensor, *, keep_pairs: bool) -> tuple[Pairs | None, Crossings]:
        """What is near what, and what crosses: where nothing did at the start or in the input, the end alone tells.

        Pairs found before serve again away from what has moved since.
        """
        known, none = self._found, Crossings.none(x.device)
        moved, part = None, 1.0
        if known is not None:
            moved = (x - known.nearest.x).norm(dim=1) > STALE * self._level.spacing
            part = float(moved.to(x.dtype).mean())
            if part < FEW and not self.tangled:
                return known.pairs, none
        busy = self._busy(x, self._reach)
        if not bool(busy.any()):
            self._found = None
            return None, none
        again = self._sides is None or self.tangled or self.before.crossings.count > 0
        crossings = self.look(x).crossings if again else none
        self._mesh.move(x)
        before = None if known is None or part > MOST else known.nearest
        if before is not None and keep_pairs and not self.tangled:
            # What is known stays as it was found, for edges that slid off may be near something else now.
            self._found = _Found(before, self._mesh.slid(before).pairs(self._level))
        else:
            reach = torch.full_like(self._level.spacing, self._reach)
            nearest = self._mesh.nearest(busy, reach, known=before, moved=moved, folds=self._in_folds)
            self._found = _Found(nearest, nearest.pairs(self._level))
        return self._found.pairs, crossings

    def mend(self, x: Float[Tensor, "vertices 3"], good: ClothState | None = None) -> ClothState:
        """Smooth the move from good positions, and then take it back, wherever something crosses that did not.

        Args:
            x: Positions to mend [m].
            good: Positions to fall back on; the upsampled cage when None.

        Returns:
            The positions with the fewest crossings that are not much more taut; no more than the good ones have, but
            where that cannot be had.
        """
        best = state = self.look(x)
        if not state.crossings.count:
            return state
        good = good or self.before
        zone = self._mesh.grown(self._mesh.crossed(good.crossings), ZONE)
        shift, most = x - good.x, self.most_strain(x)
        least = (self._excess(best, good), False, best.crossings.count)
        for attempt in range(MENDS):
            corners = self._mesh.corners_of(state.crossings)
            too_many = self._excess(state, good) > 0
            new = torch.ones_like(corners[:, 0], dtype=torch.bool) if too_many else ~zone[corners].all(dim=1)
            if not bool(new.any()) or (attempt >= SMOOTHINGS and not too_many):
                return best
            back = torch.zeros_like(zone)
            back[corners[new].reshape(-1)] = True
            if attempt < SMOOTHINGS:
                new_shift = smoothed(self._mesh, shift, self._mesh.grown(back, attempt + 1), passes=4 << attempt)
            else:
                new_shift = shift * falling_off(self._mesh, back, attempt - SMOOTHINGS + 1)
            # What is not mended keeps its place to the last bit, and need not be looked at again.
            still = (new_shift == shift).all(dim=1, keepdim=True)
            state = self.look(self.closed(torch.where(still, state.x, good.x + new_shift)))
            shift = new_shift if self._seam is None else state.x - good.x
            rank = self._rank(state, good, most)
            best, least = (state, rank) if rank < least else (best, least)
        return best

    def _rank(self, state: ClothState, good: ClothState, most: float) -> tuple[int, bool, int]:
        """Less is better: excess over good positions, more strain than may be, crossings."""
        return self._excess(state, good), self.is_taut(state.x, most), state.crossings.count

    def is_taut(self, x: Float[Tensor, "vertices 3"], most: float) -> bool:
        """Whether a hundredth of the edges is strained by more than that."""
        return self._mesh.is_strained(x, most)

    def most_strain(self, x: Float[Tensor, "vertices 3"]) -> float:
        """How far mending may strain cloth that is at x [m]."""
        return TAUT * self._mesh.strain(x) if self._mesh.is_strained(x, SLACK / TAUT) else SLACK

    def worse(self, x: Float[Tensor, "vertices 3"]) -> bool:
        """Whether more crosses than may, in all or between garments."""
        state = self.look(x)
        return state.crossings.count > 0 and self._excess(state, self.allowed or self.before) > 0

    def tangles(self, x: Float[Tensor, "vertices 3"], *, rings: int) -> Tangles | None:
        """The tangles at x [m] and some rings round them; None where nothing crosses."""
        found = self.look(x).crossings
        return Tangles.find(self._mesh, found, rings=rings) if found.count else None

    def remember(self, x: Float[Tensor, "vertices 3"]) -> None:
        """Take it that nothing crosses at x [m]: it was reached from where nothing did."""
        self._looked = ClothState(x, Crossings.none(x.device), version=x._version)

    def grown(self, some: Bool[Tensor, " vertices"], rings: int) -> Bool[Tensor, " vertices"]:
        """Some vertices and those within some rings of them."""
        return self._mesh.grown(some, rings)

    def mean_beside(self, values: Float[Tensor, "vertices 3"], where: Bool[Tensor, " vertices"]) -> Tensor:
        """The mean of the neighbours' values at given vertices, as they are elsewhere."""
        return smoothed(self._mesh, values, where, passes=1)

    def round_crossings(self, x: Float[Tensor, "vertices 3"], *, rings: int) -> Bool[Tensor, " vertices"]:
        """Vertices within some rings of what crosses at x [m]."""
        return self._mesh.grown(self._mesh.crossed(self.look(x).crossings), rings)

    def _excess(self, state: ClothState, good: ClothState) -> int:
        """By how much more crosses than in good positions, in all or between garments."""
        apart = [int(np.triu(self._mesh.between(each.crossings), 1).sum()) for each in (state, good)]
        return max(state.crossings.count - good.crossings.count, apart[0] - apart[1], 0)

    def measure(self, x: Float[Tensor, "vertices 3"]) -> tuple[dict[str, dict[str, int]], Bool[Tensor, " vertices"]]:
        """What crosses before and after, as plain values, and the vertices of what does after; nothing where no part
        is near another.

        Args:
            x: The result [m].
        """
        said, after = {}, self.look(x)
        if not (after.near or self.before.near):
            return {}, torch.zeros_like(self._level.free[:, 0])
        for name, state in (("before", self.before), ("after", after)):
            table = self._mesh.between(state.crossings)
            apart = int(np.triu(table, 1).sum())
            said[name] = {"crossings": state.crossings.count, "between_garments": apart}
        return said, self._mesh.crossed(after.crossings)
