"""Settings of the solve of each frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..contact.settings import ContactSettings
from ..integrate import LEARNED, METHODS, Method
from ..integrate.stop import Budget, level_budget


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
        frame_limit: Time after which a frame stops in its current state [s], by `deadline.clock_of`: processor time on
            the CPU. None for a multiple of usual frames.
        temporal: "tether", "warm" or "off".
        tether: Tether stiffness over that of inertia in an implicit step of the time between samples, m / dt^2.
        reset: Thresholds for a cold start.
        cancelled: Asked before each step whether the result is no longer needed; or None.
        rough: Whether a new material uses the last material's Cholesky factor as preconditioner.
        show_round: Called after each round of the finest level with the positions of each garment [m] by path; or None.
        ended: Called with the finest level's `LevelProblem` and the final positions [m] after each solve of that level,
            so that the caller can solve it on; or None.
    """

    method: Method = METHODS[LEARNED]
    steps: int = 24
    tolerance: float = 2e-3
    budget_ms: float | None = None
    frame_limit: float | None = None
    temporal: str = "tether"
    tether: float = 3.5
    reset: Reset = field(default_factory=Reset)
    contact: ContactSettings = field(default_factory=ContactSettings)
    cancelled: Callable[[], bool] | None = None
    rough: bool = False
    show_round: Callable[[Mapping[str, np.ndarray]], None] | None = None
    ended: Callable[[Any, Any], None] | None = None

    @property
    def is_reusable(self) -> bool:
        """Whether the solve is neither rough nor cancelled: such a result may be reused for equal input."""
        return not (self.rough or (self.cancelled is not None and self.cancelled()))

    def budget(self, below: int, clock: float, *, warm: bool) -> Budget:
        """The budget of a level, as for `level_budget`."""
        seconds, cancelled = None if self.budget_ms is None else 1e-3 * self.budget_ms, self.cancelled
        budget = level_budget(
            self.steps, self.tolerance, below, warm=warm, clock=clock, seconds=seconds, cancelled=cancelled
        )
        return replace(budget, hurried=self.rough)
