"""Contact per vertex for heat maps, measured from positions alone, like `measure`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ..collide.crossings import all_crossings
from ..colliders.base import Surface
from ..level import Level
from .cloth_mesh import ClothMesh
from .measure import depths


def penetration_map(surfaces: Sequence[Surface], points: np.ndarray, *, device: str = "cpu") -> np.ndarray:
    """Depth of each vertex in the deepest of some bodies [mm].

    In a closed body the depth is the length of the way out; behind an open surface with a fixed side, the distance.
    Open surfaces whose side comes from the cage have no inside.

    Args:
        surfaces: The posed bodies.
        points: World positions [m], shape (V, 3), float64.
        device: "cpu" or a CUDA device.

    Returns:
        Shape (V,), float32, 0 outside.
    """
    deepest = torch.zeros(len(points), dtype=torch.float64, device=device)
    for surface in surfaces:
        x = torch.as_tensor(points - surface.origin, dtype=torch.float64, device=device)
        if surface.closed:
            depth = depths(surface, x, surface.inside(x), float("inf"))[0]
        else:
            found = surface.closest(x, torch.full_like(deepest, float("inf")))
            depth = torch.where(found.is_behind(surface.fixed_side or 0.0), found.distance, 0.0)
        deepest = torch.maximum(deepest, depth)
    return (1e3 * deepest).to(torch.float32).cpu().numpy()


def body_crossings(level: Level, surfaces: Sequence[Surface], points: np.ndarray) -> np.ndarray:
    """Mask of the corners of cloth edges and faces that cross a body, shape (V,), bool.

    Args:
        surfaces: The posed bodies.
        points: World positions [m], shape (V, 3), float64.
    """
    if not surfaces or not len(level.triangles):
        return np.zeros(len(points), bool)
    cloth, bodies = len(level.spans), len(surfaces)
    meets = np.zeros((cloth + bodies, cloth + bodies), bool)
    meets[:cloth, cloth:] = meets[cloth:, :cloth] = True
    mesh = ClothMesh(level, meets, np.zeros((0, 2), np.int64), solids=tuple(each.solid for each in surfaces))
    x = np.concatenate([points, *(each.world for each in surfaces)]) - points.mean(axis=0)
    pierced = all_crossings(mesh.parts, torch.as_tensor(x, device=level.device))[1]
    return mesh.crossed(pierced.crossings)[: len(points)].cpu().numpy()
