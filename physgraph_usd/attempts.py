"""From which start a frame's result comes: the last one's detail, the coarse levels round what crosses, or cold.

A frame that starts from the last one's detail flickers least, so it has the first go. Others follow only where its
result shows that they may do much better, and are taken only where they do: what starts anew looks different each time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from .detail import Carried, Solved

TORN = 0.5
"""Strain that 99 in a hundred of a result's edges have at most; a warm frame beyond it is solved again from cold."""
TANGLED = 0.05
"""Part of the input's crossings beyond which a warm frame is solved on from the coarse levels round what crosses."""
BETTER = 0.75
"""Part of a result's crossings that may be left then: for a few less no fold is made anew."""


class Attempt(Protocol):
    """Solves the frame once."""

    def __call__(self, kept: Carried | None, *, anew: bool = False) -> tuple[Solved, float]:
        """Solve from the detail that is kept, or from cold where there is none.

        Args:
            kept: What a frame left, perhaps this one.
            anew: Whether what crosses there starts from the coarse levels.

        Returns:
            The result, and the 99th percentile of the edges' strain that it hands on.
        """
        ...


def best_of(attempt: Attempt, kept: Carried | None, *, counts: bool, again: bool) -> Solved:
    """One frame's result; its times are those of all that was tried.

    Args:
        attempt: Solves the frame once.
        kept: The last frame's result, or None for a cold start.
        counts: Whether crossings of cloth count: not where they are only measured.
        again: Whether there is time to solve on from the coarse levels.

    Raises:
        SolveError: A term of the potential is not finite.
    """
    best, strain = attempt(kept)
    if not _is_warm(best):
        return best
    tried = [best]
    before, after = best.crossings if counts else (0, 0)
    if again and strain <= TORN and before and (after > TANGLED * before or best.between_garments):
        anew, torn = attempt(best.carried, anew=True)
        tried.append(anew)
        if _is_warm(anew) and torn <= TORN and _is_better(anew, best):
            best, after = anew, anew.crossings[1]
    if strain > TORN or after > before:
        why = f"made {after} edges cross, {before} in the input"
        why = f"tore the cloth, straining it by {strain:.3g}" if strain > TORN else why
        cold, _ = attempt(None)
        tried.append(cold)
        cold.telemetry["start"] = f"cold: the last frame's detail {why}"
        best = cold if strain > TORN or cold.crossings[1] < after else best
    _tell_times(best, tried)
    return best


def _is_warm(solved: Solved) -> bool:
    return solved.telemetry["start"].startswith("warm")


def _is_better(anew: Solved, best: Solved) -> bool:
    """Whether so much less crosses: between garments any less is, for the wrong one shows."""
    apart = anew.between_garments - best.between_garments
    fewer = anew.crossings[1] <= BETTER * best.crossings[1]
    return anew.crossings[1] <= best.crossings[1] and (apart < 0 or (not apart and fewer))


def _tell_times(best: Solved, tried: Sequence[Solved]) -> None:
    """Add the times of what was tried and dropped to those of what is taken [ms]."""
    times: dict[str, float] = best.telemetry["milliseconds"]
    best.telemetry["milliseconds"] = {
        name: round(sum(each.telemetry["milliseconds"][name] for each in tried), 3) for name in times
    }
