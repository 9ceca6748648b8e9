"""Contact springs between near parts of the cloth, found in one pass over the pairs.

Each pair has an offset, the distance to keep, in metres:

    offset = min(thickness, HALF distance at rest, max(distance in the upsampled cage, LEAST thickness))

A pair has a spring if its distance is less than the offset plus `MARGIN` of an edge. Between garments the distance at
rest is ignored. The stiffness is the cloth's times the area of the pair: the vertex's area, or a third of the least of
the four corners' areas.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false
from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.distance import weights_of
from ..collide.pairs import NearPairs, Pairs
from ..forces.self_contact import PairConstraints
from ..level import Level
from ..mesh.kernels import KERNELS
from ..mesh.threads import argument, run

wp.set_module_options(KERNELS)

HALF, MARGIN = 0.5, 0.1
"""Largest offset of a pair in a garment as a fraction of its distance at rest, so that a flat sheet exerts no force;
and the search distance beyond the thickness, in edges."""
LEAST = 0.25
"""Minimum offset as a fraction of the thickness, however close the parts are in the input."""
_HALF, _MARGIN, _LEAST = (wp.constant(wp.float64(each)) for each in (HALF, MARGIN, LEAST))


@wp.func
def _apart(weight: wp.vec4d, c: wp.vec4i, x: wp.array(dtype=wp.vec3d)):
    """Vector from a pair's second point to its first."""
    return weight[0] * x[c[0]] + weight[1] * x[c[1]] + weight[2] * x[c[2]] + weight[3] * x[c[3]]


@wp.kernel
def _find_springs(
    first: wp.int32,
    x: wp.array(dtype=wp.vec3d),
    rest: wp.array(dtype=wp.vec3d),
    base: wp.array(dtype=wp.vec3d),
    garment: wp.array(dtype=wp.int32),
    thickness: wp.array(dtype=wp.float64),
    spacing: wp.array(dtype=wp.float64),
    corners: wp.array(dtype=wp.vec4i),
    face: wp.array(dtype=wp.bool),
    weight: wp.array(dtype=wp.vec4d),
    way: wp.array(dtype=wp.vec3d),
    offset: wp.array(dtype=wp.float64),
    kept: wp.array(dtype=wp.bool),
):
    i = first + wp.tid()
    c = corners[i]
    w = weights_of(face[i], x[c[0]], x[c[1]], x[c[2]], x[c[3]])
    between = _apart(w, c, x)
    distance = wp.length(between)
    edge = wp.min(wp.min(spacing[c[0]], spacing[c[1]]), wp.min(spacing[c[2]], spacing[c[3]]))
    thick = wp.float64(0.5) * (thickness[garment[c[0]]] + thickness[garment[c[3]]])
    near = distance < thick + _MARGIN * edge
    if near:
        keeps = wp.min(thick, wp.max(wp.length(_apart(w, c, base)), _LEAST * thick))
        if garment[c[0]] == garment[c[3]]:
            keeps = wp.min(keeps, _HALF * wp.length(_apart(w, c, rest)))
        near = distance < keeps + _MARGIN * edge
        weight[i] = w
        way[i] = between
        offset[i] = keeps
    kept[i] = near


@dataclass(frozen=True, eq=False)
class NearSprings:
    """Near pairs and their offsets.

    Attributes:
        near: The pairs.
        offset: Distance that each pair keeps [m], shape (N,).
    """

    near: NearPairs
    offset: Float[Tensor, " pairs"]

    def where(self, kept: Bool[Tensor, " pairs"]) -> NearSprings:
        """The selected springs."""
        return NearSprings(self.near.where(torch.nonzero(kept).squeeze(1)), self.offset[kept])


class ClothSprings:
    """Finder of the contact springs of a level's cloth in one frame."""

    def __init__(
        self, level: Level, base: Float[Tensor, "vertices 3"], thickness: Float[Tensor, " garments"], stiffness: float
    ) -> None:
        """Take the frame.

        Args:
            level: The level.
            base: The upsampled cage [m]; distances between parts in the cage are not widened.
            thickness: Thickness of each garment [m].
            stiffness: Contact stiffness of cloth with cloth by area [N/m^3].
        """
        self._level, self._stiffness = level, stiffness
        self._rest, self._base = level.rest.double().contiguous(), base.double().contiguous()
        self._garment = level.vertex_garment.to(torch.int32).contiguous()
        self._thickness, self._spacing = thickness.double().contiguous(), level.spacing.double().contiguous()

    def find(self, x: Float[Tensor, "vertices 3"], pairs: Pairs) -> NearSprings:
        """Pairs that have a spring.

        Args:
            x: Positions [m].
            pairs: Candidates, each once; must contain all near pairs at x.
        """
        count, device = len(pairs.face), x.device
        weight, way, offset = (
            torch.empty(shape, dtype=torch.float64, device=device) for shape in ((count, 4), (count, 3), (count,))
        )
        kept = torch.empty(count, dtype=torch.bool, device=device)
        at = x.double().contiguous()
        inputs: list[object] = [argument(each, wp.vec3d) for each in (at, self._rest, self._base)]
        inputs += [argument(each) for each in (self._garment, self._thickness, self._spacing)]
        inputs += [argument(pairs.corners, wp.vec4i), argument(pairs.face)]
        inputs += [argument(weight, wp.vec4d), argument(way, wp.vec3d), argument(offset), argument(kept)]
        run(_find_springs, count, inputs, device=str(device), threads=self._level.threads)
        some = torch.nonzero(kept).squeeze(1)  # Once for all that follows.
        near = NearPairs(pairs.corners[some], weight[some].to(x), way[some].to(x), pairs.face[some])
        return NearSprings(near, offset[some].to(x))

    def constraints(self, springs: NearSprings) -> PairConstraints:
        """The springs as constraints of the contact force."""
        near = springs.near
        area = self._level.vertex_area[near.corners.long()]
        share = torch.where(near.face, area[:, 0], area.amin(dim=1) / 3.0)
        normal = torch.nn.functional.normalize(near.way, dim=1, eps=1e-30).contiguous()
        return PairConstraints(near.corners, near.weight, normal, springs.offset.contiguous(), self._stiffness * share)
