"""How much of a cage lies in or near closed bodies that it does not feel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ..colliders.mesh import MeshBody
from ..colliders.pose import MeshPose
from ..colliders.sign import signed_distances
from ..scene import Garment
from .broad_phase import mean_edge

NEAR = 0.025
"""How near a body is taken for one that cloth lies on [m]: solvers keep up to 2 cm, and rounding adds."""
TRIM = 4.0
"""Bodies without a side of so many of the cage's edges are buttons and buckles: no cloth drapes over them."""


def smallest_body(garments: Sequence[Garment]) -> float:
    """Longest side of the smallest body that some garment could drape over [m]."""
    return TRIM * min(map(mean_edge, garments), default=0.0)


def share_at(body: MeshBody, pose: MeshPose, garment: Garment, cage: np.ndarray) -> float:
    """Share of a cage's vertices that is in a body's closed part or near it.

    Args:
        body: The body.
        pose: Where it is.
        garment: The garment.
        cage: Positions of its cage [m], shape (V, 3).

    Returns:
        The share; 0 where it does not touch it. A room or a sky that holds all of it, with nothing near its walls, is
        not touched.
    """
    share, edges = 0.0, torch.as_tensor(garment.mesh.half_edges.edges)
    for surface in body.pose(pose):
        if surface.closed:
            signed = signed_distances(surface, torch.as_tensor(cage - surface.origin), edges, reach=2.0 * NEAR)
            touches = (signed.abs() <= NEAR).any() or ((signed < 0).any() and (signed > 0).any())
            share = max(share, float((signed <= NEAR).double().mean())) if bool(touches) else share
    return share
