"""Contact springs between near parts of the cloth, found in one pass over the pairs.

Each pair has an offset, the distance to keep, in metres:

    offset = min(thickness, HALF distance at rest, max(distance in the upsampled cage, LEAST_OFFSET thickness))

A pair has a spring if its distance is less than the offset plus `MARGIN` of an edge. Between garments the distance at
rest is ignored. A body keeps its own offset. The stiffness is given by area, times the area of the pair: the vertex's
area, or a third of the least of the cloth corners' areas.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false
from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.distance import weights_of
from ..collide.pairs import NearAt, Pairs, Reach
from ..collide.search import blocking_and_near, near_parts
from ..forces.self_contact import PairConstraints
from ..mesh.kernels import KERNELS
from ..mesh.threads import argument, run
from .bodies import ON_SURFACE, FrameBodies
from .cloth_mesh import ClothMesh

wp.set_module_options(KERNELS)

HALF, MARGIN = 0.5, 0.1
"""Largest offset of a pair in a garment as a fraction of its distance at rest, so that a flat sheet exerts no force;
and the search distance beyond the thickness, in edges."""
FEW_MOVED = 0.25
"""Largest part of the vertices that may have moved since the last search for its pairs to be kept."""
LEAST_OFFSET = 0.25
"""Minimum offset as a fraction of the thickness, however close the parts are in the input."""
_HALF, _MARGIN, _LEAST = (wp.constant(wp.float64(value)) for value in (HALF, MARGIN, LEAST_OFFSET))


@wp.func
def _apart(weight: wp.vec4d, c: wp.vec4i, x: wp.array(dtype=wp.vec3d)):
    """Vector from the second point of a pair to the first."""
    return weight[0] * x[c[0]] + weight[1] * x[c[1]] + weight[2] * x[c[2]] + weight[3] * x[c[3]]


@wp.kernel
def _find_springs(
    first: wp.int32,
    x: wp.array(dtype=wp.vec3d),
    rest: wp.array(dtype=wp.vec3d),
    base: wp.array(dtype=wp.vec3d),
    garment: wp.array(dtype=wp.int32),
    keep: wp.array(dtype=wp.float64),
    garments: wp.int32,
    cloths: wp.int32,
    spacing: wp.array(dtype=wp.float64),
    corners: wp.array(dtype=wp.vec4i),
    face: wp.array(dtype=wp.bool),
    weight: wp.array(dtype=wp.vec4d),
    separation: wp.array(dtype=wp.vec3d),
    offset: wp.array(dtype=wp.float64),
    is_near: wp.array(dtype=wp.bool),
):
    i = first + wp.tid()
    c = corners[i]
    w = weights_of(face[i], x[c[0]], x[c[1]], x[c[2]], x[c[3]])
    between = _apart(w, c, x)
    distance = wp.length(between)
    edge = wp.min(wp.min(spacing[c[0]], spacing[c[1]]), wp.min(spacing[c[2]], spacing[c[3]]))
    first_owner, last_owner = garment[c[0]], garment[c[3]]
    thick = keep[first_owner * garments + last_owner]
    near = distance < thick + _MARGIN * edge
    if near:
        keeps = thick
        if first_owner < cloths and last_owner < cloths:
            keeps = wp.min(thick, wp.max(wp.length(_apart(w, c, base)), _LEAST * thick))
        if first_owner == last_owner:
            keeps = wp.min(keeps, _HALF * wp.length(_apart(w, c, rest)))
        near = distance < keeps + _MARGIN * edge
        weight[i] = w
        separation[i] = between
        offset[i] = keeps
    is_near[i] = near


@dataclass(frozen=True, eq=False)
class NearSprings:
    """Near pairs of parts, the shortest vectors between them, and the distances to keep.

    Attributes:
        corners: A vertex and the corners of a face, or the ends of two edges, shape (N, 4), int32.
        weight: Weights of the corners in the shortest vector from the second part to the first; rows sum to 0, shape
            (N, 4).
        separation: Shortest vector [m], shape (N, 3).
        face: True for a vertex and a face, shape (N,).
        offset: Distance to keep [m], shape (N,).
    """

    corners: Int[Tensor, "pairs 4"]
    weight: Float[Tensor, "pairs 4"]
    separation: Float[Tensor, "pairs 3"]
    face: Bool[Tensor, " pairs"]
    offset: Float[Tensor, " pairs"]

    def where(self, selected: Int[Tensor, " kept"]) -> NearSprings:
        """The selected springs."""
        return NearSprings(*(getattr(self, field.name).index_select(0, selected) for field in fields(self)))


def _required_gaps(thickness: Float[Tensor, " garments"], offsets: np.ndarray | None) -> Float[Tensor, "all all"]:
    """Distance kept by two garments, or by a garment and a body, which follow as further garments [m]."""
    mean, count = 0.5 * (thickness.unsqueeze(0) + thickness.unsqueeze(1)), len(thickness)
    if offsets is None:
        return mean
    body_offsets = torch.as_tensor(offsets).to(mean)
    out = mean.new_zeros((count + body_offsets.shape[1],) * 2)
    out[:count, :count], out[:count, count:], out[count:, :count] = mean, body_offsets, body_offsets.T
    return out


@dataclass(frozen=True, eq=False)
class _Search:
    """A search of near pairs.

    Attributes:
        x, version: Positions of the cloth [m], and the tensor's version then.
        at: Positions of cloth and bodies [m], float64.
        inside: As for `near_parts`.
        near: The near pairs; incomplete at the vertices in `unknown`.
        unknown: Vertices of pairs that blocked the move to these positions; None without a move.
    """

    x: Float[Tensor, "vertices 3"]
    version: int
    at: Float[Tensor, "all 3"]
    inside: Bool[Tensor, " all"] | None
    near: NearAt
    unknown: Int[Tensor, " some"] | None = None

    def still_near(
        self, at: Float[Tensor, "all 3"], inside: Bool[Tensor, " all"] | None
    ) -> tuple[Pairs, Bool[Tensor, " all"]] | None:
        """The near pairs of vertices with equal positions here and in the search; None if `FEW_MOVED` is exceeded.

        Args:
            at: Positions of cloth and bodies [m], float64.
            inside: As for `near_parts`.

        Returns:
            The pairs, and a mask of the vertices whose pairs must be searched.
        """
        none = torch.zeros_like(at[:, 0], dtype=torch.bool)
        inside_before, inside_now = (none if mask is None else mask for mask in (self.inside, inside))
        changed = (at != self.at).any(dim=1) | (inside_before ^ inside_now)
        if self.unknown is not None:
            changed[self.unknown] = True
        if int(changed.sum()) > FEW_MOVED * len(at):
            return None
        pairs = self.near.pairs
        return pairs.where(~changed[pairs.corners.long()].any(dim=1)), changed


class ClothSprings:
    """Finder of the contact springs of a level's cloth with itself and with bodies in one frame.

    Attributes:
        owner: Garment of each vertex, then number of each corner's body after those of the garments, int32.
    """

    def __init__(
        self,
        mesh: ClothMesh,
        base: Float[Tensor, "vertices 3"],
        thickness: Float[Tensor, " garments"],
        bodies: FrameBodies | None,
    ) -> None:
        """Take the frame.

        Args:
            base: The upsampled cage [m]; distances between parts in the cage are not widened.
            thickness: Thickness of each garment [m].
        """
        level, none = mesh.level, base.new_zeros((0, 3)).double()
        points = none if bodies is None else bodies.points
        self._mesh, self._cloths, self._area = mesh, len(level.spans), level.vertex_area.double()
        self._keep = _required_gaps(thickness.double(), None if bodies is None else bodies.offsets).contiguous()
        sizes = torch.tensor([len(solid.points) for solid in (() if bodies is None else bodies.solids)]).long()
        body_owner = torch.arange(len(sizes)).repeat_interleave(sizes).to(level.vertex_garment) + self._cloths
        self.owner = torch.cat([level.vertex_garment, body_owner]).to(torch.int32).contiguous()
        self._rest, self._base = (torch.cat([cloth.double(), points]) for cloth in (level.rest, base))
        self._spacing = torch.nn.functional.pad(level.spacing.double(), (0, len(points)), value=torch.inf)
        self._last: _Search | None = None

    @cached_property
    def reach(self) -> Reach:
        """Search radii: half the gap of garments and half of `MARGIN` edges; a body's radius also covers its offset."""
        level, count = self._mesh.level, self._mesh.level.vertex_count
        play, garment = 0.5 * MARGIN * level.spacing.double(), level.vertex_garment.long()
        thickness = self._keep.diagonal()[: self._cloths]
        radius, body_corners = 0.5 * thickness[garment] + play, len(self.owner) - count
        if body_corners:
            beyond = (self._keep[: self._cloths, self._cloths :] - 0.5 * thickness.unsqueeze(1)).amax(dim=0)
            of_body = beyond.clamp_min(0.0) + play.max()
            radius = torch.cat([radius, of_body[self.owner[count:].long() - self._cloths]])
        return Reach(radius, torch.nn.functional.pad(play, (0, body_corners)), HALF)

    def cached(self, x: Float[Tensor, "vertices 3"]) -> NearAt | None:
        """Near pairs at the cloth's positions x [m], if the last search was at x; None otherwise."""
        last = self._last
        return last.near if last is not None and last.x is x and last.version == x._version else None

    def near(
        self,
        x: Float[Tensor, "vertices 3"],
        at: Float[Tensor, "all 3"],
        *,
        queried: Bool[Tensor, " all"] | None,
        inside: Bool[Tensor, " all"] | None,
    ) -> NearAt:
        """Near pairs at the cloth's positions x, with bodies ``at`` [m]; masks are as for `near_parts`.

        If most vertices are where they were in the last search, only pairs of the others are searched.
        """
        near, parts = self.cached(x), self._mesh.parts
        if near is not None:
            return near
        unmoved = None if self._last is None or queried is not None else self._last.still_near(at, inside)
        queried = queried if unmoved is None else unmoved[1]
        near = near_parts(parts, at, self.reach, queried=queried, inside=inside)
        near = near if unmoved is None else NearAt(unmoved[0].joined(near.pairs), self.reach)
        self._last = _Search(x, x._version, at, inside, near)
        return near

    def blocking(
        self,
        begin: Float[Tensor, "all 3"],
        end: Float[Tensor, "all 3"],
        x: Float[Tensor, "vertices 3"],
        *,
        floor: float,
        queried: Bool[Tensor, " all"] | None,
    ) -> Pairs:
        """Pairs that block a move of cloth and bodies to an end with the cloth at x [m]; near pairs are cached."""
        pairs, near = blocking_and_near(self._mesh.parts, begin, end, self.reach, floor=floor, queried=queried)
        self._last = _Search(x, x._version, end, None, near, pairs.corners.long().reshape(-1))
        return pairs

    def find(self, x: Float[Tensor, "all 3"], pairs: Pairs) -> NearSprings:
        """Pairs that have a spring.

        Args:
            x: Positions of cloth and bodies [m], float64.
            pairs: Candidates, each once; must contain all near pairs at x.
        """
        count, device = len(pairs.face), x.device
        weight, separation, offset = (
            torch.empty(shape, dtype=torch.float64, device=device) for shape in ((count, 4), (count, 3), (count,))
        )
        is_near = torch.empty(count, dtype=torch.bool, device=device)
        inputs: list[object] = [argument(points, wp.vec3d) for points in (x.contiguous(), self._rest, self._base)]
        inputs += [argument(self.owner), argument(self._keep.view(-1)), len(self._keep), self._cloths]
        inputs += [argument(self._spacing)]
        inputs += [argument(pairs.corners, wp.vec4i), argument(pairs.face)]
        inputs += [argument(weight, wp.vec4d), argument(separation, wp.vec3d), argument(offset), argument(is_near)]
        run(_find_springs, count, inputs, device=str(device), threads=self._mesh.level.threads)
        rows = torch.nonzero(is_near).squeeze(1)  # One conversion for all fields.
        return NearSprings(pairs.corners, weight, separation, pairs.face, offset).where(rows)

    def constraints(self, near: NearSprings, x: Float[Tensor, "all 3"], stiffness: float) -> PairConstraints:
        """The springs as constraints of the contact force; a body's part of a pair is constant.

        Args:
            x: Positions of cloth and bodies [m], float64.
            stiffness: Stiffness by area [N/m^3].
        """
        count = self._mesh.level.vertex_count
        normal = torch.nn.functional.normalize(near.separation, dim=1, eps=1e-300)
        corners = near.corners.long()
        areas = self._area.index_select(0, corners.clamp_max(count - 1).reshape(-1)).view_as(corners)
        least = torch.where(corners < count, areas, torch.inf)
        share = torch.where(near.face & (corners[:, 0] < count), least[:, 0], least.amin(dim=1) / 3.0)
        return self._mesh.anchored(near.corners, near.weight, normal, near.offset, stiffness * share, x)

    def sided(
        self, near: NearSprings, exempt: Bool[Tensor, " all"] | None
    ) -> tuple[NearSprings, Bool[Tensor, " springs"], Bool[Tensor, "bodies vertices"] | None]:
        """Springs with a certain direction, a mask of springs with bodies, and the vertices on each body's faces.

        Where cloth goes through a body (`exempt`) or lies on it, the shortest vector between edges, or from the body's
        vertices, may point either way; from a vertex outside to a face it points out. Springs of vertices on a face
        have no direction. The vertices are None without any.
        """
        count, corners = self._mesh.level.vertex_count, near.corners.long()
        with_body, of_vertex = corners.amax(dim=1) >= count, near.face & (corners[:, 0] < count)
        touching = with_body & (near.separation.norm(dim=1) < ON_SURFACE)
        out = torch.zeros((len(self._keep) - self._cloths, count), dtype=torch.bool, device=corners.device)
        on = corners[touching & of_vertex]
        out[self.owner[on[:, 3]].long() - self._cloths, on[:, 0]] = True
        either = torch.nn.functional.pad(out.any(dim=0), (0, len(self.owner) - count))
        either = either if exempt is None else either | exempt
        unsure = either.index_select(0, corners.reshape(-1)).view_as(corners).any(dim=1)
        sided = ~with_body | (~touching & (of_vertex | ~unsure))
        kept = torch.nonzero(sided).squeeze(1)  # One conversion for all fields.
        return near.where(kept), with_body[kept], out if len(on) else None
