"""Signed distances of a whole garment with as few winding numbers as possible.

If a and b lie on different sides, the segment between them meets the surface, so d(a) + d(b) <= |a - b|. Along an edge
shorter than the sum of its ends' distances the sign cannot change. A single winding number therefore decides for all
vertices connected by short edges.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false
from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.kernels import KERNELS, start_warp
from ..mesh.stencil import vectors
from ..mesh.threads import argument, run
from ..mesh.topology import joined_by
from .base import Nearest, Surface

wp.set_module_options(KERNELS)

LEAST_REACH = 1e-3
"""Least search distance of closest points [m]."""
MARGIN, ROUNDING = 1.001, 1e-6
"""Factor on the length and margin [m] for a segment to count as clear of the surface: distances are float32."""


@wp.func
def _is_clear(edge: wp.vec2i, x: wp.array(dtype=wp.vec3f), distance: wp.array(dtype=wp.float32)):
    """Whether an edge is too short to pass through a surface, by its ends' distances from it [m]."""
    length = wp.length(x[edge[1]] - x[edge[0]])
    return distance[edge[0]] + distance[edge[1]] > MARGIN * length + ROUNDING


@wp.kernel
def _contradict(
    first: wp.int32,
    edges: wp.array(dtype=wp.vec2i),
    x: wp.array(dtype=wp.vec3f),
    distance: wp.array(dtype=wp.float32),
    side: wp.array(dtype=wp.int8),
    out: wp.array(dtype=wp.bool),
):
    i = first + wp.tid()
    a, b = edges[i][0], edges[i][1]
    if int(side[a]) * int(side[b]) < 0 and _is_clear(edges[i], x, distance):
        out[a] = True
        out[b] = True


@wp.kernel
def _join(
    first: wp.int32,
    edges: wp.array(dtype=wp.vec2i),
    x: wp.array(dtype=wp.vec3f),
    distance: wp.array(dtype=wp.float32),
    some: wp.array(dtype=wp.bool),
    out: wp.array(dtype=wp.bool),
):
    i = first + wp.tid()
    if some[edges[i][0]] and some[edges[i][1]]:
        out[i] = _is_clear(edges[i], x, distance)


def signed_distances(
    surface: Surface, x: Float[Tensor, "vertices 3"], edges: Int[Tensor, "edges 2"], *, reach: float
) -> Float[Tensor, " vertices"]:
    """Distances to a surface [m], negative inside closed surfaces and behind open surfaces with a fixed side.

    Beyond ``reach``, on either side, the distance is a lower bound.

    Args:
        surface: The surface.
        x: Points in the surface's coordinates [m].
        edges: Pairs of neighbouring points.
        reach: Distance beyond which only the side is determined [m].
    """
    low, high = (torch.as_tensor(corner, dtype=x.dtype, device=x.device) for corner in surface.bounds)
    out = torch.maximum((low - x).clamp_min(0.0), (x - high).clamp_min(0.0)).norm(dim=1)
    near = torch.nonzero(out <= reach).squeeze(1)
    if not len(near):
        return out
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
    return out


def behind(found: Nearest, side: Float[Tensor, " points"] | float) -> Bool[Tensor, " points"]:
    """Mask of the points behind an open surface: on the disallowed side, and not past the rim.

    Args:
        found: Closest points of the points.
        side: Allowed side: 1 along the normals, -1 against, 0 undecided.
    """
    return (found.side * side < 0) & ~found.rim


def _sides(
    surface: Surface, x: Tensor, distance: Tensor, *, near: Tensor, told: Tensor, edges: Tensor
) -> Float[Tensor, " near"]:
    """1 outside and -1 inside for vertices of one closed surface.

    Sides come from the closest points if these give a side. The winding number decides for all remaining vertices, and
    where sides contradict a neighbour on a clear edge, as at partly buried faces.
    """
    side = torch.ones(len(x), dtype=x.dtype, device=x.device)
    side[near] = told
    settled = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    unsure = (side == 0) | _contradicted(side, x, distance, edges=edges)
    while bool(unsure.any()):
        which = torch.nonzero(unsure).squeeze(1)
        joining = _clear_among(unsure, x, distance, edges=edges)
        group, one = _joined(which, joining, len(x))
        inside = surface.inside(x[which[one]])
        side[which] = 1.0 - 2.0 * inside.to(x.dtype)[group]
        settled |= unsure
        unsure = _contradicted(side, x, distance, edges=edges) & ~settled
    return side[near]


def _contradicted(side: Tensor, x: Tensor, distance: Tensor, *, edges: Tensor) -> Bool[Tensor, " vertices"]:
    """Mask of the vertices with a side unlike a neighbour's on a clear edge."""
    out = torch.zeros(len(side), dtype=torch.bool, device=side.device)
    _ask_edges(_contradict, edges, x, distance, argument(side.to(torch.int8)), argument(out))
    return out


def _clear_among(some: Tensor, x: Tensor, distance: Tensor, *, edges: Tensor) -> Int[Tensor, "edges 2"]:
    """Edges between some vertices that cannot pass through the surface."""
    out = torch.zeros(len(edges), dtype=torch.bool, device=x.device)
    _ask_edges(_join, edges, x, distance, argument(some), argument(out))
    return edges[out].long()


def _ask_edges(kernel: wp.Kernel, edges: Tensor, x: Tensor, distance: Tensor, *more: Any) -> None:
    """Launch over edges; the kernel's first arguments are the edges, the points and the points' distances."""
    if not len(edges):
        return
    start_warp()  # Views of tensors do not start Warp by themselves.
    points, away = (each.to(torch.float32).contiguous() for each in (x, distance))
    where = [argument(edges.to(torch.int32).contiguous(), wp.vec2i), vectors(points), argument(away)]
    run(kernel, len(edges), [*where, *more], device=str(x.device))


def _joined(which: Tensor, pairs: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Group of each vertex by connecting pairs, and the position of the first vertex of each group."""
    place = torch.zeros(count, dtype=torch.long, device=which.device)
    place[which] = torch.arange(len(which), device=which.device)
    label = joined_by(place[pairs].cpu().numpy(), len(which))
    _, first, group = np.unique(label, return_index=True, return_inverse=True)
    return torch.as_tensor(group.reshape(-1), device=which.device), torch.as_tensor(first, device=which.device)
