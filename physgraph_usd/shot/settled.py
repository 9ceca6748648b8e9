"""Frames that did not settle or were not solved: for warnings, `--strict` and reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from ..solver.integrate.solve import FAR

COLLAPSED, LIMITED, UNSOLVED = "collapsed", "time limit", "not solved"


@dataclass(frozen=True)
class Unsettled:
    """A frame of a garment that did not settle.

    Attributes:
        level: The level at which it did not.
        remaining_move: RMS of H0^-1 F there, in local edge lengths; None where there was nothing to solve.
        stopped: Why its steps ended, as `LevelReport` says it, `COLLAPSED`, `LIMITED` or `UNSOLVED`.
        size: Of the cage over its rest shape's, where it has collapsed.
        error: Why it was not solved, "" where it was.
    """

    level: int
    remaining_move: float | None
    stopped: str
    size: float | None = None
    error: str = ""

    def __str__(self) -> str:
        """In words."""
        if self.error:
            return self.error
        if self.size is not None:
            return f"the cage has shrunk to {100.0 * self.size:.2g}% of its rest shape's size"
        why = "no step lowers the energy" if self.stopped == "stalled" else f"stopped by {self.stopped}"
        return f"level {self.level} would still move by {self.remaining_move:.2g} edges ({why})"


def in_words(entry: Mapping[str, Any]) -> str:
    """An entry of `unsettled_frames` in words."""
    return str(Unsettled(**{each.name: entry[each.name] for each in fields(Unsettled)}))


def unsettled(entry: Mapping[str, Any], tolerance: float) -> Unsettled | None:
    """Whether one garment's frame did not settle.

    It did not where a level's last descent ended because no step lowered the energy while it was not at rest, or where
    the finest level's remaining move is over `FAR` tolerances. A cage that has collapsed was not solved at all.

    Args:
        entry: The frame's telemetry of the garment.
        tolerance: Of the solve, in local edge lengths.
    """
    if "not_solved" in entry:
        return Unsettled(0, None, UNSOLVED, error=str(entry["not_solved"]))
    if "collapsed" in entry:
        return Unsettled(0, None, COLLAPSED, float(entry["collapsed"]))
    last = {each["level"]: each for each in entry.get("levels", ())}
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
    """Every frame of every garment that did not settle, garment by garment.

    Args:
        garments: Of a report: with their paths.
        frames: Of the same report.
        tolerance: Of the solve, in local edge lengths.

    Returns:
        Plain values: path, time and the fields of `Unsettled`.
    """
    return [
        {"path": garment["path"], "time": frame["time"], **asdict(found)}
        for index, garment in enumerate(garments)
        for frame in frames
        if "garments" in frame and (found := unsettled(frame["garments"][index], tolerance))
    ]
