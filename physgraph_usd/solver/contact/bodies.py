"""Bodies near a group of garments in one frame, and cloth that is inside them.

Bodies are triangles beside the cloth's in all searches (`collide`): cloth outside is kept there by pairs of parts, as
from other cloth. Cloth that is inside a body at the start has no such pairs with bodies. It is pulled out by the
shortest way to the body's exposed faces.

What is inside is found without distances: the edges that pass through a body cut the cloth into pieces, and each piece
is inside or outside as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.crossings import Pierced
from ..colliders.base import Nearest, Solid
from ..colliders.mesh import MeshSurface
from ..forces.self_contact import PairConstraints
from ..level import Level
from ..mesh.topology import joined_by, patches_with
from .along import ApproachLimits, along
from .measure import is_between, pinched
from .settings import ContactSettings

SIDE_SAMPLES = 8
"""Most vertices of a piece of cloth whose sides are found; the majority decides."""
ON_SURFACE = 1e-6
"""Distance below which the direction to the closest point is rounding, and the face's normal is taken [m]."""


@dataclass(frozen=True, eq=False)
class Touching:
    """A surface that a group may touch.

    Attributes:
        path: Prim path of the collider.
        surface: The posed surface.
        offset: Distance kept by each garment of the group [m]; minus infinity if the garment ignores the surface.
        before: World positions of the surface's corners in the start frame [m], shape (B, 3), float64; None if unknown.
    """

    path: str
    surface: MeshSurface
    offset: tuple[float, ...]
    before: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class FrameBodies:
    """Bodies of a group in one frame.

    Attributes:
        shifts: From the group's coordinates to each surface's [m], shape (3,).
        points: Corners of all surfaces in the group's coordinates [m], shape (B, 3), float64.
        before: Corners in the start frame [m], shape (B, 3); None if unknown.
        longest: Longest way out from between overlapping parts of a body [m].
        settings: Contact settings, with the stiffness in SI.
        sides: Allowed side of each open surface for each cage vertex, shape (C,); zeros if undecided or meaningless.
    """

    touching: tuple[Touching, ...]
    shifts: tuple[Float[Tensor, 3], ...]
    points: Float[Tensor, "corners 3"]
    before: Float[Tensor, "corners 3"] | None
    longest: float
    settings: ContactSettings
    sides: tuple[Float[Tensor, " coarse"], ...]

    @staticmethod
    def begin(
        touching: Sequence[Touching],
        coarse: Float[Tensor, "coarse 3"],
        *,
        edge: float,
        origin: np.ndarray,
        settings: ContactSettings,
    ) -> FrameBodies:
        """Place the bodies.

        Args:
            coarse: Cage positions [m], recentred.
            edge: Mean edge of the cage [m].
            origin: World position of the group's origin [m], shape (3,).
            settings: Contact settings, with the stiffness in SI.
        """
        shifts = tuple(torch.as_tensor(origin - each.surface.origin).to(coarse) for each in touching)
        known = [each.before for each in touching if each.before is not None]
        points, before = (
            torch.as_tensor(np.concatenate(each) - origin, dtype=torch.float64, device=coarse.device)
            for each in ([each.surface.world for each in touching], known or [np.zeros((0, 3))])
        )
        sides = tuple(_start_sides(each.surface, coarse + shift) for each, shift in zip(touching, shifts, strict=True))
        longest = settings.way_out * edge
        whole = len(known) == len(touching)
        return FrameBodies(tuple(touching), shifts, points, before if whole else None, longest, settings, sides)

    def exits(self, index: int, at: Float[Tensor, "points 3"]) -> tuple[Nearest, Nearest]:
        """Closest points of a closed surface, and closest points on its exposed faces, for points inside.

        A way out that ends inside another body is none, and infinitely long: cloth pinched by two bodies stays.

        Args:
            at: The points in the surface's coordinates [m].
        """
        surface = self.touching[index].surface
        found = surface.closest(at, torch.full_like(at[:, 0], float("inf")))
        way = surface.exit(at, found)
        out, blocked = way.point + surface.lift * way.normal, torch.zeros_like(found.rim)
        for other in self._beside(index):
            there = self.touching[other].surface
            blocked |= there.inside(out + torch.as_tensor(surface.origin - there.origin).to(out))
        return found, replace(way, distance=way.distance.masked_fill(blocked, torch.inf))

    def parts_around(self, index: int, at: Float[Tensor, "points 3"]) -> Int[Tensor, " points"]:
        """Number of parts around points in a surface's coordinates [m]: up to 2 of the surface, and of those beside."""
        surface = self.touching[index].surface
        count = surface.inside(at).long() + surface.inside(at, parts=2).long()
        for other in self._beside(index):
            there = self.touching[other].surface
            count += there.inside(at + torch.as_tensor(surface.origin - there.origin).to(at)).long()
        return count

    def _beside(self, index: int) -> tuple[int, ...]:
        """Numbers of the closed surfaces, felt by the same garments, whose bounds overlap a closed surface's."""
        own = self.touching[index]
        return tuple(
            number
            for number, each in enumerate(self.touching)
            if number != index and each.surface.closed and own.surface.closed
            if [np.isfinite(offset) for offset in each.offset] == [np.isfinite(offset) for offset in own.offset]
            if _meet(each.surface, own.surface)
        )

    @property
    def solids(self) -> tuple[Solid, ...]:
        """The triangles of the surfaces."""
        return tuple(each.surface.solid for each in self.touching)

    @property
    def offsets(self) -> np.ndarray:
        """Distance kept by each garment from each body [m]; minus infinity for bodies it ignores, shape (G, B)."""
        return np.array([each.offset for each in self.touching]).T


