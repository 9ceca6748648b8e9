"""Start of a frame's solve: from the last frame's detail, or from the upsampled cage, with the reason."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from .from_cage import MovingFrames
from .settings import Reset
from .values import Cage, FrameState

STILL = 0.02
"""Largest motion of cage and bodies between samples, in mean cage edges, for a held pose: slow settling is visible in a
held pose, so the cloth is slowed down."""
SLOWEST = 2.0**8
"""Factor of the tether stiffness at which cloth rests: motion of cloth whose cage stands is visible."""


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a frame's solve.

    Attributes:
        why: "warm", or "at rest" or "cold" with the reason.
        detailed: The finest vertices with the last frame's detail [m], shape (V, 3); None in a cold start.
        held: Number of frames with a held pose of everything felt by the cloth.
        slowed: Resulting factor of the tether stiffness; from `SLOWEST` on the cloth rests.
    """

    why: str
    detailed: Float[Tensor, "vertices 3"] | None = None
    held: int = 0
    slowed: float = 1.0

    @property
    def rests(self) -> bool:
        """Whether the cloth stays in place."""
        return self.slowed >= SLOWEST


def start_of(
    state: FrameState | None,
    cage: Cage,
    *,
    frames: MovingFrames,
    finest: Level,
    reset: Reset,
    moved: float = np.inf,
) -> Start:
    """Carry the last frame's detail along, unless the cage jumped.

    Args:
        state: State left by the last frame, or None for a cold start.
        finest: The finest level.
        reset: Thresholds for a cold start.
        moved: Largest motion of nearby bodies since [m]; infinite if more than poses changed.
    """
    if state is None:
        return Start("cold")
    before, fine = (x.to(cage.points) for x in state.about(cage.origin))
    detailed, motion, turn = frames.predict(before, fine, cage.points)
    if motion > reset.move or turn > reset.turn:
        return Start(f"cold: the cage moved {motion:.3g} edges and turned {np.degrees(turn):.3g} degrees")
    detailed = torch.where(finest.free, detailed, finest.base.apply(cage.points))
    moves = (cage.points - before).norm(dim=1)
    farthest = max(float(moves.max()) if len(moves) else 0.0, moved) / frames.edge
    held, slowed = slowing(state.held, farthest)
    why = f"at rest: the pose has been held for {held} frames" if slowed >= SLOWEST else "warm"
    return Start(why, detailed, held, slowed)


def slowing(held: int, motion: float) -> tuple[int, float]:
    """Number of frames of a held pose including now, and the resulting factor of the tether stiffness.

    The factor is bounded to keep the cloth faster than slow motion of the cage or of touching bodies.

    Args:
        held: Number of frames before.
        motion: Largest motion of a cage or body point since, in mean cage edges.
    """
    if motion >= STILL:
        return 0, 1.0
    held += 1
    return held, min(SLOWEST, (STILL / max(motion, 1e-9)) ** 2)
