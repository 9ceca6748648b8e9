"""Cloth lifted over corners and ridges of a body that pierce faces whose vertices are all outside."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..colliders.base import Surface
from ..colliders.sign import behind
from ..level import Level
from .track import ON_SURFACE

ORDER = 6
"""Subdivisions of a face's sides for the points at which the depth is sampled."""
SIDEWAYS = 0.5
"""Cosine to the face normal below which the way out between sample points counts as sideways."""
LEAST_LIFT = 0.5
"""Minimum move of the deepest point, in clearances."""
OVER = 1.25
"""Overshoot factor of the move, for fewer passes: the way out turns as the point moves."""


def lift_over(
    surface: Surface,
    level: Level,
    x: Float[Tensor, "vertices 3"],
    triangles: Int[Tensor, " triangles"],
    *,
    clearance: Float[Tensor, " vertices"],
    start: Float[Tensor, " vertices"],
) -> Float[Tensor, "vertices 3"]:
    """Moves of vertices that bring the deepest point of each pierced face out, or most of the way [m].

    The point moves to its clearance by the least-norm move of the face's free corners. A corner of several faces takes
    the longest of the faces' moves.

    Args:
        surface: The surface.
        level: The level.
        x: Positions in the surface's coordinates [m].
        triangles: Faces pierced by the surface.
        clearance: Distance to keep [m].
        start: Allowed side of an open surface for each vertex: 1 along the normals, -1 against, 0 undecided.

    Returns:
        Moves [m].
    """
    corners = level.triangles[triangles].long()
    grid = _grid(x)
    points = torch.einsum("pk,tkd->tpd", grid, x[corners])
    sides = start[corners[:, :1]].expand(-1, len(grid)).reshape(-1)
    signed, away = _away(surface, points.reshape(-1, 3), sides)
    signed, away = signed.reshape(points.shape[:2]), away.reshape(points.shape)
    each = torch.arange(len(corners), device=x.device)
    deepest = signed.argmin(dim=1)
    weight = grid[deepest] * level.free[corners, 0]
    kept = (grid[deepest] * clearance[corners]).sum(dim=1)
    # What comes through between the points is at least near one.
    lack = OVER * torch.maximum(kept - signed[each, deepest], LEAST_LIFT * kept)
    way = torch.where(
        (signed[each, deepest] > 0).unsqueeze(1), _up(x[corners], away[each, deepest]), away[each, deepest]
    )
    share = weight / weight.square().sum(dim=1, keepdim=True).clamp_min(1e-9)
    move = share.unsqueeze(2) * (lack.unsqueeze(1) * way).unsqueeze(1)
    best, length = torch.zeros_like(x), torch.zeros_like(x[:, 0])
    which, move = corners.reshape(-1), move.reshape(-1, 3)
    length.scatter_reduce_(0, which, move.norm(dim=1), "amax")
    largest = torch.nonzero((move.norm(dim=1) >= length[which]) & (length[which] > 0)).squeeze(1)
    best[which[largest]] = move[largest]
    return best


def _up(corners: Float[Tensor, "triangles 3 3"], away: Float[Tensor, "triangles 3"]) -> Float[Tensor, "triangles 3"]:
    """Unit directions out of a surface that pierces a face between sample points: past a needle's tip, not sideways."""
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=1, eps=1e-30)
    cosine = (normal * away).sum(dim=1, keepdim=True)
    return torch.where(cosine.abs() < SIDEWAYS, torch.where(cosine < 0, -normal, normal), away)


def _away(surface: Surface, points: Float[Tensor, "points 3"], start: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distances [m] and unit directions out of a closed surface, or to the start side of an open surface."""
    found = surface.closest(points, torch.full_like(points[:, 0], float("inf")))
    open_side = torch.where(behind(found, start), -1.0, 1.0).to(found.side)
    side = found.side.clone() if surface.closed else open_side
    ask = side == 0
    if bool(ask.any()):
        side[ask] = 1.0 - 2.0 * surface.inside(points[ask]).to(side)
    away = (points - found.point) * side.unsqueeze(1)
    outward = found.normal * torch.where(start < 0, -1.0, 1.0).to(points).unsqueeze(1)
    away = torch.where((found.distance > ON_SURFACE).unsqueeze(1), away, outward)
    return found.distance * side, torch.nn.functional.normalize(away, dim=1, eps=1e-30)


def _grid(like: Tensor) -> Float[Tensor, "points 3"]:
    """Barycentric coordinates of a regular grid of points on a triangle."""
    cells = [(i, j, ORDER - i - j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]
    return torch.tensor(cells, dtype=like.dtype, device=like.device) / ORDER
