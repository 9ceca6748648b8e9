"""Which frames the solver left unsettled: what the warning, `--strict` and the report say of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

from .integrate.solve import FAR


@dataclass(frozen=True)
class Unsettled:
    """A frame of a garment that did not settle.

    Attributes:
        level: The level at which it did not.
        remaining_move: RMS of H0^-1 F there, in local edge lengths.
        stopped: Why its steps ended, as `LevelReport` says it.
    """

    level: int
    remaining_move: float
    stopped: str

    def __str__(self) -> str:
        """In words."""
        why = "no step lowers the energy" if self.stopped == "stalled" else f"stopped by {self.stopped}"
        return f"level {self.level} would still move by {self.remaining_move:.2g} edges ({why})"


def unsettled(entry: Mapping[str, Any], tolerance: float) -> Unsettled | None:
    """Whether one garment's frame did not settle.

    It did not where a level's last descent ended because no step lowered the energy while it was not at rest, or where
    the finest level's remaining move is over `FAR` tolerances.

    Args:
        entry: The frame's telemetry of the garment.
        tolerance: Of the solve, in local edge lengths.
    """
    last = {each["level"]: each for each in entry.get("levels", ())}
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


def told_unsettled(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """A warning a garment: the frame that is farthest from rest, and the time codes of all others."""
    said = []
    for path, each in groupby(found, key=lambda entry: str(entry["path"])):
        worst, *others = sorted(each, key=lambda entry: -entry["remaining_move"])
        at, codes = _code(worst["time"]), ", ".join(_code(entry["time"]) for entry in others)
        how = Unsettled(worst["level"], worst["remaining_move"], worst["stopped"])
        said.append(
            f"<{path}> at time code {at}: the frame did not settle: {how}; more --steps may help"
            + (f"; nor did time code {codes}" if codes else "")
        )
    return said


def _code(time: float | None) -> str:
    return "default" if time is None else f"{time:g}"
