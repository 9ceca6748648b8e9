"""Finds frames not settled or not solved, for warnings, `--strict` and reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

COLLAPSED, LIMITED, UNSOLVED = "collapsed", "time limit", "not solved"
FAR = 50.0
"""Remaining move [tolerances] above which a level is unsolved: by default a visible tenth of a fine edge."""


def unsettled(entry: Mapping[str, Any], tolerance: float) -> dict[str, Any] | None:
    """Why a garment's frame is unsettled, or None if it is settled.

    A frame is unsettled if a level's last descent ended because no step lowered the energy although the level was not
    at rest, or if the finest level's remaining move exceeds `FAR` tolerances. A collapsed cage is not solved at all.

    Args:
        entry: The garment's telemetry in the frame.
        tolerance: Tolerance of the solve, in local edge lengths.

    Returns:
        Plain values, as in the report: ``level`` and its ``remaining_move`` in local edge lengths, RMS of H0^-1 F, None
        if no level was solved; ``stopped``, the reason for the end of the steps, as in `LevelReport`, or `COLLAPSED`,
        `LIMITED` or `UNSOLVED`; ``size`` of a collapsed cage relative to its rest shape; ``error``, the reason for an
        unsolved frame, else "".
    """
    state = {"level": 0, "remaining_move": None, "stopped": "", "size": None, "error": ""}
    moves = {level["level"]: float(level["remaining_move"]) for level in entry.get("levels", ())}
    ends = {level["level"]: str(level["stopped"]) for level in entry.get("levels", ())}
    finest = max(moves, default=0)
    if "not_solved" in entry:
        return state | {"stopped": UNSOLVED, "error": str(entry["not_solved"])}
    if "collapsed" in entry:
        return state | {"stopped": COLLAPSED, "size": float(entry["collapsed"])}
    if "time_limit" in entry:
        return state | {"level": finest, "remaining_move": moves.get(finest), "stopped": LIMITED}
    for level in sorted(moves, reverse=True):
        far = level == finest and not moves[level] <= FAR * max(tolerance, 1e-6)
        if far or (ends[level] == "stalled" and moves[level] > tolerance):
            return state | {"level": level, "remaining_move": moves[level], "stopped": ends[level]}
    return None


def in_words(state: Mapping[str, Any]) -> str:
    """Why a frame is unsettled, by `unsettled`, in words."""
    if state["error"]:
        return str(state["error"])
    if state["size"] is not None:
        return f"the cage has shrunk to {100.0 * state['size']:.2g}% of its rest shape's size"
    reason = "no step lowers the energy" if state["stopped"] == "stalled" else f"stopped by {state['stopped']}"
    if state["remaining_move"] is None:
        return f"no level was solved ({reason})"
    return f"level {state['level']} would still move by {state['remaining_move']:.2g} edges ({reason})"


def unsettled_frames(
    garments: Sequence[Mapping[str, Any]], frames: Sequence[Mapping[str, Any]], *, tolerance: float
) -> list[dict[str, Any]]:
    """All unsettled frames of a report, garment by garment: path, time and the values of `unsettled`."""
    return [
        {"path": garment["path"], "time": frame["time"], **state}
        for index, garment in enumerate(garments)
        for frame in frames
        if "garments" in frame and (state := unsettled(frame["garments"][index], tolerance))
    ]
