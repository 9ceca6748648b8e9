"""Contact of cloth with cloth: springs that keep parts apart, each pair represented by a plane.

    E = 1/2 sum_g k_g phi_g^2,   phi_g = max(offset_g - n_g . sum_i w_gi x_i, 0)

| symbol | here | meaning |
|---|---|---|
| sum_i w_gi x_i | ``vectors`` | from point to point: vertex, face (1, -b0, -b1, -b2), edges (1-s, s, t-1, -t) |
| n_g | ``PairConstraints.normal`` | the side of the first point, a unit vector |
| k_g | ``PairConstraints.stiffness`` | k_c times the pair's area [N/m] |

Pairs, weights and normals are constant during the life of the term, so the energy is a convex function of x only.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..level import Level
from ..mesh.formula import QUAD, element_kernels
from ..mesh.stencil import add_at, incidence
from .base import Elements


@dataclass(frozen=True, eq=False)
class PairConstraints:
    """Pairs of material points kept on their sides.

    Attributes:
        corners: Vertices of each pair, shape (N, 4), int32.
        weight: Weights of the vertices, shape (N, 4); each row sums to 0, but where one of the points is constant.
        normal: From the second point to the first, unit, shape (N, 3).
        offset: Distance kept, more by the height of a constant point along the normal [m], shape (N,).
        stiffness: [N/m], shape (N,).
    """

    corners: Int[Tensor, "gaps 4"]
    weight: Float[Tensor, "gaps 4"]
    normal: Float[Tensor, "gaps 3"]
    offset: Float[Tensor, " gaps"]
    stiffness: Float[Tensor, " gaps"]

    def where(self, selected: Bool[Tensor, " gaps"]) -> PairConstraints:
        """The selected pairs."""
        numbers = torch.nonzero(selected).squeeze(1)
        return PairConstraints(*(getattr(self, field.name).index_select(0, numbers) for field in fields(self)))

    def with_more(self, added: PairConstraints) -> PairConstraints:
        """Both sets of pairs combined."""
        return PairConstraints(
            *(torch.cat([getattr(self, field.name), getattr(added, field.name)]) for field in fields(self))
        )

    def sharing_room(self, x: Float[Tensor, "vertices 3"]) -> PairConstraints:
        """The constraints, with contradicting goals lowered so that cloth without room rests in the middle.

        At each vertex, the deepest constraint at x [m] is compared with the constraints against its normal.
        """
        if not len(self.corners):
            return self
        corners, depth = self.corners.long(), self.offset - (self.normal * self.vectors(x)).sum(dim=1)
        depth, directions = depth.unsqueeze(1).expand(-1, 4), self.weight.sign().unsqueeze(2) * self.normal.unsqueeze(1)

        def largest(value: Tensor) -> Tensor:
            value = torch.where(self.weight != 0, value, 0).reshape(-1)
            return value.new_zeros(len(x)).scatter_reduce(0, corners.reshape(-1), value, "amax")

        deepest = largest(depth)
        index = torch.arange(depth.numel(), device=x.device).reshape(-1, 4)
        axis = directions.reshape(-1, 3)[largest(torch.where(depth == deepest[corners], index, 0))]
        along = (directions * axis[corners]).sum(dim=2)
        share = along.square()  # The wider a wedge is, the more of a way out it leaves.
        lack = largest(torch.where(along < 0, 0.5 * share, 0.0) * (depth + deepest[corners]))
        return replace(self, offset=self.offset - (self.weight.abs() * share * lack[corners]).sum(dim=1))

    def vectors(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "gaps 3"]:
        """From the second point to the first [m]."""
        at = x.index_select(0, self.corners.reshape(-1)).reshape(-1, 4, 3)  # An index takes four times as long.
        first, second, third, fourth = (self.weight.unsqueeze(2) * at).unbind(dim=1)
        return first + second + third + fourth

    def penetration(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " gaps"]:
        """Depth of each pair below its offset [m], not below zero."""
        return (self.offset - (self.normal * self.vectors(x)).sum(dim=1)).clamp_min(0.0)


_KERNELS = element_kernels(
    "contact",
    """
    Quad w = load4(parameter0), plane = load4(parameter1);
    Vec normal = {plane[0], plane[1], plane[2]}, at = {};
    for (int k = 0; k < 4; ++k) at = at + corner(k) * w[k];
    Number depth = larger(plane[3] - dot(normal, at), Number{});
    Vec push = normal * depth;
    store(0.5f * depth * depth, {push * w[0], push * w[1], push * w[2], push * w[3]});
    """,
    corners=4,
    parameter=QUAD,
)


LEAST_ROOM, ROOM_GROWTH = 4096, 4
"""Least room for pairs on a card, and factor of the next larger room: each room is recorded by itself."""


class SelfContact:
    """Springs keeping pairs of material points apart.

    Attributes:
        name: Name of the term in reports.
    """

    def __init__(self, level: Level, gaps: PairConstraints, name: str = "self_contact") -> None:
        """Take the pairs."""
        self.gaps, self.name, self._level = gaps, name, level

    @cached_property
    def _plane(self) -> Float[Tensor, "gaps 4"]:
        """Normal and offset of each pair, for unit stiffness."""
        return torch.cat([self.gaps.normal, self.gaps.offset.unsqueeze(1)], 1) * self.gaps.stiffness.sqrt().unsqueeze(1)

    @cached_property
    def _elements(self) -> Elements:
        """The pairs as elements of unit stiffness, built on first use."""
        return Elements(_KERNELS, self.gaps.corners, [self.gaps.weight.contiguous(), self._plane], level=self._level)

    @property
    def aims(self) -> tuple[Tensor, ...]:
        """`with_room` on a card."""
        return self.with_room if self.gaps.corners.is_cuda else ()

    @cached_property
    def with_room(self) -> tuple[Tensor, ...]:
        """Corners, weights, planes, and rows of `incidence`, with room for more pairs, of no weight.

        Equal room for different pairs makes the arrays' shapes equal, which a recording needs.
        """
        corners, weight = self.gaps.corners, self.gaps.weight
        starts, slots = incidence(corners, self._level.vertex_count)
        room = LEAST_ROOM
        while room < len(corners):
            room *= ROOM_GROWTH
        pad, padding = torch.nn.functional.pad, room - len(corners)
        padded = [pad(array, (0, 0, 0, padding)) for array in (corners, weight, self._plane)]
        return *padded, starts, pad(slots, (0, 4 * padding))

    def aimed(self, *aims: Tensor) -> SelfContact:
        """The term of other pairs, given `with_room`."""
        term, (corners, weight, plane, *rows) = copy.copy(self), aims
        term._elements = Elements(_KERNELS, corners, [weight, plane], level=self._level, rows=(rows[0], rows[1]))
        return term

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        return self._elements.evaluate(x, force)

    def split(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " parts"], Int[Tensor, " parts"]]:
        """Energy of each pair [J] at the last evaluated positions, and the garment of the first corner."""
        return self._elements.energy, self._level.vertex_garment[self.gaps.corners[:, 0].long()]

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """k w^2 / 3 of the pushing pairs, summed at each vertex [N/m]."""
        value = (
            (self.gaps.penetration(x) > 0).to(x).unsqueeze(1) * self.gaps.stiffness.unsqueeze(1) * self.gaps.weight**2
        )
        return add_at(torch.zeros_like(x[:, 0]), self.gaps.corners.long().reshape(-1), value.reshape(-1) / 3.0)

    def rest_springs(self) -> tuple[float, float]:
        """None: no contact at rest."""
        return 0.0, 0.0
