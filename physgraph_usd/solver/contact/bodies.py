"""Bodies near a group of garments in one frame, and cloth inside the bodies.

In all searches (`collide`) the bodies' triangles follow the cloth's. Pairs of parts keep cloth outside bodies as they
keep layers of cloth apart. Cloth that is inside a body at the start has no such pairs with bodies. It is pulled out by
the shortest way to the body's exposed faces.

Inside cloth is found without distances: edges that pass through a body cut the cloth into pieces, and each piece is
entirely inside or entirely outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

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
from .cloth_mesh import ClothPieces
from .measure import is_between, pinched
from .settings import ContactSettings

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
        surfaces = [body.surface for body in touching]
        shifts = torch.as_tensor(np.stack([origin - surface.origin for surface in surfaces])).to(coarse).unbind()
        now, earlier = [surface.world for surface in surfaces], [b.before for b in touching if b.before is not None]
        corners = torch.as_tensor(np.concatenate([*now, *earlier]) - origin, dtype=torch.float64, device=coarse.device)
        points, before = corners.tensor_split([sum(map(len, now))])
        sides = tuple(_start_sides(surface, coarse + shift) for surface, shift in zip(surfaces, shifts, strict=True))
        longest = settings.way_out * edge
        complete = len(earlier) == len(touching)
        return FrameBodies(tuple(touching), shifts, points, before if complete else None, longest, settings, sides)

    def exits(self, index: int, at: Float[Tensor, "points 3"]) -> tuple[Nearest, Nearest]:
        """Closest points of a closed surface, and closest points on its exposed faces, for points inside.

        A way out that ends inside another body is not used and gets infinite length: cloth pinched by two bodies stays.

        Args:
            at: The points in the surface's coordinates [m].
        """
        surface = self.touching[index].surface
        nearest = surface.closest(at)
        exits = surface.exit(at, nearest)
        out, blocked = exits.point + surface.lift * exits.normal, torch.zeros_like(nearest.rim)
        for neighbour in self._beside(index):
            blocked |= neighbour.inside(out + torch.as_tensor(surface.origin - neighbour.origin).to(out))
        return nearest, replace(exits, distance=exits.distance.masked_fill(blocked, torch.inf))

    def parts_around(self, index: int, at: Float[Tensor, "points 3"]) -> Int[Tensor, " points"]:
        """Number of body parts around points in a surface's coordinates [m], up to 2 of the surface itself."""
        surface = self.touching[index].surface
        count = surface.inside(at).long() + surface.inside(at, parts=2).long()
        for neighbour in self._beside(index):
            count += neighbour.inside(at + torch.as_tensor(surface.origin - neighbour.origin).to(at)).long()
        return count

    def _beside(self, index: int) -> tuple[MeshSurface, ...]:
        """The closed surfaces in contact with the same garments whose bounds overlap a closed surface's."""
        body = self.touching[index]
        return tuple(
            candidate.surface
            for number, candidate in enumerate(self.touching)
            if number != index and candidate.surface.closed and body.surface.closed
            if [np.isfinite(offset) for offset in candidate.offset] == [np.isfinite(offset) for offset in body.offset]
            if _meet(candidate.surface, body.surface)
        )

    @property
    def solids(self) -> tuple[Solid, ...]:
        """The triangles of the surfaces."""
        return tuple(body.surface.solid for body in self.touching)

    @property
    def offsets(self) -> np.ndarray:
        """Distance kept by each garment from each body [m]; minus infinity for ignored bodies, shape (G, B)."""
        return np.array([body.offset for body in self.touching]).T


