"""Finds frames not settled or not solved, for warnings, `--strict` and reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

COLLAPSED, LIMITED, UNSOLVED = "collapsed", "time limit", "not solved"
FAR = 50.0
"""Remaining move [tolerances] above which a level is unsolved: by default a visible tenth of a fine edge."""


@dataclass(frozen=True)
class Unsettled:
    """A garment's frame that did not settle.

    Attributes:
        remaining_move: RMS of H0^-1 F at the level, in local edge lengths; None if no level was solved.
        stopped: Reason for the end of the steps, as in `LevelReport`, or `COLLAPSED`, `LIMITED` or `UNSOLVED`.
        size: Size of a collapsed cage relative to its rest shape.
        error: Reason for an unsolved frame, else "".
    """

    level: int
    remaining_move: float | None
    stopped: str
    size: float | None = None
    error: str = ""

    def __str__(self) -> str:
        """Description in words."""
        if self.error:
            return self.error
        if self.size is not None:
            return f"the cage has shrunk to {100.0 * self.size:.2g}% of its rest shape's size"
        reason = "no step lowers the energy" if self.stopped == "stalled" else f"stopped by {self.stopped}"
        if self.remaining_move is None:
            return f"no level was solved ({reason})"
        return f"level {self.level} would still move by {self.remaining_move:.2g} edges ({reason})"


def in_words(entry: Mapping[str, Any]) -> str:
    """An entry of `unsettled_frames` in words."""
    return str(Unsettled(**{field.name: entry[field.name] for field in fields(Unsettled)}))


def unsettled(entry: Mapping[str, Any], tolerance: float) -> Unsettled | None:
    """The unsettled state of a garment's frame, or None if settled.

    A frame is unsettled if a level's last descent ended because no step lowered the energy although the level was not
    at rest, or if the finest level's remaining move exceeds `FAR` tolerances. A collapsed cage is not solved at all.

    Args:
        entry: The garment's telemetry in the frame.
        tolerance: Tolerance of the solve, in local edge lengths.
    """
    if "not_solved" in entry:
        return Unsettled(0, None, UNSOLVED, error=str(entry["not_solved"]))
    if "collapsed" in entry:
        return Unsettled(0, None, COLLAPSED, float(entry["collapsed"]))
    last = {level["level"]: level for level in entry.get("levels", ())}
    if "time_limit" in entry:
        level = max(last, default=0)
        return Unsettled(level, float(last[level]["remaining_move"]) if last else None, LIMITED)
    finest = max(last, default=0)
    for level in sorted(last, reverse=True):
        remaining, stopped = float(last[level]["remaining_move"]), str(last[level]["stopped"])
        far = level == finest and not remaining <= FAR * max(tolerance, 1e-6)
        if far or (stopped == "stalled" and remaining > tolerance):
            return Unsettled(level, remaining, stopped)
    return None


def unsettled_frames(
    garments: Sequence[Mapping[str, Any]], frames: Sequence[Mapping[str, Any]], *, tolerance: float
) -> list[dict[str, Any]]:
    """All unsettled frames, garment by garment.

    Args:
        garments: A report's garments, with paths.
        frames: The same report's frames.
        tolerance: Tolerance of the solve, in local edge lengths.

    Returns:
        Plain values: path, time and the fields of `Unsettled`.
    """
    return [
        {"path": garment["path"], "time": frame["time"], **asdict(garment_unsettled)}
        for index, garment in enumerate(garments)
        for frame in frames
        if "garments" in frame and (garment_unsettled := unsettled(frame["garments"][index], tolerance))
    ]
