"""Measures contact from positions alone, without the forces: vertices in bodies, and edges through faces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..colliders.base import Nearest
from ..colliders.mesh import MeshSurface
from ..level import Level

Exits = Callable[[Tensor], tuple[Nearest, Nearest]]
"""Gives the closest points of a surface, and the closest points on exposed faces, for points inside [m]."""
DETOUR = 1.05
"""Ratio of the way out to the closest distance above which the closest face counts as buried."""
DEEP = 1e-4
"""Depth from which a vertex counts as inside [m]."""


@dataclass(frozen=True)
class Penetration:
    """Penetration of a garment into one surface.

    Attributes:
        inside: Number of free vertices deeper than `DEEP` in a closed surface or behind a fixed side, without pinched
            vertices.
        percent: Percentage of all free vertices.
        deepest_mm: Depth of the deepest free vertex [mm].
        pinned: Number of pinned vertices deeper than `DEEP`; pinned vertices stay.
        pinched: Number of free vertices inside whose cloth lies between overlapping parts of the body in the input,
            that are between such parts in the result and farther from any way out than half a cage edge, or whose way
            out ends in another body. Pinched vertices stay, out of sight; forced out, they would fold through their
            neighbours.
        crossings: Number of cloth edges through faces of the body plus body edges through faces of the cloth.
    """

    inside: int = 0
    percent: float = 0.0
    deepest_mm: float = 0.0
    pinned: int = 0
    pinched: int = 0
    crossings: int = 0


def penetration(
    surface: MeshSurface,
    level: Level,
    x: Float[Tensor, "vertices 3"],
    inside: Bool[Tensor, " vertices"],
    *,
    longest: float,
    crossings: int,
    buried: Bool[Tensor, " vertices"] | None = None,
    exits: Exits | None = None,
) -> Penetration:
    """Measure one garment group against one surface.

    Args:
        x: Positions in the surface's coordinates [m].
        inside: The vertices inside.
        longest: Way out from between overlapping parts above which a vertex counts as pinched [m].
        crossings: Number of edges through faces.
        buried: Vertices of cloth between overlapping parts, or None.
        exits: As for `depths`.
    """
    free = level.free[:, 0]
    depth, stays = depths(surface, x, inside, longest, buried=buried, exits=exits)
    deep = (depth > DEEP) & ~stays
    count = int((deep & free).sum())
    deepest = float((depth * (free & ~stays)).max()) if len(depth) else 0.0
    return Penetration(
        inside=count,
        percent=round(100.0 * count / max(int(free.sum()), 1), 4),
        deepest_mm=round(1e3 * deepest, 4),
        pinned=int((deep & ~free).sum()),
        pinched=int((stays & free).sum()),
        crossings=crossings,
    )


def depths(
    surface: MeshSurface,
    x: Float[Tensor, "vertices 3"],
    inside: Bool[Tensor, " vertices"],
    longest: float,
    *,
    buried: Bool[Tensor, " vertices"] | None = None,
    exits: Exits | None = None,
) -> tuple[Float[Tensor, " vertices"], Bool[Tensor, " vertices"]]:
    """Length of each vertex's way out of a surface, or depth without one [m], 0 outside; a mask of pinched vertices.

    Args:
        x: Positions in the surface's coordinates [m].
        inside: The vertices inside.
        longest: Way out from between overlapping parts above which a vertex counts as pinched [m].
        buried: Vertices of cloth between overlapping parts, or None.
        exits: Closest points of the surface and on exposed faces; None for the surface alone.
    """
    depth, stays = torch.zeros_like(x[:, 0]), torch.zeros_like(inside)
    within = torch.nonzero(inside).squeeze(1) if surface.has_inside else depth.long()[:0]
    if len(within):
        if exits is None:
            nearest = surface.closest(x[within])
            exit_points = surface.exit(x[within], nearest)
        else:
            nearest, exit_points = exits(x[within])
        buried_within = None if buried is None else buried[within]
        depth[within] = torch.where(exit_points.distance.isfinite(), exit_points.distance, nearest.distance)
        stays[within] = pinched(nearest, exit_points, longest=longest, buried=buried_within)
    return depth, stays


def pinched(
    nearest: Nearest, exit_points: Nearest, *, longest: float, buried: Bool[Tensor, " points"] | None = None
) -> Bool[Tensor, " points"]:
    """Mask of the inside points between overlapping parts that are too far from a way out, or are buried.

    Args:
        nearest: Closest points.
        exit_points: Closest points on exposed faces.
        longest: Longest way out [m].
        buried: Points of cloth between overlapping parts, which stay wherever they have moved; or None.
    """
    stays = (exit_points.distance > longest) & is_between(nearest, exit_points)
    return stays if buried is None else stays | buried


def is_between(nearest: Nearest, exit_points: Nearest) -> Bool[Tensor, " points"]:
    """Mask of the points between overlapping parts of a surface: the closest face is itself inside the surface.

    Args:
        nearest: Closest points.
        exit_points: Closest points on exposed faces.
    """
    return exit_points.distance > DETOUR * nearest.distance
