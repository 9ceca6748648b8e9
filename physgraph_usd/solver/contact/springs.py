"""The springs between parts of cloth that are near one another, found in one pass over the pairs.

A pair keeps an offset from one another, in metres:

    offset = min(thickness, HALF distance at rest, max(distance in the upsampled cage, LEAST thickness))

and has a spring where it is nearer than that and `MARGIN` of an edge. Between garments the distance at rest says
nothing. The stiffness is that of the cloth by the area for which the pair stands: the vertex's, or a third of the
least of four.
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
from ..collide.narrow_phase import Pairs
from ..collide.near import NearPairs
from ..forces.self_contact import PairConstraints
from ..level import Level
from ..mesh.kernels import KERNELS
from ..mesh.threads import argument, run

wp.set_module_options(KERNELS)

HALF, MARGIN = 0.5, 0.1
"""The part of their distance at rest that pairs of one garment keep at most, so that a flat sheet pushes nothing; and
how much farther than the thickness pairs are asked for, in edges."""
LEAST = 0.25
"""Part of its thickness that cloth keeps from cloth, however near the input has the two."""
_HALF, _MARGIN, _LEAST = (wp.constant(wp.float64(each)) for each in (HALF, MARGIN, LEAST))


@wp.func
def _apart(weight: wp.vec4d, c: wp.vec4i, x: wp.array(dtype=wp.vec3d)):
    """From a pair's second point to its first."""
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
    """Near pairs and what each keeps.

    Attributes:
        near: The pairs.
        offset: The distance that each keeps [m], shape (N,).
    """

    near: NearPairs
    offset: Float[Tensor, " pairs"]

    def where(self, kept: Bool[Tensor, " pairs"]) -> NearSprings:
        """Some of them."""
        return NearSprings(self.near.where(torch.nonzero(kept).squeeze(1)), self.offset[kept])


class ClothSprings:
    """What says which near parts of a level's cloth have a spring, in one frame."""

    def __init__(
        self, level: Level, base: Float[Tensor, "vertices 3"], thickness: Float[Tensor, " garments"], stiffness: float
    ) -> None:
        """Take the frame.

        Args:
            level: The level.
            base: The upsampled cage [m]: distances that it has are not widened.
            thickness: Of each garment [m].
            stiffness: Of cloth against cloth by area [N/m^3].
        """
        self._level, self._stiffness = level, stiffness
        self._rest, self._base = level.rest.double().contiguous(), base.double().contiguous()
        self._garment = level.vertex_garment.to(torch.int32).contiguous()
        self._thickness, self._spacing = thickness.double().contiguous(), level.spacing.double().contiguous()

    def find(self, x: Float[Tensor, "vertices 3"], pairs: Pairs) -> NearSprings:
        """The pairs that have a spring.

        Args:
            x: Positions [m].
            pairs: At least those that are near there, each once.
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
        """Springs as the force reads them."""
        near = springs.near
        area = self._level.vertex_area[near.corners.long()]
        share = torch.where(near.face, area[:, 0], area.amin(dim=1) / 3.0)
        normal = torch.nn.functional.normalize(near.way, dim=1, eps=1e-30).contiguous()
        return PairConstraints(near.corners, near.weight, normal, springs.offset.contiguous(), self._stiffness * share)
