"""Start of a frame's solve: from the last frame's detail, or from the upsampled cage, with the reason."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from .from_cage import MovingFrames
from .group import Cage
from .settings import Reset
from .state import State

STILL = 0.02
"""Largest motion of cage and bodies between samples, in mean cage edges, for a held pose: slow settling is visible in a
held pose, so the cloth is slowed down."""
SLOWEST = 2.0**8
"""Factor of the tether stiffness at which cloth rests: motion of cloth whose cage stands is visible."""


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a frame's solve.

    Attributes:
        reason: "warm", or "at rest" or "cold" with the reason.
        detailed: The finest vertices with the last frame's detail [m], shape (V, 3); None in a cold start.
        still_frames: Number of frames with a held pose of everything felt by the cloth.
        slowed: Resulting factor of the tether stiffness; from `SLOWEST` on the cloth rests.
        rotation: Rotation of the detail at each vertex, shape (V, 3, 3); None in a cold start.
    """

    reason: str
    detailed: Float[Tensor, "vertices 3"] | None = None
    still_frames: int = 0
    slowed: float = 1.0
    rotation: Float[Tensor, "vertices 3 3"] | None = None

    @property
    def rests(self) -> bool:
        """Whether the cloth stays in place."""
        return self.slowed >= SLOWEST


def start_of(last: State, cage: Cage, frames: MovingFrames, *, reset: Reset, moved: float = np.inf) -> Start:
    """Carry the last frame's detail along, unless the cage jumped.

    Args:
        last: The cloth after the last frame.
        frames: Frames of the cage, to carry the detail.
        reset: Thresholds for a cold start.
        moved: Largest motion of nearby bodies since [m]; infinite if more than poses changed.
    """
    before, fine = (x.to(cage.points) for x in last.about(cage.origin))
    detailed, rotation, motion, turn, farthest = frames.predict(before, fine, cage.points)
    if motion > reset.move or turn > reset.turn:
        return Start(f"cold: the cage moved {motion:.3g} edges and turned {np.degrees(turn):.3g} degrees")
    still_frames, slowed = slowing(last.still_frames, max(farthest, moved) / frames.edge)
    reason = f"at rest: the pose has been held for {still_frames} frames" if slowed >= SLOWEST else "warm"
    return Start(reason, detailed, still_frames, slowed, rotation)


def slowing(still_frames: int, motion: float) -> tuple[int, float]:
    """Number of frames of a held pose including now, and the resulting factor of the tether stiffness.

    The factor is bounded to keep the cloth faster than slow motion of the cage or of touching bodies.

    Args:
        still_frames: Number of frames before.
        motion: Largest motion of a cage or body point since, in mean cage edges.
    """
    if motion >= STILL:
        return 0, 1.0
    still_frames += 1
    return still_frames, min(SLOWEST, (STILL / max(motion, 1e-9)) ** 2)
