"""Recovery of frames with a result worse than expected from a start at the cage: such frames are restarted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ...errors import SolveError
from ..deadline import is_over
from .group import Group
from .solve import solve_frame
from .values import FrameInput, Solved, State

ROUNDING = 1e-3
"""Fraction of the energies' size below which two energies count as equal: sums are in single precision."""
MOST_WAIT = 64
"""Most frames between two starts from the cage. The wait doubles with each unsuccessful start, so such starts cost
little in a shot with cloth impossible to pull apart."""


class RunawayError(SolveError):
    """Cloth ending with more energy than its upsampled cage, from any start."""


def solve_soundly(group: Group, frame: FrameInput, last: State | None) -> Solved:
    """Solve a frame, and once more from the cage if the result is unsound.

    A result is unsound if cloth crosses cloth, or a body that the upsampled cage does not cross, or if its energy is
    above the upsampled cage's energy without self contact (the self contact energy is as large as the cage's own
    crossings are deep). The second result is used if it has fewer crossings of cloth with cloth. If it has as many: if
    the first alone crosses such a body; or if neither does, the first energy is above the cage's, and the second is
    lower. Bodies that the cage crosses are left out, since a start from the cage crosses them too.

    Args:
        group: Garments solved together.
        frame: The frame.
        last: State left by the last frame, or None for a cold start.

    Raises:
        SolveError: As `solve_frame`.
        RunawayError: Both results have more energy than the upsampled cage, self contact included.
    """
    solved = solve_frame(group, frame, last)
    why = _unsound(solved.telemetry)
    settings = group.settings
    ended_early = is_over() or settings.budget_ms is not None or settings.steps == 0 or not settings.whole
    if not why or (last is None and frame.walked is None) or ended_early:
        return solved
    if last is not None and last.wait:
        return _waiting(solved, last.failures, last.wait - 1)
    given_up = None if last is None else last.given_up
    fresh = solve_frame(group, replace(frame, moved=np.inf, walked=None, elapsed=(), given_up=given_up), None)
    if _is_better(fresh.telemetry, solved.telemetry):
        return replace(fresh, telemetry=fresh.telemetry | {"start": f"cold: started anew, since {why}"})
    if all(_excess(each.telemetry, whole=True) > 0.0 for each in (solved, fresh)):
        raise RunawayError(f"{why}, and a start from the cage ends no better")
    failures = 1 if last is None else last.failures + 1
    return _waiting(solved, failures, min(2**failures - 1, MOST_WAIT))


def _waiting(solved: Solved, failures: int, wait: int) -> Solved:
    """The result, with the number of unsuccessful starts from the cage, and of frames until the next such start."""
    return replace(solved, state=replace(solved.state, failures=failures, wait=wait))


def _unsound(telemetry: Mapping[str, Any]) -> str:
    """Why a result is unsound; "" if sound."""
    if crossings := _crossings(telemetry) + _through_bodies(telemetry):
        return f"it kept {crossings:,} crossings"
    excess = _excess(telemetry)
    return f"it ended with {excess:.3g} J more than its upsampled cage has" if excess > 0.0 else ""


def _is_better(fresh: Mapping[str, Any], solved: Mapping[str, Any]) -> bool:
    """Whether a second result replaces an unsound first one."""
    crossings = _crossings(fresh, given_up=True), _crossings(solved, given_up=True)
    if crossings[0] != crossings[1]:
        return crossings[0] < crossings[1]
    bodies = _through_bodies(fresh), _through_bodies(solved)
    if any(bodies):
        return not bodies[0]
    return _excess(solved) > 0.0 and _energy(fresh) < _energy(solved)


def _crossings(telemetry: Mapping[str, Any], *, given_up: bool = False) -> int:
    """Crossings of cloth with cloth in a result, with or without those of given-up cloth."""
    after = telemetry.get("contact", {}).get("cloth", {}).get("after", {})
    return int(after.get("crossings", 0) - (0 if given_up else after.get("given_up", 0)))


def _through_bodies(telemetry: Mapping[str, Any]) -> int:
    """Crossings of a result with bodies that the upsampled cage does not cross."""
    bodies = telemetry.get("contact", {}).get("bodies", {}).values()
    return sum(each["after"]["crossings"] for each in bodies if not each["before"]["crossings"])


def _excess(telemetry: Mapping[str, Any], *, whole: bool = False) -> float:
    """Energy of the result above its upsampled cage's, with or without self contact [J]; 0 if below or equal."""
    sides = telemetry["energy_joules"]
    before = {name: value for name, value in sides["input"].items() if whole or name != "self_contact"}
    size = sum(abs(each) for each in (*before.values(), *sides["output"].values()))
    return max(_energy(telemetry) - sum(before.values()) - ROUNDING * size, 0.0)


def _energy(telemetry: Mapping[str, Any]) -> float:
    """Energy of the result [J]."""
    return sum(telemetry["energy_joules"]["output"].values())
