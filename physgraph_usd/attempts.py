"""From which start a frame's result comes: the last one's detail, the coarse levels round what crosses, or cold.

A frame that starts from the last one's detail flickers least, so it has the first go. Others follow only where its
result shows that they may do much better, and are taken only where they do: what starts anew looks different each time.
"""

from __future__ import annotations

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


def best_of(attempt: Attempt, kept: Carried | None, *, counts: bool) -> Solved:
    """One frame's result; its times are those of all that was tried.

    Args:
        attempt: Solves the frame once.
        kept: The last frame's result, or None for a cold start.
        counts: Whether crossings of cloth count: not where they are only measured.

    Raises:
        SolveError: A term of the potential is not finite.
    """
    solved, strain = attempt(kept)
    if not _is_warm(solved):
        return solved
    before, after = solved.crossings if counts else (0, 0)
    if strain <= TORN and before and (after > TANGLED * before or solved.between_garments):
        again, torn = attempt(solved.carried, anew=True)
        if _is_warm(again) and torn <= TORN and _is_better(again, solved):
            solved, strain, after = _instead_of(solved, again), torn, again.crossings[1]
        else:
            _instead_of(again, solved)
    if strain <= TORN and after <= before:
        return solved
    why = f"made {after} edges cross, {before} in the input"
    why = f"tore the cloth, straining it by {strain:.3g}" if strain > TORN else why
    cold, _ = attempt(None)
    cold.telemetry["start"] = f"cold: the last frame's detail {why}"
    if strain > TORN or cold.crossings[1] < after:
        return _instead_of(solved, cold)
    return _instead_of(cold, solved)


def _is_warm(solved: Solved) -> bool:
    return solved.telemetry["start"].startswith("warm")


def _is_better(again: Solved, solved: Solved) -> bool:
    """Whether so much less crosses: between garments any less is, for the wrong one shows."""
    apart = again.between_garments - solved.between_garments
    fewer = again.crossings[1] <= BETTER * solved.crossings[1]
    return again.crossings[1] <= solved.crossings[1] and (apart < 0 or (not apart and fewer))


def _instead_of(dropped: Solved, taken: Solved) -> Solved:
    """What is taken, with the time of what is not added to its own."""
    times, more = (each.telemetry.get("milliseconds", {}) for each in (taken, dropped))
    times |= {name: round(times.get(name, 0.0) + value, 3) for name, value in more.items()}
    return taken
