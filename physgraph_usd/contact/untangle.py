"""The way out of a crossing: intersection contour minimisation.

Where an edge passes through a face, the two surfaces meet along a contour that runs from there into the faces at the
edge. If the edge moves by d relative to the face, its point on the face moves by d - (N.d / N.E) E, and the contour
grows shorter by G.d with

    G = sum_F  R_F - (R_F.E / N.E) N

(after Volino and Magnenat-Thalmann 2006).

| symbol | meaning |
|---|---|
| E | unit direction of the edge |
| N | unit normal of the face |
| F | a face at the edge |
| R_F | unit direction of the contour, from the edge into F |

Moved along G, contours shrink, whichever side is the right one. A straight contour from rim to rim does not: there the
piece that the contour cuts off, the smaller one, is on the wrong side (Baraff, Witkin and Kass 2003), and pairs of such
pieces turn round.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..forces.self_contact import Gaps
from ..level import Level
from ..mesh.topology import joined_by
from .cloth_mesh import ClothMesh, Crossings

GRAZING = 0.2
"""Least |N.E|: an edge that lies almost in the face would be sent far along the normal."""
NEAR = 2
"""Rings round crossing edges within which their ends mostly hang together without them."""


def ways_out(
    mesh: ClothMesh, crossings: Crossings, x: Float[Tensor, "vertices 3"]
) -> tuple[Float[Tensor, "crossings 3"], Float[Tensor, "crossings 4"]]:
    """For each crossing the direction in which its edge should move, relative to its face, and where it is.

    Args:
        mesh: The cloth.
        crossings: What crosses.
        x: Positions [m].

    Returns:
        Directions, at most of length 1, and the place: along the edge, then barycentric on the face.
    """
    ends, face = mesh.level.edges[crossings.edge].long(), mesh.triangles[crossings.face]
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
    way = torch.zeros_like(a)
    for third in mesh.opposite[crossings.edge].T:
        there = third >= 0
        side = torch.linalg.cross(b - a, x[third.clamp_min(0)] - a)
        contour = torch.nn.functional.normalize(torch.linalg.cross(normal, side), dim=1, eps=1e-30)
        inwards = x[third.clamp_min(0)] - a
        inwards = inwards - (inwards * along).sum(dim=1, keepdim=True) * along
        contour = torch.where((contour * inwards).sum(dim=1, keepdim=True) < 0, -contour, contour)
        share = (contour * along).sum(dim=1) / cosine
        way = way + torch.where(there.unsqueeze(1), contour - share.unsqueeze(1) * normal, torch.zeros_like(way))
    place = torch.cat([at.unsqueeze(1), _barycentric(point, p, q, r)], dim=1)
    return way / way.norm(dim=1, keepdim=True).clamp_min(1.0), place


def cut_off(mesh: ClothMesh, crossings: Crossings) -> Bool[Tensor, " vertices"]:
    """Vertices of pieces that contours cut off: all but the largest piece of what hangs together without crossings.

    Args:
        mesh: The cloth.
        crossings: What crosses.
    """
    if _stays_joined(mesh, crossings):
        return torch.zeros_like(mesh.level.free[:, 0])
    piece, off, _ = pieces_of(mesh, crossings)
    return torch.as_tensor(off[piece], device=mesh.level.rest.device)


def _stays_joined(mesh: ClothMesh, crossings: Crossings) -> bool:
    """Whether the ends of every crossing edge hang together near it without any of those: then nothing is cut off."""
    ends, crossing = mesh.level.edges.cpu().numpy(), crossings.edge.cpu().numpy()
    around = torch.zeros_like(mesh.level.free[:, 0])
    around[torch.as_tensor(ends[crossing].reshape(-1), device=around.device).long()] = True
    close = mesh.grown(around, NEAR).cpu().numpy()
    whole = close[ends[:, 0]] & close[ends[:, 1]]
    whole[crossing] = False
    near = np.flatnonzero(whole)
    joints = np.concatenate([ends[near], mesh.sewn[close[mesh.sewn].all(axis=1)]])
    places, number = np.unique(np.concatenate([ends[crossing], joints]), return_inverse=True)
    number = number.reshape(-1, 2)
    piece = joined_by(number[len(crossing) :], len(places))[number[: len(crossing)]]
    return bool((piece[:, 0] == piece[:, 1]).all())


def pieces_of(mesh: ClothMesh, crossings: Crossings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pieces into which contours cut the cloth.

    Args:
        mesh: The cloth.
        crossings: What crosses.

    Returns:
        The piece of each vertex, which pieces are cut off (smaller than the largest of what hangs together without
        crossings), and their areas [m^2].
    """
    count = mesh.level.vertex_count
    ends = mesh.level.edges.cpu().numpy()
    kept = np.ones(len(ends), bool)
    kept[crossings.edge.cpu().numpy()] = False
    whole, piece = mesh.whole, joined_by(np.concatenate([ends[kept], mesh.sewn]), count)
    area = np.bincount(piece, mesh.level.vertex_area.double().cpu().numpy())
    first = np.unique(piece, return_index=True)[1]
    largest = np.zeros(int(whole.max()) + 1)
    np.maximum.at(largest, whole[first], area)
    return piece, area < largest[whole[first]], area


