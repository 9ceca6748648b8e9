"""Signed distances of a whole garment with as few winding numbers as possible.

If a and b lie on different sides, the segment between them meets the surface, so d(a) + d(b) <= |a - b|. Along edges
that are shorter than the distances of their ends the sign cannot change: one winding number answers for all vertices
that such edges join.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from .base import Surface

MARGIN = 1.001
"""Distances are float32: a segment counts as clear of the surface with this to spare."""


def signed_distances(
    surface: Surface, x: Float[Tensor, "vertices 3"], edges: Int[Tensor, "edges 2"], *, reach: float
) -> Float[Tensor, " vertices"]:
    """Distances to a surface [m], negative inside closed ones; a lower bound over ``reach`` for points farther away.

    Args:
        surface: The surface.
        x: Points in the surface's coordinates [m].
        edges: Pairs of points that are near each other.
        reach: Distance from the surface's bounds over which nothing is asked [m].
    """
    low, high = (torch.as_tensor(corner, dtype=x.dtype, device=x.device) for corner in surface.bounds)
    away = torch.maximum((low - x).clamp_min(0.0), (x - high).clamp_min(0.0)).norm(dim=1)
    out = away.clone()
    near = torch.nonzero(away <= reach).squeeze(1)
    if not len(near):
        return out
    found = surface.closest(x[near], torch.full_like(near, float("inf"), dtype=x.dtype))
    out[near] = found.distance
    if surface.closed:
        asked = found.side == 0
        side = found.side.clone()
        if bool(asked.any()):
            side[asked] = _sides(surface, x, out, near=near[asked], edges=edges)
        out[near] = out[near] * side
    return out


def _sides(surface: Surface, x: Tensor, distance: Tensor, *, near: Tensor, edges: Tensor) -> Float[Tensor, " near"]:
    """1 outside and -1 inside for vertices of one closed mesh."""
    ends = edges.long()
    length = (x[ends[:, 0]] - x[ends[:, 1]]).norm(dim=1)
    clear = (distance[ends[:, 0]] + distance[ends[:, 1]] > MARGIN * length).cpu().numpy()
    pairs = edges.cpu().numpy()[clear]
    graph = sparse.coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(x), len(x)))
    _, label = csgraph.connected_components(graph, directed=False)
    labels = label[near.cpu().numpy()]
    _, first, group = np.unique(labels, return_index=True, return_inverse=True)
    inside = surface.inside(x[near[torch.as_tensor(first, device=x.device)]])
    return 1.0 - 2.0 * inside.to(x.dtype)[torch.as_tensor(group.reshape(-1), device=x.device)]
