"""Which frames the solver left unsettled: what the warning, `--strict` and the report say of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

FAR = 50.0
"""Remaining moves, in tolerances, above which a frame did not settle: at the default tolerance a tenth of a fine edge,
which shows."""


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
