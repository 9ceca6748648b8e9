"""A step cut back where it turns triangles over: a few collapsed ones must not hold up a whole garment.

The angle between two triangles changes with a move over the height of either. Where an animation squeezes a triangle to
a thousandth of its area, a move of a thousandth of an edge turns it over, which costs energy, and a handful of such
triangles would shorten every step of a whole garment to nothing. So a step that fails is cut back at their corners
first, and nowhere else. That depends on no particular force and works for every integrator.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from .base import System

TURN = math.cos(math.radians(45.0))
"""Cosine of the angle by which a triangle may turn in a step that failed: the angle between two neighbours then
changes by a quarter turn at most, so that none is turned over."""
CUTS = 8
"""Most times that a vertex's move is halved; what is left of it then is under half a percent."""


def truncated(
    system: System, x: Float[Tensor, "vertices 3"], move: Float[Tensor, "vertices 3"]
) -> Float[Tensor, "vertices 3"] | None:
    """A move [m] cut back at the corners of triangles that it would turn by more than `TURN`; None without any.

    The corners of such triangles are halved until none is left. What is cut turns others, so all are examined again.

    Args:
        system: The level.
        x: Where the move starts [m].
        move: Displacement [m].
    """
    level = system.level
    if level is None or not len(level.triangles):
        return None
    before, corners = level.normals(x), level.triangles.long()
    part = torch.ones_like(x[:, :1])
    for _ in range(CUTS):
        after = level.normals(x + part * move)
        turned = (before * after).sum(dim=1) < TURN * before.norm(dim=1) * after.norm(dim=1)
        if not bool(turned.any()):
            break
        part[torch.unique(corners[turned])] *= 0.5
    return part * move if bool((part < 1.0).any()) else None
