"""Finds the start of a run in the middle of a shot: the cage is advanced from an earlier frame.

Cloth advanced from frame to frame gains no new crossings, but a cage crossing itself in the middle of a shot cannot
always be pulled apart. An earlier frame often can, and advancing the cage alone costs a small fraction of a frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ...errors import SolveError, StageError
from ..scene import Frame, Scene, refuse_far
from .refiner import Refiner
from .settings import SolveSettings


def prerolled_cages(
    scene: Scene,
    settings: SolveSettings,
    frame_at: Callable[[float | None], Frame],
    *,
    times: Sequence[float],
    device: str = "cpu",
    threads: int = 1,
) -> tuple[Refiner, float] | None:
    """Advance a scene's cages to the first frame of a run, if frames are continued and self contact is on.

    Args:
        frame_at: Reads a time code.
        times: The shot's time codes up to the run's first, in order.
        threads: Most threads per kernel on the CPU.

    Returns:
        As `lead_in`.
    """
    if len(times) < 2 or settings.temporal == "off" or settings.contact.cloth != "pairs":
        return None
    unrefined = [0] * len(scene.garments)
    return lead_in(Refiner(scene, settings, levels=unrefined, device=device, threads=threads), frame_at, times)


def lead_in(
    cages: Refiner, frame_at: Callable[[float | None], Frame], times: Sequence[float]
) -> tuple[Refiner, float] | None:
    """Advance the cage to a run's first frame from a frame without crossings, or solvable without crossings.

    The start frame is searched 0, 1, 2, 4, 8, ... frames back; if no frame comes clean, the shot's first frame is used.

    Args:
        cages: A refiner of the shot without subdivision.
        frame_at: Reads a time code; unreadable or unsolvable time codes are skipped.
        times: The shot's time codes up to the run's first, in order.

    Returns:
        The refiner at the run's first frame, and the start time code; None if the run's first cage does not cross, or
        is the shot's first.
    """
    last = len(times) - 1
    try:
        needed = last > 0 and _crosses(cages, frame_at(times[last]))
    except StageError:  # Solving the frame will report the error.
        needed = False
    if not needed:
        return None
    back = 0
    while not _is_clean(cages, frame_at, times[max(last - back, 0)]) and back < last:
        back = max(2 * back, 1)
    start = max(last - back, 0)
    for time in times[start + 1 :]:
        _solve(cages, frame_at, time)
    return cages, times[start]


def _crosses(cages: Refiner, frame: Frame) -> bool:
    """Whether a cage with self contact crosses itself or another cage in a frame."""
    refuse_far(cages.scene, frame)
    for part in cages.parts_of(frame):
        contact = cages.group_of(part).potential([frame.garments[index] for index in part])[1]
        if contact is not None and contact.crossed:
            return True
    return False


def _is_clean(cages: Refiner, frame_at: Callable[[float | None], Frame], time: float) -> bool:
    """Whether nothing crosses in the cage solved at a time code without history."""
    cages.forget()
    entries = _solve(cages, frame_at, time)
    sides = [entry["contact"]["cloth"]["after"] for entry in entries]
    return bool(sides) and all(after["crossings"] == after["given_up"] for after in sides)


def _solve(cages: Refiner, frame_at: Callable[[float | None], Frame], time: float) -> list[dict[str, Any]]:
    """Telemetry of each garment with cloth contact; empty for an unsolvable frame."""
    try:
        result = cages.solve(frame_at(time))
    except (SolveError, StageError):
        return []
    entries = [garment.telemetry for garment in result.garments]
    return [entry for entry in entries if "cloth" in entry.get("contact", {})]
