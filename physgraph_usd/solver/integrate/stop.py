"""Conditions for the end of a level: the cloth rests, the steps are spent, or the time is over.

`Budget` holds the criteria of a level, or of one round of a level: `descend` asks `reason` before each step, and the
rounds of a frame ask `ends` after each round. The numbers for held poses are in `frame/start.py`, for corrections by
the guard in `integrate/guard.py`, for the tolerance with contact in `contact/metric.py`, and for time limits in
`frame/refiner.py`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from ..deadline import is_over

ROUND, CLEAR_ROUND, FREE_ROUND = 4, 8, 16
"""Most steps of a round with contact, of such a round after one that nothing blocked, and of a round without contact:
near pairs are found again after a round. With 16 for 8, beside 4 for all, two of 14 shots take 0.67 of the time and end
higher, layers by 5% and the overcoat by 10% (three ripples each); 12 are equal. With 8 the overcoat ends 6% higher."""
HURRIED = 2
"""Step limit of the first round of an interactive solve."""
TOUCHING = 2
"""Most steps of the finest level with contact, relative to the budget's: blocked moves cost steps. With 1, 1.5 and 3
warm frames of 09, tshirt, layers and overcoat take as long and cross about as often; with 1 first frames end higher."""
REST = 2.0
"""Remaining move [tolerances] below which a warm frame makes no step."""
LEAST_MISSING = 0.01
"""Part of a round's moves that may be blocked at the end of a warm frame's steps; of six shots, contact blocked 0.0 to
0.8% after a round of 24 steps."""
SEEN_STEPS, SEEN_TURN, SEEN_PART = 4, 0.5, 0.1
"""Number of steps, turn [degrees] and fraction of faces: cloth rests visibly if in so many steps at most this fraction
of its faces turns by more."""
COARSE_STEPS, COARSE_TOLERANCE, COARSE_TIME = 4, 0.1, 0.3
"""Steps and tolerance of a coarse level, relative to the finest: coarse steps are cheap and shape the folds. And the
fraction of its time that a level leaves to the coarser levels."""
UNTANGLINGS, WARM_UNTANGLINGS = 25, 4
"""Most untangling rounds: at the cage, and at a finer level or in a warm frame."""


class Ended(Protocol):
    """A round's steps, reason to stop and remaining move: what `Budget.ends` reads of a report."""

    steps: int
    stopped: str
    remaining_move: float


@dataclass(frozen=True)
class Budget:
    """Stopping criteria of a level or a round.

    Attributes:
        steps: Most steps.
        tolerance: Stop when the RMS of H0^-1 F is under this many local edge lengths; 0 for never.
        deadline: `time.perf_counter` value after which only the first `least` steps may begin, or None.
        rest: Remaining move, in tolerances, below which no step is made from the start: cloth nearly at rest stays.
        cancelled: Called before each step is made; True if the result is no longer needed; or None.
        least: Number of steps exempt from the deadline.
        touching: Most steps with contact, if more.
        stuck: Number of steps after which a level ends if its number of crossings does not fall.
        warm: Whether the level starts from the last frame's result. Its first round then has all steps, since steps
            cost far less than finding the near pairs again, and ends when nothing is seen to move.
        hurried: Whether an interactive solve waits for the first round: contact then adds no steps.
    """

    steps: int
    tolerance: float = 0.0
    deadline: float | None = None
    rest: float = 1.0
    cancelled: Callable[[], bool] | None = None
    least: int = 0
    touching: int = 0
    stuck: int = 0
    warm: bool = False
    hurried: bool = False

    def for_round(self, *, steps: int, touching: bool, in_bodies: bool, blocked: bool, shrunk: float) -> Budget:
        """The budget of a round.

        Args:
            steps: Number of steps in all earlier rounds.
            touching: Whether there is contact.
            in_bodies: Whether cloth is inside or through a body: the way out changes every few steps.
            blocked: Whether the last round's move was blocked.
            shrunk: Factor of the tolerance: a metric with contact underestimates moves.
        """
        first, remaining = not steps, max(self.steps, self.touching) - steps
        longest = ROUND if blocked or first else CLEAR_ROUND
        longest = HURRIED if self.hurried and first else min(longest, remaining) if touching else FREE_ROUND
        longest = self.steps if first and self.warm and not (self.hurried or in_bodies) else longest
        limit, tolerance = min(longest, self.steps), shrunk * self.tolerance
        rest, least = (self.rest, self.least) if first else (1.0, 0)
        return replace(self, steps=limit, tolerance=tolerance, rest=rest, least=least)

    def for_untangling(self) -> Budget:
        """The budget of an untangling round, without a tolerance: contours shorten in small moves."""
        return replace(self, steps=min(ROUND, self.steps), tolerance=0.0, least=0)

    def reason(self, steps: int, remaining: Callable[[], float], *, next_is_made: bool = False) -> str:
        """Reason to stop: "tolerance", "steps" or "budget"; "" to continue.

        Args:
            steps: Number of steps made.
            remaining: Gives the remaining move, in local edge lengths.
            next_is_made: Whether the next step is made already, so that the time does not matter.
        """
        if self.tolerance > 0 and remaining() < self.tolerance * (1.0 if steps else self.rest):
            return "tolerance"
        if steps >= self.steps:
            return "steps"
        return "budget" if not next_is_made and self.is_spent(steps) else ""

    def ends(
        self, report: Ended, *, steps: int, touched: bool, emerging: bool, missing: float, stuck: bool = False
    ) -> bool:
        """Whether no further round of the level follows.

        Args:
            report: Report of the last round.
            steps: Number of steps in all rounds.
            touched: Whether any round had contact.
            emerging: Whether less cloth is inside or through a body than before the last round.
            missing: Part of the last round's moves that was blocked.
            stuck: Whether crossings are left, and the last rounds did not reduce them.
        """
        if stuck and steps >= self.stuck:
            return True
        if report.stopped == "budget" or not report.steps or (report.stopped == "tolerance" and not missing):
            return True
        if (
            self.warm
            and not emerging
            and missing <= LEAST_MISSING
            and (report.stopped == "seen" or steps >= self.steps)
        ):
            return True
        return steps >= (max(self.steps, self.touching) if touched and not self.hurried else self.steps)

    def is_spent(self, steps: int) -> bool:
        """Whether no further step may begin after ``steps`` steps, whatever the cloth's state."""
        late = self.deadline is not None and steps >= self.least and time.perf_counter() >= self.deadline
        return late or is_over() or (self.cancelled is not None and self.cancelled())


def level_budget(
    steps: int,
    tolerance: float,
    below: int,
    *,
    warm: bool,
    clock: float = 0.0,
    seconds: float | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Budget:
    """The budget of a level; the finest level makes at least one step.

    Args:
        steps: Most steps at the finest level.
        tolerance: Tolerance of the finest level, in local edge lengths.
        below: Number of levels finer than this level.
        warm: Whether the level starts from the last frame's result.
        clock: Time at which the frame was ready to be solved [s].
        seconds: Time limit for solving the frame from then on [s], or None.
        cancelled: As for `Budget`.
    """
    deadline = None if seconds is None else clock + seconds * COARSE_TIME ** min(below, 2)
    if below:
        coarse = COARSE_STEPS * steps, COARSE_TOLERANCE * tolerance, deadline
        return Budget(*coarse, cancelled=cancelled, stuck=steps)
    finest = Budget(steps, tolerance, deadline, cancelled=cancelled, least=1, touching=TOUCHING * steps, stuck=steps)
    return replace(finest, rest=REST, warm=True) if warm else finest
