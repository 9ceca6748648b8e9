"""Measures contact from positions alone, without the forces: vertices in bodies, and edges through faces."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar
from weakref import WeakKeyDictionary

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..colliders.base import Nearest, Surface
from ..colliders.mesh import MeshSurface
from ..level import Level
from ..mesh.kernels import KERNELS
from ..mesh.threads import LEAST_QUERIES, argument, run

wp.set_module_options(KERNELS)

DETOUR = 1.05
"""Ratio of the way out to the closest distance above which the closest face counts as buried."""
COVER = 0.6
"""Upper bound of the distance from a point of a triangle to its nearest corner, in longest sides (1 / sqrt(3), plus a
margin)."""
DEEP = 1e-4
"""Depth from which a vertex counts as inside [m]."""


@dataclass(frozen=True)
class Penetration:
    """Penetration of a garment into one surface.

    Attributes:
        inside: Number of free vertices deeper than `DEEP` in a closed surface, without pinched vertices.
        percent: Percentage of all free vertices.
        deepest_mm: Depth of the deepest free vertex [mm].
        pinned: Number of pinned vertices deeper than `DEEP`; pinned vertices stay.
        pinched: Number of free vertices inside whose cloth lies between overlapping parts of the body in the input, or
            that are between such parts now and farther from any way out than half a cage edge. Pinched vertices stay,
            out of sight; forced out, they would fold through their neighbours.
        crossings: Number of cloth edges through faces of the body plus body edges through faces of the cloth.
    """

    inside: int
    percent: float
    deepest_mm: float
    pinned: int
    pinched: int
    crossings: int


def penetration(
    surface: Surface,
    level: Level,
    x: Float[Tensor, "vertices 3"],
    signed: Float[Tensor, " vertices"],
    *,
    longest: float,
    held: Bool[Tensor, " vertices"] | None = None,
    lost: Bool[Tensor, " vertices"] | None = None,
    inside: Nearest | None = None,
    crossings: int | None = None,
) -> Penetration:
    """Measure one garment group against one surface.

    Args:
        surface: The surface.
        level: The level of x.
        x: Positions in the surface's coordinates [m].
        signed: Signed distances at x; lower bounds where positive [m].
        longest: Way out from between overlapping parts above which a vertex counts as pinched [m].
        held: Vertices that count as pinched between parts at any length of the way out, or None.
        lost: Vertices of cloth between overlapping parts, or None.
        inside: Closest points of the vertices with negative distances, if known.
        crossings: Number of edges through faces, if known.
    """
    free = level.free[:, 0]
    depth, stays = depths(surface, x, signed, longest, held=held, lost=lost, inside=inside)
    deep = (depth > DEEP) & ~stays
    count = int((deep & free).sum())
    deepest = float((depth * (free & ~stays)).max()) if len(depth) else 0.0
    return Penetration(
        inside=count,
        percent=round(100.0 * count / max(int(free.sum()), 1), 4),
        deepest_mm=round(1e3 * deepest, 4),
        pinned=int((deep & ~free).sum()),
        pinched=int((stays & free).sum()),
        crossings=len(pierced(surface, level, x, signed.abs())) if crossings is None else crossings,
    )


def depths(
    surface: Surface,
    x: Float[Tensor, "vertices 3"],
    signed: Float[Tensor, " vertices"],
    longest: float,
    *,
    held: Bool[Tensor, " vertices"] | None = None,
    lost: Bool[Tensor, " vertices"] | None = None,
    inside: Nearest | None = None,
) -> tuple[Float[Tensor, " vertices"], Bool[Tensor, " vertices"]]:
    """Length of the way out of a closed surface for each vertex [m], 0 outside, and a mask of the pinched vertices.

    Args:
        surface: The surface.
        x: Positions in the surface's coordinates [m].
        signed: Signed distances at x; lower bounds where positive [m].
        longest: Way out from between overlapping parts above which a vertex counts as pinched [m].
        held: Vertices that count as pinched between parts at any length of the way out, or None.
        lost: Vertices of cloth between overlapping parts, or None.
        inside: Closest points of the vertices with negative distances, if known.
    """
    depth, stays = torch.zeros_like(signed), torch.zeros_like(signed, dtype=torch.bool)
    within = torch.nonzero(signed < 0).squeeze(1) if surface.closed else depth.long()[:0]
    if len(within):
        found = inside or surface.closest(x[within], torch.full_like(signed[within], float("inf")))
        way = surface.exit(x[within], found)
        known = {name: each[within] for name, each in (("held", held), ("lost", lost)) if each is not None}
        depth[within], stays[within] = way.distance, pinched(surface, x[within], found, way, longest=longest, **known)
    return depth, stays


def pinched(
    surface: Surface,
    x: Float[Tensor, "points 3"],
    found: Nearest,
    way: Nearest,
    *,
    longest: float,
    held: Bool[Tensor, " points"] | None = None,
    lost: Bool[Tensor, " points"] | None = None,
) -> Bool[Tensor, " points"]:
    """Mask of the inside points that lie between overlapping parts too far from a way out, or are held there.

    Args:
        surface: The surface.
        x: Points inside the surface, in the surface's coordinates [m].
        found: Closest points.
        way: Closest points on exposed faces.
        longest: Longest way out [m].
        held: Points that stay at any length of the way out if they are inside two parts at once; or None.
        lost: Points of cloth between overlapping parts, which stay wherever they have moved; or None.
    """
    detour = is_between(found, way)
    stays = (way.distance > longest) & detour
    stays = stays if lost is None else stays | lost
    if held is not None and bool(held.any()):
        which = torch.nonzero(held).squeeze(1)
        stays[which] |= detour[which] | surface.inside(x[which], parts=2)
    return stays


def is_between(found: Nearest, way: Nearest) -> Bool[Tensor, " points"]:
    """Mask of the points between overlapping parts of a surface: their closest face is inside the surface, too.

    Args:
        found: Closest points.
        way: Closest points on exposed faces.
    """
    return way.distance > DETOUR * found.distance


@wp.kernel
def _pierce(
    first: wp.int32,
    mesh: wp.uint64,
    edges: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3f),
    clear: wp.array(dtype=wp.float32),
    longest: wp.array(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    a, b = edges[i][0], edges[i][1]
    if clear[a] + clear[b] <= longest[i]:
        along = points[b] - points[a]
        length = wp.length(along)
        if length > 0.0:
            query = wp.mesh_query_ray(mesh, points[a], along / length, length)
            if query.result:
                face[i] = query.face


@dataclass(frozen=True, eq=False)
class Pierced:
    """Intersections of cloth and body.

    Attributes:
        edges: Edges of the cloth that pass through the body.
        triangles: Triangles of the cloth pierced by edges of the body, once for each edge.
    """

    edges: Int[Tensor, " edges"]
    triangles: Int[Tensor, " triangles"]

    def __len__(self) -> int:
        """Number of piercing edges of cloth and body."""
        return len(self.edges) + len(self.triangles)


def pierced(
    surface: Surface, level: Level, x: Float[Tensor, "vertices 3"], distance: Float[Tensor, " vertices"]
) -> Pierced:
    """Cloth edges through faces of the body, and cloth triangles pierced by edges of the body.

    For a primitive: cloth edges with one end inside. Edges farther from the surface than their length are skipped.

    Args:
        surface: The surface.
        level: The level.
        x: Positions in the surface's coordinates [m].
        distance: Unsigned distances at x, or lower bounds; infinite for cloth that ignores the surface [m].
    """
    length = level.lengths(x)
    if not isinstance(surface, MeshSurface):
        first, second = level.edges.long().T.contiguous()
        near = torch.nonzero(distance[first] + distance[second] <= length).squeeze(1)
        inside = surface.inside(x) if len(near) else near
        return Pierced(near[inside[first[near]] != inside[second[near]]] if len(near) else near, near[:0])
    if not len(length) or float(distance.min()) > COVER * float(length.max()):
        none = level.edges.long()[:0, 0]
        return Pierced(none, none)
    points = x.to(torch.float32).contiguous()
    faces = _faces_met(surface.mesh, level.edges, points, clear=distance, longest=length, threads=level.threads)
    return Pierced(torch.nonzero(faces >= 0).squeeze(1), _through_cloth(surface, level, points, distance.isfinite()))


def _through_cloth(
    surface: MeshSurface, level: Level, x: Tensor, feels: Bool[Tensor, " vertices"]
) -> Int[Tensor, " triangles"]:
    """Cloth triangles pierced by edges of the body, for garments in contact with the body."""
    cloth = _Cloth.of(level, feels)
    cloth.move(x)
    edges = torch.as_tensor(surface.edges, device=x.device)
    body = wp.to_torch(surface.mesh.points)
    # How far the body is from the cloth nobody knows: none of its edges is left out.
    clear, longest = (body.new_zeros(len(each)) for each in (body, edges))
    faces = _faces_met(cloth.mesh, edges, body, clear=clear, longest=longest, threads=level.threads)
    return cloth.triangles[faces[faces >= 0].long()]


class _Cloth:
    """Bounding volume hierarchy of some of a level's garments, built once and refitted.

    Attributes:
        triangles: Indices of the faces in the level.
        mesh: Warp mesh of the faces.
    """

    _known: ClassVar[WeakKeyDictionary[Level, dict[tuple[int, ...], _Cloth]]] = WeakKeyDictionary()

    def __init__(self, level: Level, garments: Sequence[int]) -> None:
        """Build the hierarchy at rest."""
        corners = level.triangles.long()
        owner = level.vertex_garment[corners[:, 0]]
        kept = torch.isin(owner, torch.tensor(garments, dtype=owner.dtype, device=owner.device))
        self.triangles = torch.nonzero(kept).squeeze(1)
        self._points = level.rest.to(torch.float32).clone()
        self._index = level.triangles[self.triangles].reshape(-1).contiguous()
        self.mesh = wp.Mesh(wp.from_torch(self._points, dtype=wp.vec3f), wp.from_torch(self._index))

    @classmethod
    def of(cls, level: Level, feels: Bool[Tensor, " vertices"]) -> _Cloth:
        """The hierarchy of the garments with a vertex in contact with the body."""
        garments = tuple(index for index, span in enumerate(level.spans) if bool(feels[span].any()))
        known = cls._known.setdefault(level, {})
        if garments not in known:
            known[garments] = cls(level, garments)
        return known[garments]

    def move(self, points: Float[Tensor, "vertices 3"]) -> None:
        """Refit to positions [m], float32."""
        self._points.copy_(points)
        self.mesh.refit()


def _faces_met(
    mesh: wp.Mesh, edges: Tensor, points: Tensor, *, clear: Tensor, longest: Tensor, threads: int
) -> Int[Tensor, " edges"]:
    """The first face of a mesh met by each edge, -1 if none or if the edge is too short to reach the mesh.

    Args:
        mesh: The mesh.
        edges: End vertices, int32, shape (E, 2).
        points: Positions [m], float32, shape (V, 3).
        clear: Lower bound of each vertex's distance from the mesh [m], shape (V,).
        longest: Sum of both ends' distances above which an edge cannot meet the mesh [m], shape (E,).
        threads: Most threads on the CPU.
    """
    face = torch.full((len(edges),), -1, dtype=torch.int32, device=points.device)
    if len(edges):
        reach = [argument(each.to(torch.float32).contiguous()) for each in (clear, longest)]
        ends = argument(edges.contiguous(), wp.vec2i)
        inputs = [mesh.id, ends, argument(points, wp.vec3f), *reach, argument(face)]
        run(_pierce, len(edges), inputs, device=str(points.device), threads=threads, least=LEAST_QUERIES)
    return face
