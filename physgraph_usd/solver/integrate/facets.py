"""Where a descent from a coarser mesh starts: without its facets.

A linear map from a coarser mesh leaves its triangles flat and its edges sharp. Bending is weak beside stretch at the
size of an edge, so the metric hardly sees such facets and a descent ends before they are gone. A smooth map takes them
out; only across the surface, for in its plane the linear one is right.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from ..mesh.stencil import add_at


def facets(
    level: Level,
    x: Float[Tensor, "vertices 3"],
    coarse: Float[Tensor, "coarse 3"],
    smooth: Callable[[Tensor], Tensor],
) -> Float[Tensor, "vertices 3"]:
    """The move across the surface that takes a coarser mesh's facets out [m]; 0 where a vertex may not move.

    Args:
        level: The level.
        x: Where a linear map put its vertices [m].
        coarse: Vertices of that mesh [m].
        smooth: The smooth map from there.
    """
    normal = _normals(level, x)
    return ((smooth(coarse) - x) * normal).sum(dim=1, keepdim=True) * normal * level.free


def _normals(level: Level, x: Tensor) -> Float[Tensor, "vertices 3"]:
    """Unit normals of the vertices, by the areas round them; 0 where there are none."""
    places = level.triangles.long().T.reshape(-1)
    normal = add_at(torch.zeros_like(x), places, level.normals(x).repeat(3, 1))
    return torch.nn.functional.normalize(normal, dim=1, eps=1e-30)
