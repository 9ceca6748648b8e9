"""Where a frame's solve starts: from the last one's detail, or from the upsampled cage, and why."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from ..resolution import edge_strain
from .from_cage import MovingFrames
from .settings import Reset
from .values import Cage, State

WORTH, LEAST_STRAIN, MOST_STRAIN = 2.0, 0.5, 1.0
"""A frame starts cold where the 99th percentile of the edges' strain under carried detail is over so many times the
upsampled cage's and over the second, or over the third: a crumpled cage tears the detail that it carries."""
STILL = 0.02
"""Motion of the farthest point of cage and bodies between samples, in mean cage edges, below which a pose is held:
there slow settling shows, so cloth slows down."""
SLOWER, SLOWEST = 2.0, 2.0**8
"""In a held pose the tether holds cloth so many times as stiffly as in the frame before; where that is so many times as
stiffly as ever, cloth stays where it is: it has a third of a second to settle, and one sees what moves after that.
Cloth that keeps creases takes as long as these need to set (`creases`)."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where a frame's solve starts.

    Attributes:
        why: "warm", or "at rest" or "cold" with the reason.
        detailed: The finest vertices with the last frame's detail [m], shape (V, 3); None in a cold start.
        held: For how many frames the pose of all that the cloth feels has been held.
        slowed: How many times as stiffly as ever the tether holds it therefore; from `SLOWEST` on it rests.
    """

    why: str
    detailed: Float[Tensor, "vertices 3"] | None = None
    held: int = 0
    slowed: float = 1.0

    @property
    def rests(self) -> bool:
        """Whether the cloth stays where it is."""
        return self.slowed >= SLOWEST


def start_of(
    state: State | None,
    cage: Cage,
    *,
    frames: MovingFrames,
    finest: Level,
    reset: Reset,
    moved: float = np.inf,
    pace: float = 1.0,
) -> Start:
    """Carry the last frame's detail along, unless the cage jumped or it would tear the cloth.

    Args:
        state: What the last frame left, or None for a cold start.
        cage: Where the cages are.
        frames: Of the cage.
        finest: The finest level.
        reset: When a frame starts cold.
        moved: How far what the cloth may touch has moved since [m]; infinite where more than poses has changed.
        pace: Part of its usual pace at which cloth in a held pose slows down.
    """
    if state is None:
        return Start("cold")
    shifted = replace(state, coarse=(state.coarse - torch.as_tensor(cage.world).mean(dim=0)).to(cage.points))
    detailed, motion, turn = frames.predict(shifted, cage.points)
    if motion > reset.move or turn > reset.turn:
        return Start(f"cold: the cage moved {motion:.3g} edges and turned {np.degrees(turn):.3g} degrees")
    base = finest.base.apply(cage.points)
    detailed = torch.where(finest.free, detailed, base)
    carried, plain = (edge_strain(finest, x)["p99"] for x in (detailed, base))
    if carried > min(max(WORTH * plain, LEAST_STRAIN), MOST_STRAIN):
        return Start(f"cold: carried detail strains the cloth by {carried:.3g}, the upsampled cage by {plain:.3g}")
    moves = (cage.points - shifted.coarse).norm(dim=1)
    farthest = max(float(moves.max()) if len(moves) else 0.0, moved) / frames.edge
    held, slowed = slowing(state.held, farthest, pace)
    why = f"at rest: the pose has been held for {held} frames" if slowed >= SLOWEST else "warm"
    return Start(why, detailed, held, slowed)


def slowing(held: int, motion: float, pace: float = 1.0) -> tuple[int, float]:
    """For how many frames a pose has now been held, and how many times as stiffly the tether holds cloth in it.

    Never so stiffly that the cloth would be slower than what moves slowly: the cage, or what touches it.

    Args:
        held: For how many frames it had been before.
        motion: How far any point of cage or bodies has moved since, in mean cage edges.
        pace: Part of its usual pace at which cloth slows down.
    """
    if motion >= STILL:
        return 0, 1.0
    held += 1
    return held, min(SLOWER ** min(pace * held, 64), SLOWEST, (STILL / max(motion, 1e-9)) ** 2)