@dataclass(frozen=True, eq=False)
class LevelBodies:
    """One level's view of the bodies.

    Attributes:
        pieces: Piece of each vertex of the uncut cloth, shape (V,).
        lost: For each body, a mask of the cloth between its overlapping parts, shape (V,); None if not asked for.
    """

    level: Level
    frame: FrameBodies
    pieces: Int[np.ndarray, " vertices"]
    lost: tuple[Bool[Tensor, " vertices"], ...] | None = None

    def inside(self, x: Float[Tensor, "vertices 3"], pierced: Pierced) -> Bool[Tensor, "bodies vertices"]:
        """Whether each vertex is inside each body: in a closed surface, or behind an open one.

        Args:
            x: Positions [m].
            pierced: Crossings of cloth and bodies there.
        """
        out = [self._inside(index, x, pierced.cut(index)) for index in range(len(self.frame.touching))]
        return torch.stack(out) if out else self.level.free.T[:0]

    def _inside(self, index: int, x: Tensor, cut: Tensor) -> Bool[Tensor, " vertices"]:
        surface, out = self.frame.touching[index].surface, torch.zeros_like(self.level.free[:, 0])
        if not np.isfinite(self.frame.touching[index].offset).any() or not (surface.has_inside or len(cut)):
            return out
        piece = self.pieces
        if len(cut):
            kept = np.ones(len(self.level.edges), bool)
            kept[cut.cpu().numpy()] = False
            piece = joined_by(self.level.edges.cpu().numpy()[kept], self.level.vertex_count)
        asked, owner = _spread(piece)
        which = torch.as_tensor(asked, device=x.device)
        wrong = self._behind(index, x[which], which).cpu().numpy()
        votes = np.bincount(owner, np.where(wrong, 1.0, -1.0), int(piece.max()) + 1)
        return torch.as_tensor(votes[piece] > 0, device=x.device) & self._feels(index)

    def _feels(self, index: int) -> Bool[Tensor, " vertices"]:
        """Mask of the vertices of garments that do not ignore a body."""
        felt = torch.as_tensor(np.isfinite(self.frame.touching[index].offset), device=self.level.rest.device)
        return felt[self.level.vertex_garment.long()]

    def _behind(self, index: int, x: Tensor, which: Tensor) -> Bool[Tensor, " points"]:
        """Mask of the points x of some vertices that are inside a body or behind it."""
        surface, at = self.frame.touching[index].surface, x + self.frame.shifts[index]
        if surface.closed:
            return surface.inside(at)
        found = surface.closest(at, torch.full_like(at[:, 0], float("inf")))
        return found.is_behind(self.side(index)[which])

    def side(self, index: int) -> Float[Tensor, " vertices"]:
        """Allowed side of an open surface for each vertex: 1 or -1; 0 if undecided or closed."""
        side = self.frame.sides[index]
        return self.level.base.apply(side.unsqueeze(1).expand(-1, 3).contiguous())[:, 0].sign()

    def ways_out(
        self, index: int, x: Float[Tensor, "points 3"], side: Float[Tensor, " points"]
    ) -> tuple[Float[Tensor, "points 3"], Float[Tensor, " points"], Bool[Tensor, " points"]]:
        """Shortest ways out of a body from points inside.

        Args:
            index: Number of the body.
            x: The points [m].
            side: Allowed side of an open surface for each point, as for `side`.

        Returns:
            Unit directions out, depths [m], and a mask of pinched points, which stay.
        """
        surface, at = self.frame.touching[index].surface, x + self.frame.shifts[index]
        if surface.closed:
            found, way = self.frame.exits(index, at)
        else:
            found = way = surface.closest(at, torch.full_like(at[:, 0], float("inf")))
        stays = ~way.distance.isfinite()
        if surface.closed:
            stays |= pinched(found, way, longest=self.frame.longest)
        outward = way.normal if surface.closed else way.normal * side.unsqueeze(1)
        direct = (way.point - at) / way.distance.clamp_min(ON_SURFACE).unsqueeze(1)
        normal = torch.where((way.distance > ON_SURFACE).unsqueeze(1), direct, outward)
        return torch.nn.functional.normalize(normal, dim=1, eps=1e-30), way.distance, stays

    def _vertices_out(
        self, index: int, x: Tensor, inside: Tensor
    ) -> tuple[Int[Tensor, " some"], Float[Tensor, "some 3"], Float[Tensor, " some"]]:
        """Vertices to be moved out of a body, their unit directions out, and depths [m]."""
        which = torch.nonzero(inside).squeeze(1)
        normal, depth, stays = self.ways_out(index, x[which], self.side(index)[which])
        if self.lost is not None:
            stays |= self.lost[index][which]
        kept = torch.nonzero(~stays).squeeze(1)
        return which[kept], normal[kept], depth[kept]

    def _vertices_beside(
        self, index: int, x: Tensor, some: Tensor
    ) -> tuple[Int[Tensor, " some"], Float[Tensor, "some 3"], Float[Tensor, " some"]]:
        """Vertices of some that are near a body and outside; directions from the body; negative distances [m]."""
        which = torch.nonzero(some & self._feels(index)).squeeze(1)
        surface, at = self.frame.touching[index].surface, x[which] + self.frame.shifts[index]
        found = surface.closest(at, torch.full_like(at[:, 0], self.frame.longest))
        kept = torch.nonzero(found.distance.isfinite() & (found.distance > ON_SURFACE)).squeeze(1)
        far = found.distance[kept]
        return which[kept], (at[kept] - found.point[kept]) / far.unsqueeze(1), -far

    def pinched(
        self, x: Float[Tensor, "vertices 3"], inside: Bool[Tensor, "bodies vertices"]
    ) -> Bool[Tensor, " vertices"]:
        """Mask of the vertices between overlapping parts of bodies, too far from a way out."""
        out = inside.any(dim=0)
        for index, own in enumerate(inside):
            out[self._vertices_out(index, x, own)[0]] = False
        return out

    def pulls(
        self,
        x: Float[Tensor, "vertices 3"],
        inside: Bool[Tensor, "bodies vertices"],
        chords: Chords | None = None,
        *,
        share: float = 1.0,
    ) -> PairConstraints:
        """Constraints that pull cloth inside bodies out to its offsets.

        Args:
            x: Positions [m].
            inside: The vertices inside each body.
            chords: Places inside on edges and faces whose corners are outside; None for none.
            share: Fraction of the offsets.
        """
        found = []
        for index, own in enumerate(inside):
            outs = self._vertices_out(index, x, own), self._vertices_beside(index, x, inside.any(dim=0) & ~own)
            which, normal, depth = (torch.cat(each) for each in zip(*outs, strict=True))
            corners = which.unsqueeze(1).expand(-1, 4)
            weight = torch.zeros_like(x[:1, :1]).repeat(len(which), 4)
            weight[:, 0] = 1.0
            found.append((index, corners, weight, normal, depth))
            if chords is None:
                continue
            some = torch.nonzero(chords.body == index).squeeze(1)
            corners, weight = chords.corners[some], chords.weight[some]
            at, side = (weight.unsqueeze(2) * x[corners]).sum(dim=1), self.side(index)[corners[:, 0]]
            within = torch.nonzero(self._behind(index, at, corners[:, 0])).squeeze(1)
            normal, depth, stays = self.ways_out(index, at[within], side[within])
            within, normal, depth = within[~stays], normal[~stays], depth[~stays]
            found.append((index, corners[within], weight[within], normal, depth))
        made = [self._pull(x, *each, share=share) for each in found]
        return reduce(PairConstraints.with_more, made)

    def _pull(
        self, x: Tensor, index: int, corners: Tensor, weight: Tensor, normal: Tensor, depth: Tensor, *, share: float
    ) -> PairConstraints:
        """Constraints that move points of the cloth along their ways out [m]."""
        at = (weight.unsqueeze(2) * x[corners]).sum(dim=1)
        goal = (normal * at).sum(dim=1) + depth + share * self.offset(index)[corners[:, 0]]
        stiffness = self.frame.settings.stiffness * self.level.vertex_area[corners].amin(dim=1)
        whole = (each.contiguous() for each in (weight, normal, goal, stiffness))
        return PairConstraints(corners.to(torch.int32).contiguous(), *whole)

    def offset(self, index: int) -> Float[Tensor, " vertices"]:
        """Distance that each vertex keeps from a body [m]."""
        offset = torch.tensor(self.frame.touching[index].offset, dtype=self.level.dtype, device=self.level.rest.device)
        return offset[self.level.vertex_garment.long()]

    def pushed_out(
        self, x: Float[Tensor, "vertices 3"], inside: Bool[Tensor, "bodies vertices"], chords: Chords | None = None
    ) -> Float[Tensor, "vertices 3"]:
        """Positions with cloth inside bodies moved out to the clearance [m]; arguments are as for `pulls`."""
        out = self.pulls(x, inside, chords, share=self.frame.settings.clearance).sharing_room(x)
        lack = out.penetration(x).double()
        limits = ApproachLimits(out.corners, out.weight.double(), out.normal.double(), -lack)
        free, threads = self.level.free, self.level.threads
        return x + along(torch.zeros_like(x, dtype=torch.float64), limits, free=free, threads=threads).to(x)

    def losing(self, x: Float[Tensor, "vertices 3"], inside: Bool[Tensor, "bodies vertices"]) -> LevelBodies:
        """View that does not push out cloth between overlapping parts of a body at x [m] while the cloth stays inside.

        Such cloth is a patch of vertices with buried closest faces, some of them inside two parts at once. Pushed out,
        the patch would fold through its neighbours, which leave on the opposite side: the T-shirt, whole, three
        ripples, ended with 674 vertices in its body for 20.
        """
        lost = tuple(self._between(index, x, own) for index, own in enumerate(inside))
        return replace(self, lost=lost)

    def _between(self, index: int, x: Tensor, inside: Tensor) -> Bool[Tensor, " vertices"]:
        surface, which = self.frame.touching[index].surface, torch.nonzero(inside).squeeze(1)
        some, seeds = torch.zeros_like(inside), torch.zeros_like(inside)
        if not len(which) or not surface.closed:
            return some
        at = x[which] + self.frame.shifts[index]
        between = torch.nonzero(is_between(*self.frame.exits(index, at))).squeeze(1)
        some[which[between]] = True
        seeds[which[between[self.frame.parts_around(index, at[between]) > 1]]] = True
        masks = (each.cpu().numpy() for each in (some, seeds))
        return torch.as_tensor(patches_with(self.level.edges.cpu().numpy(), *masks), device=x.device)