@dataclass(frozen=True, eq=False)
class LevelBodies:
    """One level's view of the bodies.

    Attributes:
        pieces: Connected pieces of the uncut cloth.
        buried: For each body, a mask of the cloth between its overlapping parts, shape (V,); None if not computed.
    """

    level: Level
    frame: FrameBodies
    pieces: ClothPieces
    buried: tuple[Bool[Tensor, " vertices"], ...] | None = None

    def inside(self, x: Float[Tensor, "vertices 3"], pierced: Pierced) -> Bool[Tensor, "bodies vertices"]:
        """Whether each vertex is inside each body: in a closed surface, or behind an open one.

        Args:
            x: Positions [m].
            pierced: Crossings of cloth and bodies at x.
        """
        out = [self._inside(index, x, pierced.cut(index)) for index in range(len(self.frame.touching))]
        return torch.stack(out) if out else self.level.free.T[:0]

    def _inside(self, index: int, x: Tensor, cut: Tensor) -> Bool[Tensor, " vertices"]:
        surface, out = self.frame.touching[index].surface, torch.zeros_like(self.level.free[:, 0])
        if not np.isfinite(self.frame.touching[index].offset).any() or not (surface.has_inside or len(cut)):
            return out
        pieces = self.pieces
        if len(cut):
            uncut = np.ones(len(self.level.edges), bool)
            uncut[cut.cpu().numpy()] = False
            pieces = ClothPieces(joined_by(self.level.edges.cpu().numpy()[uncut], self.level.vertex_count), x.device)
        return pieces.most(self._behind(index, x[pieces.sampled], pieces.sampled)) & self._feels(index)

    def _feels(self, index: int) -> Bool[Tensor, " vertices"]:
        """Mask of the vertices of garments that do not ignore a body."""
        return self._felt[index][self.level.vertex_garment.long()]

    @cached_property
    def _felt(self) -> Bool[Tensor, "bodies garments"]:
        """Whether each body is felt by each garment."""
        return torch.as_tensor(np.isfinite(self.frame.offsets.T), device=self.level.rest.device)

    def _behind(self, index: int, x: Tensor, vertices: Tensor) -> Bool[Tensor, " points"]:
        """Mask of the vertices, at positions x [m], that are inside or behind a body."""
        surface, at = self.frame.touching[index].surface, x + self.frame.shifts[index]
        if surface.closed:
            return surface.inside(at)
        return surface.closest(at).is_behind(self.side(index)[vertices])

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
            nearest, exits = self.frame.exits(index, at)
            outward, stays = exits.normal, pinched(nearest, exits, longest=self.frame.longest)
        else:
            exits = surface.closest(at)
            outward, stays = exits.normal * side.unsqueeze(1), torch.zeros_like(exits.rim)
        stays |= ~exits.distance.isfinite()
        direct = (exits.point - at) / exits.distance.clamp_min(ON_SURFACE).unsqueeze(1)
        normal = torch.where((exits.distance > ON_SURFACE).unsqueeze(1), direct, outward)
        return torch.nn.functional.normalize(normal, dim=1, eps=1e-30), exits.distance, stays

    def _vertices_out(
        self, index: int, x: Tensor, inside: Tensor
    ) -> tuple[Int[Tensor, " some"], Float[Tensor, "some 3"], Float[Tensor, " some"]]:
        """Vertices to be moved out of a body, their unit directions out, and depths [m]."""
        vertices = torch.nonzero(inside).squeeze(1)
        normal, depth, stays = self.ways_out(index, x[vertices], self.side(index)[vertices])
        if self.buried is not None:
            stays |= self.buried[index][vertices]
        movable = torch.nonzero(~stays).squeeze(1)
        return vertices[movable], normal[movable], depth[movable]

    def _vertices_beside(
        self, index: int, x: Tensor, candidates: Tensor
    ) -> tuple[Int[Tensor, " some"], Float[Tensor, "some 3"], Float[Tensor, " some"]]:
        """Candidates outside that are near a body, unit directions from the body, and negative distances [m]."""
        vertices = torch.nonzero(candidates & self._feels(index)).squeeze(1)
        surface, at = self.frame.touching[index].surface, x[vertices] + self.frame.shifts[index]
        nearest = surface.closest(at, torch.full_like(at[:, 0], self.frame.longest))
        reached = torch.nonzero(nearest.distance.isfinite() & (nearest.distance > ON_SURFACE)).squeeze(1)
        far = nearest.distance[reached]
        return vertices[reached], (at[reached] - nearest.point[reached]) / far.unsqueeze(1), -far

    def pinched(
        self, x: Float[Tensor, "vertices 3"], inside: Bool[Tensor, "bodies vertices"]
    ) -> Bool[Tensor, " vertices"]:
        """Mask of the vertices between overlapping parts of bodies, too far from a way out."""
        out = inside.any(dim=0)
        for index, in_body in enumerate(inside):
            out[self._vertices_out(index, x, in_body)[0]] = False
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
            chords: Points inside on edges and faces whose corners are outside; None for none.
            share: Fraction of the offsets.
        """
        groups = []
        for index, in_body in enumerate(inside):
            outs = self._vertices_out(index, x, in_body), self._vertices_beside(index, x, inside.any(dim=0) & ~in_body)
            vertices, normal, depth = (torch.cat(columns) for columns in zip(*outs, strict=True))
            corners = vertices.unsqueeze(1).expand(-1, 4)
            weight = torch.zeros_like(x[:1, :1]).repeat(len(vertices), 4)
            weight[:, 0] = 1.0
            groups.append((index, corners, weight, normal, depth))
            if chords is None:
                continue
            rows = torch.nonzero(chords.body == index).squeeze(1)
            corners, weight = chords.corners[rows], chords.weight[rows]
            at, side = (weight.unsqueeze(2) * x[corners]).sum(dim=1), self.side(index)[corners[:, 0]]
            within = torch.nonzero(self._behind(index, at, corners[:, 0])).squeeze(1)
            normal, depth, stays = self.ways_out(index, at[within], side[within])
            within, normal, depth = within[~stays], normal[~stays], depth[~stays]
            groups.append((index, corners[within], weight[within], normal, depth))
        return reduce(PairConstraints.with_more, (self._pull(x, *group, share=share) for group in groups))

    def _pull(
        self, x: Tensor, index: int, corners: Tensor, weight: Tensor, normal: Tensor, depth: Tensor, *, share: float
    ) -> PairConstraints:
        """Constraints that move points of the cloth out of a body, along unit normals by depths [m]."""
        at = (weight.unsqueeze(2) * x[corners]).sum(dim=1)
        goal = (normal * at).sum(dim=1) + depth + share * self.offset(index)[corners[:, 0]]
        stiffness = self.frame.settings.stiffness * self.level.vertex_area[corners].amin(dim=1)
        columns = (column.contiguous() for column in (weight, normal, goal, stiffness))
        return PairConstraints(corners.to(torch.int32).contiguous(), *columns)

    def offset(self, index: int) -> Float[Tensor, " vertices"]:
        """Offset of each vertex from a body [m]."""
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

    def with_buried(self, x: Float[Tensor, "vertices 3"], inside: Bool[Tensor, "bodies vertices"]) -> LevelBodies:
        """View in which cloth between overlapping parts of a body at x [m] is not pushed out while it stays inside.

        Such cloth is a patch of vertices with buried closest faces, some of them inside two parts at once. Pushed out,
        the patch would fold through its neighbours, which leave on the opposite side: the T-shirt (whole shot, three
        ripples) ended with 674 instead of 20 vertices in its body.
        """
        buried = tuple(self._between(index, x, in_body) for index, in_body in enumerate(inside))
        return replace(self, buried=buried)

    def _between(self, index: int, x: Tensor, inside: Tensor) -> Bool[Tensor, " vertices"]:
        surface, vertices = self.frame.touching[index].surface, torch.nonzero(inside).squeeze(1)
        members, seeds = torch.zeros_like(inside), torch.zeros_like(inside)
        if not len(vertices) or not surface.closed:
            return members
        at = x[vertices] + self.frame.shifts[index]
        between = torch.nonzero(is_between(*self.frame.exits(index, at))).squeeze(1)
        members[vertices[between]] = True
        seeds[vertices[between[self.frame.parts_around(index, at[between]) > 1]]] = True
        masks = (mask.cpu().numpy() for mask in (members, seeds))
        return torch.as_tensor(patches_with(self.level.edges.cpu().numpy(), *masks), device=x.device)


@dataclass(frozen=True, eq=False)
class Chords:
    """Points inside bodies on edges and faces whose corners are outside: means of the crossings of an edge or face.

    Attributes:
        body: Number of the body, shape (N,).
        corners: Vertices of the edge or face, the first one repeated, shape (N, 4).
        weight: Weights of the vertices in the point, shape (N, 4).
    """

    body: Int[Tensor, " chords"]
    corners: Int[Tensor, "chords 4"]
    weight: Float[Tensor, "chords 4"]


def _meet(first: MeshSurface, second: MeshSurface) -> bool:
    """Whether the bounds of two surfaces meet."""
    a, b = first.bounds + first.origin, second.bounds + second.origin
    return bool((a[0] <= b[1]).all() and (b[0] <= a[1]).all())


def _start_sides(surface: MeshSurface, cage: Float[Tensor, "coarse 3"]) -> Float[Tensor, " coarse"]:
    """Side of the surface on which each cage vertex lies, 1 or -1; 0 past the rim, and for closed surfaces."""
    if surface.closed or surface.fixed_side is not None:
        return torch.full_like(cage[:, 0], surface.fixed_side or 0.0)
    nearest = surface.closest(cage)
    return torch.where(nearest.rim, torch.zeros_like(nearest.side), nearest.side)
