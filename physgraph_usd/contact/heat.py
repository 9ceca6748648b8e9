"""Contact per vertex, for heat maps: measured from positions alone, like `measure`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ..colliders.base import Surface
from ..colliders.sign import signed_distances
from .measure import depths


def penetration_map(
    surfaces: Sequence[Surface], points: np.ndarray, edges: np.ndarray, *, device: str = "cpu"
) -> np.ndarray:
    """How deep each vertex is in the deepest of some bodies [mm].

    Inside closed bodies it is the way out; behind open ones whose side is fixed, the distance. Open ones whose side the
    coarse cloth decides have no inside.

    Args:
        surfaces: The posed bodies.
        points: World positions [m], shape (V, 3), float64.
        edges: Pairs of vertices that are near each other, shape (E, 2).
        device: "cpu" or a CUDA device.

    Returns:
        Shape (V,), float32, 0 outside.
    """
    deepest = torch.zeros(len(points), dtype=torch.float64, device=device)
    pairs = torch.as_tensor(np.ascontiguousarray(edges, np.int32), device=device)
    for surface in surfaces:
        if not (surface.closed or surface.fixed_side is not None):
            continue
        x = torch.as_tensor(points - surface.origin, dtype=torch.float64, device=device)
        signed = signed_distances(surface, x, pairs, reach=0.0)
        depth = depths(surface, x, signed, float("inf"))[0] if surface.closed else (-signed).clamp_min(0.0)
        deepest = torch.maximum(deepest, depth)
    return (1e3 * deepest).to(torch.float32).cpu().numpy()
