"""Where a run that begins in the middle of a shot finds its cloth: the cage walks there from an earlier frame.

Cloth that walks from frame to frame crosses nothing new, but a cage that crosses in the middle of a shot cannot always
be drawn apart by itself. An earlier one often can, and the cage alone walks at a small part of what a frame costs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ...errors import SolveError, StageError
from ..scene import Frame, Scene, refuse_far
from .refiner import Refiner
from .settings import SolveSettings


def cages_walked(
    scene: Scene,
    settings: SolveSettings,
    frame_at: Callable[[float | None], Frame],
    *,
    times: Sequence[float],
    device: str = "cpu",
    threads: int = 1,
) -> tuple[Refiner, float] | None:
    """Walk a scene's cages to the first frame of a run, where cloth walks and feels cloth.

    Args:
        scene: The scene.
        settings: How the run is solved.
        frame_at: Reads a time code.
        times: The shot's time codes up to the run's first, in order.
        device: Where the run is solved.
        threads: Most threads that a kernel uses on the CPU.

    Returns:
        As `lead_in`.
    """
    if len(times) < 2 or settings.temporal == "off" or settings.contact.cloth != "pairs":
        return None
    alone = [0] * len(scene.garments)
    return lead_in(Refiner(scene, settings, levels=alone, device=device, threads=threads), frame_at, times)


def lead_in(
    cages: Refiner, frame_at: Callable[[float | None], Frame], times: Sequence[float]
) -> tuple[Refiner, float] | None:
    """Walk the cage to a run's first frame from one where it does not cross, or comes clean by itself.

    That frame is looked for 0, 1, 2, 4, 8, ... frames before; where none comes clean, it is the shot's first.

    Args:
        cages: A refiner of the shot that does not subdivide.
        frame_at: Reads a time code; one that cannot be read or solved is left out.
        times: The shot's time codes up to the run's first, in order.

    Returns:
        The refiner there, and the time code that it walked from; None where the first frame's cage does not
        cross, or is the shot's first.
    """
    last = len(times) - 1
    try:
        needed = last > 0 and _crosses(cages, frame_at(times[last]))
    except StageError:  # It is told of where the frame is solved.
        needed = False
    if not needed:
        return None
    back = 0
    while not _is_clean(cages, frame_at, times[max(last - back, 0)]) and back < last:
        back = max(2 * back, 1)
    begun = max(last - back, 0)
    for time in times[begun + 1 :]:
        _solve(cages, frame_at, time)
    return cages, times[begun]


def _crosses(cages: Refiner, frame: Frame) -> bool:
    """Whether a cage that is to keep its sides crosses itself, or another one, in a frame."""
    refuse_far(cages.scene, frame)
    for part in cages.parts_of(frame):
        contact = cages.group_of(part).potential([frame.garments[index] for index in part])[1]
        if contact is not None and contact.crossed:
            return True
    return False


def _is_clean(cages: Refiner, frame_at: Callable[[float | None], Frame], time: float) -> bool:
    """Whether nothing crosses in the cage that is solved at a time code by itself."""
    cages.forget()
    entries = _solve(cages, frame_at, time)
    return bool(entries) and all(not entry["contact"]["cloth"]["after"]["crossings"] for entry in entries)


def _solve(cages: Refiner, frame_at: Callable[[float | None], Frame], time: float) -> list[dict[str, Any]]:
    """Telemetry of each garment whose cloth may touch cloth; nothing of a frame that cannot be solved."""
    try:
        state: Any = cages.solve(frame_at(time))
    except (SolveError, StageError):
        return []
    return [entry for entry in state.telemetry if "cloth" in entry.get("contact", {})]
