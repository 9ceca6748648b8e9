"""Where a frame's solve starts: from the last one's detail, or from the upsampled cage, and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .detail import Carried, MovingFrames, Reset
from .level import Level
from .resolution import edge_strain

WORTH, LEAST_STRAIN, MOST_STRAIN = 2.0, 0.5, 1.0
"""A frame starts cold where the 99th percentile of the edges' strain under carried detail is over so many times the
upsampled cage's and over the second, or over the third: a crumpled cage tears the detail that it carries."""
STILL = 0.02
"""RMS motion of the cage between samples, in mean cage edges, below which a pose is held: there slow settling shows."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where a frame's solve starts.

    Attributes:
        why: "warm", or "cold" with the reason.
        detailed: The finest vertices with the last frame's detail [m], shape (V, 3); None in a cold start.
        still: Whether the pose is held.
    """

    why: str
    detailed: Float[Tensor, "vertices 3"] | None = None
    still: bool = False


def start_of(
    kept: Carried | None,
    coarse: Float[Tensor, "coarse 3"],
    world: Float[Tensor, "coarse 3"],
    *,
    frames: MovingFrames,
    finest: Level,
    reset: Reset,
) -> Start:
    """Carry the last frame's detail along, unless the cage jumped or it would tear the cloth.

    Args:
        kept: The last frame's result, or None for a cold start.
        coarse: Cage positions [m], recentred.
        world: The same in world space.
        frames: Of the cage.
        finest: The finest level.
        reset: When a frame starts cold.
    """
    if kept is None:
        return Start("cold")
    shifted = Carried((kept.coarse - world.mean(dim=0)).to(coarse), kept.detail, kept.frames)
    detailed, motion, turn = frames.predict(shifted, coarse)
    if motion > reset.move or turn > reset.turn:
        return Start(f"cold: the cage moved {motion:.3g} edges and turned {np.degrees(turn):.3g} degrees")
    base = finest.base.apply(coarse)
    detailed = torch.where(finest.free, detailed, base)
    carried, plain = (edge_strain(finest, x)["p99"] for x in (detailed, base))
    if carried > min(max(WORTH * plain, LEAST_STRAIN), MOST_STRAIN):
        return Start(f"cold: carried detail strains the cloth by {carried:.3g}, the upsampled cage by {plain:.3g}")
    return Start("warm", detailed, motion < STILL)