def gaps_out(
    mesh: ClothMesh, crossings: Crossings, x: Float[Tensor, "vertices 3"], *, step: float, stiffness: float
) -> Gaps:
    """Planes that draw crossing edges out of their faces by a step at most.

    Args:
        mesh: The cloth.
        crossings: What crosses at x.
        x: Positions [m].
        step: How far the edge and the face are moved apart [m].
        stiffness: k_c [N/m^3].
    """
    level: Level = mesh.level
    way, place = ways_out(mesh, crossings, x)
    ends, face = level.edges[crossings.edge].long(), mesh.triangles[crossings.face]
    corners = torch.cat([torch.cat([ends[:, i : i + 1], face], dim=1) for i in range(2)])
    share = torch.cat([1.0 - place[:, 0], place[:, 0]])
    weight = torch.cat([torch.ones_like(place[:, :1]), -place[:, 1:]], dim=1).repeat(2, 1)
    length = way.norm(dim=1).repeat(2)
    normal = torch.nn.functional.normalize(way, dim=1, eps=1e-30).repeat(2, 1)
    here = (normal * (weight.unsqueeze(2) * x[corners]).sum(dim=1)).sum(dim=1)
    strength = stiffness * share * level.vertex_area[corners[:, 0]]
    return Gaps(corners.to(torch.int32).contiguous(), weight.contiguous(), normal, here + step * length, strength)


def _barycentric(point: Tensor, p: Tensor, q: Tensor, r: Tensor) -> Float[Tensor, "points 3"]:
    """Barycentric coordinates of points in triangles, clamped to them."""
    normal = torch.linalg.cross(q - p, r - p)
    whole = normal.square().sum(dim=1).clamp_min(1e-30)
    first = (torch.linalg.cross(r - q, point - q) * normal).sum(dim=1) / whole
    second = (torch.linalg.cross(p - r, point - r) * normal).sum(dim=1) / whole
    weight = torch.stack([first, second, 1.0 - first - second], dim=1).clamp_min(0.0)
    return weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-30)


def swapped_by(
    off: Bool[Tensor, "pairs 4"], face: Bool[Tensor, " pairs"], split: Bool[Tensor, "pairs 2"]
) -> tuple[Bool[Tensor, " pairs"], Bool[Tensor, " pairs"]]:
    """Which pairs are to change sides, and which are beside a contour and have none.

    Args:
        off: Whether each corner is of a piece that is cut off.
        face: Whether the pair is a vertex and a face.
        split: Whether the first and the second garment of each pair have such pieces at all.
    """
    first = torch.where(face, off[:, 0], off[:, :2].all(dim=1))
    second = torch.where(face, off[:, 1:].all(dim=1), off[:, 2:].all(dim=1))
    both = first & second
    swapped = both | (first & ~split[:, 1]) | (second & ~split[:, 0])
    return swapped, (first ^ second) & ~swapped