@dataclass(frozen=True, eq=False)
class Chords:
    """Places inside bodies on edges and faces whose corners are outside: the middles of where they are pierced.

    Attributes:
        body: Number of the body, shape (N,).
        corners: Vertices of the edge or face, the first one repeated, shape (N, 4).
        weight: Weights of the vertices in the place, shape (N, 4).
    """

    body: Int[Tensor, " chords"]
    corners: Int[Tensor, "chords 4"]
    weight: Float[Tensor, "chords 4"]


def _meet(one: MeshSurface, other: MeshSurface) -> bool:
    """Whether the bounds of two surfaces meet."""
    a, b = one.bounds + one.origin, other.bounds + other.origin
    return bool((a[0] <= b[1]).all() and (b[0] <= a[1]).all())


def _spread(piece: Int[np.ndarray, " vertices"]) -> tuple[np.ndarray, np.ndarray]:
    """Up to `SIDE_SAMPLES` vertices of each piece, evenly spaced in their order, and the piece of each."""
    order = np.argsort(piece, kind="stable")
    size = np.bincount(piece)
    first, step = np.cumsum(size) - size, np.maximum(size // SIDE_SAMPLES, 1)
    place = np.arange(len(piece)) - first[piece[order]]
    taken = (place % step[piece[order]] == 0) & (place // step[piece[order]] < SIDE_SAMPLES)
    return order[taken], piece[order[taken]]


def _start_sides(surface: MeshSurface, cage: Float[Tensor, "coarse 3"]) -> Float[Tensor, " coarse"]:
    """Side of the surface on which each cage vertex lies, 1 or -1; 0 past the rim, and for closed surfaces."""
    if surface.closed or surface.fixed_side is not None:
        return torch.full_like(cage[:, 0], surface.fixed_side or 0.0)
    found: Nearest = surface.closest(cage, torch.full_like(cage[:, 0], float("inf")))
    return torch.where(found.rim, torch.zeros_like(found.side), found.side)
