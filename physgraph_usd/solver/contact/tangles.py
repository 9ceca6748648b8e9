"""Tangles: crossings with the cloth around them, and the force that untangles them by shortening the contours.

Where an edge passes through a face, the two surfaces meet along a contour that runs from the crossing into the faces at
the edge. If the edge moves by d relative to the face, the crossing moves on the face by d - (N.d / N.E) E, and the
contour shortens by G.d with

    G = sum_F  R_F - (R_F.E / N.E) N

(after Volino and Magnenat-Thalmann 2006).

| symbol | meaning |
|---|---|
| E | unit direction of the edge |
| N | unit normal of the face |
| F | a face at the edge |
| R_F | unit direction of the contour, from the edge into F |

A move along G shortens contours, whichever side is correct. A straight contour from rim to rim does not shorten.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..collide.crossings import Crossings, Pierced
from ..forces.self_contact import PairConstraints
from ..mesh.stencil import add_at
from ..mesh.topology import joined_by
from .bodies import Chords
from .cloth_mesh import RINGS, ClothMesh

OUT = 0.5
"""Relative move of a crossing edge and face in a round [mean edges]."""
GRAZING = 0.2
"""Least |N.E|: an edge almost parallel to the face would be moved far along the normal."""


@dataclass(frozen=True, eq=False)
class Tangles:
    """The tangles of one level's cloth.

    Attributes:
        label: The tangle of each corner of cloth and bodies, -1 outside tangles, shape (V + B,), int32.
        before: Number of crossings of each tangle, shape (N,).
        hopeless: True for tangles with vertices that are given up, shape (N,), bool.
    """

    label: Int[Tensor, " all"]
    before: Int[Tensor, " tangles"]
    hopeless: Bool[Tensor, " tangles"]
    _mesh: ClothMesh

    @staticmethod
    def find(mesh: ClothMesh, crossings: Crossings, given_up: Bool[Tensor, " all"]) -> Tangles:
        """Tangles: connected components of the crossings and the cloth within `RINGS` rings.

        Args:
            given_up: Mask of the vertices that are given up; all tangles with such vertices are one tangle.
        """
        corners = mesh.corners_of(crossings)
        region = torch.zeros_like(given_up)
        region[corners.reshape(-1)] = True
        region, edges = mesh.grown(region, RINGS) | given_up, mesh.level.edges.long()
        inside = edges[region[edges].all(dim=1)]
        across = torch.cat([corners[:, [0, corner]] for corner in range(1, 5)])
        abandoned = torch.nonzero(given_up).squeeze(1)
        links = torch.stack([abandoned[:1].expand(len(abandoned)), abandoned], dim=1)
        piece = joined_by(torch.cat([inside, across, links]).cpu().numpy(), len(region))
        in_region = region.cpu().numpy()
        label = np.full(len(in_region), -1, np.int32)
        numbers, label[in_region] = np.unique(piece[in_region], return_inverse=True)
        labels = torch.as_tensor(label, device=region.device)
        before = torch.bincount(labels[corners[:, 0]].long(), minlength=len(numbers))
        hopeless = torch.bincount(labels[abandoned].long(), minlength=len(numbers)) > 0
        return Tangles(labels, before, hopeless, mesh)

    def worse(self, crossings: Crossings) -> Bool[Tensor, " all"]:
        """Mask of the vertices of hopeful tangles with more crossings than before."""
        of = self.label[self._mesh.corners_of(crossings)].amax(dim=1).long()
        counts = torch.bincount(of.clamp_min(0), minlength=len(self.before))
        return self._of((counts > self.before) & ~self.hopeless)

    @property
    def given_up(self) -> Bool[Tensor, " all"]:
        """Mask of the vertices of hopeless tangles."""
        return self._of(self.hopeless)

    def hopeful(self, crossings: Crossings) -> Crossings:
        """Crossings outside hopeless tangles."""
        return crossings.where(~self.given_up[self._mesh.corners_of(crossings)].any(dim=1))

    def _of(self, tangles: Bool[Tensor, " tangles"]) -> Bool[Tensor, " all"]:
        return tangles[self.label.clamp_min(0).long()] & (self.label >= 0)


def ways_out(
    mesh: ClothMesh, crossings: Crossings, x: Float[Tensor, "vertices 3"]
) -> tuple[Float[Tensor, "crossings 3"], Float[Tensor, "crossings 4"]]:
    """Direction of each crossing's edge relative to its face that shortens the contour, and the crossing's coordinates.

    Args:
        x: Positions [m].

    Returns:
        Directions, of length at most 1, and coordinates: along the edge, then barycentric on the face.
    """
    ends, face = mesh.edges[crossings.edge], mesh.triangles[crossings.face]
    a, b = x[ends[:, 0]], x[ends[:, 1]]
    p, q, r = (x[face[:, i]] for i in range(3))
    along = torch.nn.functional.normalize(b - a, dim=1, eps=1e-30)
    area = torch.linalg.cross(q - p, r - p)
    normal = torch.nn.functional.normalize(area, dim=1, eps=1e-30)
    into = (normal * (b - a)).sum(dim=1)
    at = ((normal * (p - a)).sum(dim=1) / torch.where(into.abs() > 0, into, torch.ones_like(into))).clamp(0.0, 1.0)
    point = a + at.unsqueeze(1) * (b - a)
    cosine = (normal * along).sum(dim=1)
    cosine = torch.where(cosine < 0, cosine.clamp_max(-GRAZING), cosine.clamp_min(GRAZING))
    direction = torch.zeros_like(a)
    for third in mesh.opposite[crossings.edge].T:
        exists = third >= 0
        side = torch.linalg.cross(b - a, x[third.clamp_min(0)] - a)
        contour = torch.nn.functional.normalize(torch.linalg.cross(normal, side), dim=1, eps=1e-30)
        inwards = x[third.clamp_min(0)] - a
        inwards = inwards - (inwards * along).sum(dim=1, keepdim=True) * along
        contour = torch.where((contour * inwards).sum(dim=1, keepdim=True) < 0, -contour, contour)
        share = (contour * along).sum(dim=1) / cosine
        shortening = contour - share.unsqueeze(1) * normal
        direction = direction + torch.where(exists.unsqueeze(1), shortening, torch.zeros_like(shortening))
    coordinates = torch.cat([at.unsqueeze(1), _barycentric(point, p, q, r)], dim=1)
    return direction / direction.norm(dim=1, keepdim=True).clamp_min(1.0), coordinates


def gaps_out(
    mesh: ClothMesh, crossings: Crossings, x: Float[Tensor, "vertices 3"], *, step: float, stiffness: float
) -> PairConstraints:
    """Constraints that draw crossing edges out of their faces by at most a step.

    Args:
        x: Positions [m].
        step: Relative move of the edge and the face [m].
        stiffness: k_c [N/m^3].
    """
    direction, coordinates = ways_out(mesh, crossings, x)
    ends, face = mesh.edges[crossings.edge], mesh.triangles[crossings.face]
    corners = torch.cat([torch.cat([ends[:, i : i + 1], face], dim=1) for i in range(2)])
    share = torch.cat([1.0 - coordinates[:, 0], coordinates[:, 0]])
    weight = torch.cat([torch.ones_like(coordinates[:, :1]), -coordinates[:, 1:]], dim=1).repeat(2, 1)
    length = direction.norm(dim=1).repeat(2)
    normal = torch.nn.functional.normalize(direction, dim=1, eps=1e-30).repeat(2, 1)
    position = (normal * (weight.unsqueeze(2) * x[corners]).sum(dim=1)).sum(dim=1)
    strength = stiffness * share * mesh.level.vertex_area[corners[:, 0]]
    return PairConstraints(
        corners.to(torch.int32).contiguous(), weight.contiguous(), normal, position + step * length, strength
    )


def chords_of(
    mesh: ClothMesh, pierced: Pierced, x: Float[Tensor, "all 3"], inside: Bool[Tensor, "bodies vertices"]
) -> Chords:
    """Mean crossing of each edge and face of the cloth whose corners and neighbours are outside a body.

    Args:
        pierced: Crossings of cloth and bodies at x.
        x: Positions of cloth and bodies [m].
        inside: The vertices inside each body.
    """
    _, coordinates = ways_out(mesh, pierced.crossings, x)
    edge, face = mesh.edges[pierced.crossings.edge], mesh.triangles[pierced.crossings.face]
    by_edge = pierced.cloth_edge.unsqueeze(1)
    corners = torch.where(by_edge, edge[:, [0, 1, 0, 0]], face[:, [0, 1, 2, 0]])
    along = torch.nn.functional.pad(torch.stack([1.0 - coordinates[:, 0], coordinates[:, 0]], dim=1), (0, 2))
    weight = torch.where(by_edge, along, torch.nn.functional.pad(coordinates[:, 1:], (0, 1)))
    number = torch.where(pierced.cloth_edge, pierced.crossings.edge, pierced.crossings.face + len(mesh.edges))
    key = number * len(inside) + pierced.body
    keys, row = torch.unique(key, return_inverse=True)
    mean = torch.zeros((len(keys), 4), dtype=weight.dtype, device=x.device)
    mean = add_at(mean, row, weight)
    mean = mean / mean.sum(dim=1, keepdim=True)
    first = torch.full_like(keys, len(key)).scatter_reduce(0, row, torch.arange(len(key), device=x.device), "amin")
    body, corners = pierced.body[first], corners[first]
    around = torch.stack([mesh.grown(in_body, 1) for in_body in inside])  # Vertices inside draw their neighbours along.
    outside = ~around[body.unsqueeze(1), corners].any(dim=1)
    return Chords(body[outside], corners[outside], mean[outside].to(mesh.level.rest))


def _barycentric(point: Tensor, p: Tensor, q: Tensor, r: Tensor) -> Float[Tensor, "points 3"]:
    """Barycentric coordinates of points in triangles, clamped to the triangles."""
    normal = torch.linalg.cross(q - p, r - p)
    square = normal.square().sum(dim=1).clamp_min(1e-30)
    first = (torch.linalg.cross(r - q, point - q) * normal).sum(dim=1) / square
    second = (torch.linalg.cross(p - r, point - r) * normal).sum(dim=1) / square
    weight = torch.stack([first, second, 1.0 - first - second], dim=1).clamp_min(0.0)
    return weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-30)
