"""Settings of the solve of each frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from ..contact.settings import ContactSettings
from ..integrate import LEARNED, METHODS, Method
from ..integrate.solve import Budget

COARSE_STEPS, COARSE_TOLERANCE = 4, 0.1
"""Steps and tolerance of a coarse level relative to the finest: coarse steps are cheap and shape the folds."""
EXTRA = 3
"""Extra steps of the finest level of a cold frame far from rest, relative to its regular steps."""
REST = 2.0
"""Remaining move, in tolerances, below which a frame starting from cloth at rest makes no step."""


@dataclass(frozen=True)
class Reset:
    """Thresholds for a cold start.

    Attributes:
        move: RMS motion of the cage between samples, in mean cage edges, above which detail is dropped.
        turn: RMS rotation of the frames [rad] above which detail is dropped.
        gap: Time between samples, in usual spacings, above which detail is dropped.
    """

    move: float = 25.0
    turn: float = math.pi / 3.0
    gap: float = 4.0


@dataclass(frozen=True)
class SolveSettings:
    """Settings of the solve of each frame.

    Attributes:
        method: The integrator, and whether levels are nested.
        steps: Most steps at the finest level; each coarser level may take four times as many.
        tolerance: Stop when the RMS of H0^-1 F is under this many local edge lengths.
        budget_ms: Time limit for solving a frame [ms], or None.
        frame_limit: Time limit after which a frame stops in its current state [s]; None for a multiple of usual frames.
        temporal: "tether", "warm" or "off".
        tether: Tether stiffness [1/s^2].
        reset: Thresholds for a cold start.
        contact: Contact settings.
        cancelled: Asked before each step whether the result is no longer needed; or None.
    """

    method: Method = METHODS[LEARNED]
    steps: int = 12
    tolerance: float = 2e-3
    budget_ms: float | None = None
    frame_limit: float | None = None
    temporal: str = "tether"
    tether: float = 2000.0
    reset: Reset = field(default_factory=Reset)
    contact: ContactSettings = field(default_factory=ContactSettings)
    cancelled: Callable[[], bool] | None = None

    def budget(self, below: int, clock: float, *, warm: bool) -> Budget:
        """Steps and deadline of a level; the finest level makes at least one step.

        Args:
            below: Number of levels finer than this level.
            clock: Time at which the frame was ready to be solved [s].
            warm: Whether the level starts from the last frame's result.
        """
        deadline = None
        if self.budget_ms is not None:
            deadline = clock + 1e-3 * self.budget_ms * (1.0 - 0.7 * (below > 0)) ** min(below, 2)
        if not below:
            rest, extra = (REST, 0) if warm else (1.0, EXTRA * self.steps)
            return Budget(self.steps, self.tolerance, deadline, rest, extra, self.cancelled, least=1)
        steps, tolerance = COARSE_STEPS * self.steps, COARSE_TOLERANCE * self.tolerance
        return Budget(steps, tolerance, deadline, cancelled=self.cancelled)
