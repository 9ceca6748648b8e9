"""Signed distances of a whole garment with as few winding numbers as possible.

If a and b lie on different sides, the segment between them meets the surface, so d(a) + d(b) <= |a - b|. Along edges
that are shorter than the distances of their ends the sign cannot change: one winding number answers for all vertices
that such edges join.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.lengths import EdgeLengths
from ..mesh.topology import joined_by
from .base import Nearest, Surface

LEAST_REACH = 1e-3
"""Distance within which closest points are always asked for [m]."""
MARGIN, ROUNDING = 1.001, 1e-6
"""Distances are float32: a segment counts as clear of the surface with so many times its length, and so many metres, to
spare."""


def is_clear(distance: Float[Tensor, " segments"], length: Float[Tensor, " segments"]) -> Bool[Tensor, " segments"]:
    """Whether segments are too short to pass through a surface.

    Args:
        distance: Distances of both ends to it together [m].
        length: Their lengths [m].
    """
    return distance > MARGIN * length + ROUNDING


def signed_distances(
    surface: Surface,
    x: Float[Tensor, "vertices 3"],
    edges: Int[Tensor, "edges 2"],
    *,
    reach: float,
    least: Float[Tensor, " vertices"] | None = None,
) -> Float[Tensor, " vertices"]:
    """Distances to a surface [m], negative inside closed ones and behind open ones with a fixed side.

    For points farther away than ``reach``, on either side, a lower bound.

    Args:
        surface: The surface.
        x: Points in the surface's coordinates [m].
        edges: Pairs of points that are near each other.
        reach: Distance over which only the side is told [m].
        least: Lower bounds that are known [m]; None without. Who is farther away than reach by them is not asked.
    """
    return signed_and_closest(surface, x, edges, reach=reach, least=least)[0]


def signed_and_closest(
    surface: Surface,
    x: Float[Tensor, "vertices 3"],
    edges: Int[Tensor, "edges 2"],
    *,
    reach: float,
    least: Float[Tensor, " vertices"] | None = None,
) -> tuple[Float[Tensor, " vertices"], Nearest | None]:
    """The same, and the closest points of those with negative distances; None where one of them was out of reach.

    Arguments are those of `signed_distances`.
    """
    low, high = (torch.as_tensor(corner, dtype=x.dtype, device=x.device) for corner in surface.bounds)
    away = torch.maximum((low - x).clamp_min(0.0), (x - high).clamp_min(0.0)).norm(dim=1)
    away = away if least is None else torch.maximum(away, least)
    out = away.clone()
    near = torch.nonzero(away <= reach).squeeze(1)
    if not len(near):
        return out, None
    # Behind an open surface cloth may be at any distance.
    limit = float("inf") if surface.fixed_side is not None else max(reach, LEAST_REACH)
    found = surface.closest(x[near], torch.full_like(near, limit, dtype=x.dtype))
    out[near] = found.distance.clamp_max(limit)
    if surface.fixed_side is not None:
        out[near] *= torch.where(behind(found, surface.fixed_side), -1.0, 1.0).to(x.dtype)
    elif surface.certain:
        out[near] *= found.side
    elif surface.closed:
        out[near] *= _sides(surface, x, out, near=near, told=found.side, edges=edges)
    inside = found.some(torch.nonzero(out[near] < 0).squeeze(1))
    return out, inside if bool(inside.distance.isfinite().all()) else None


def behind(found: Nearest, side: Float[Tensor, " points"] | float) -> Bool[Tensor, " points"]:
    """Which points are behind an open surface: on the other side than theirs, and not past its rim.

    Args:
        found: Their closest points.
        side: The side where they belong: 1 the normals', -1 the other, 0 undecided.
    """
    return (found.side * side < 0) & ~found.rim


def _sides(
    surface: Surface, x: Tensor, distance: Tensor, *, near: Tensor, told: Tensor, edges: Tensor
) -> Float[Tensor, " near"]:
    """1 outside and -1 inside for vertices of one closed surface.

    Taken from the closest points where they tell. Where that contradicts a neighbour that no surface divides it from,
    as it does where a face is buried in part only, and where they do not tell, the winding number does.
    """
    side = torch.ones(len(x), dtype=x.dtype, device=x.device)
    side[near] = told
    settled = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    unsure = (side == 0) | _contradicted(side, x, distance, edges=edges)
    while bool(unsure.any()):
        which = torch.nonzero(unsure).squeeze(1)
        joining = _clear_of(unsure[edges[:, 0]] & unsure[edges[:, 1]], x, distance, edges=edges)
        group, one = _joined(which, joining, len(x))
        inside = surface.inside(x[which[one]])
        side[which] = 1.0 - 2.0 * inside.to(x.dtype)[group]
        settled |= unsure
        unsure = _contradicted(side, x, distance, edges=edges) & ~settled
    return side[near]


def _contradicted(side: Tensor, x: Tensor, distance: Tensor, *, edges: Tensor) -> Bool[Tensor, " vertices"]:
    """Vertices told to be on the other side of a neighbour that no surface divides them from."""
    out = torch.zeros(len(side), dtype=torch.bool, device=side.device)
    sign = side.to(torch.int8)
    out[_clear_of(sign[edges[:, 0]] * sign[edges[:, 1]] < 0, x, distance, edges=edges).ravel()] = True
    return out


def _clear_of(which: Tensor, x: Tensor, distance: Tensor, *, edges: Tensor) -> Int[Tensor, "edges 2"]:
    """Those of some edges that no surface divides."""
    some = edges[which]
    ends, length = some.long(), EdgeLengths(some.to(torch.int32), x)(x)
    return ends[is_clear(distance[ends[:, 0]] + distance[ends[:, 1]], length)]


def _joined(which: Tensor, pairs: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Group of each of some vertices that pairs join, and the place of the first of each group."""
    place = torch.zeros(count, dtype=torch.long, device=which.device)
    place[which] = torch.arange(len(which), device=which.device)
    label = joined_by(place[pairs].cpu().numpy(), len(which))
    _, first, group = np.unique(label, return_index=True, return_inverse=True)
    return torch.as_tensor(group.reshape(-1), device=which.device), torch.as_tensor(first, device=which.device)
