"""Estimates a shot's cost: memory and size of the layer from the cages, and the end of a run from its first frames.

Memory and size are within a factor of 2 (`tests/test_estimate.py`).
"""

from __future__ import annotations

import os
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean

from ..errors import GarmentError
from ..solver.mesh.subdivide import fine_count
from ..solver.scene import Garment

PROCESS = 5.2e8
"""Memory of a process after importing torch, Warp with its kernels, and USD [bytes]."""
PER_VERTEX = 6.5e3
"""Memory per fine vertex, including coarser levels, forces, metric and hierarchies [bytes]."""
LAYER_ONCE, LAYER_FRAME = 60.0, 24.0
"""Data per fine vertex in a layer: faces, UVs and the default once; points and normals per sample [bytes]."""
PER_BOUND, BOUND_FRAME = 1e3, 12.0
"""Memory of a point bound to a garment, and data of the point per sample [bytes]."""
TIMED_FRAMES, LONG_RUN = 3, 60.0
"""Frames before the first forecast, and least remaining time of a forecast [s]."""
RECENT = 1 / 3
"""Part of the frames done, the latest, whose mean duration stands for the frames left."""
REVISED = 1.5
"""Factor by which a forecast of the whole run changes before it is given again."""


@dataclass(frozen=True)
class Estimate:
    """Size of a run.

    Attributes:
        vertices: Fine vertices of all garments.
        memory: Peak memory of all processes [bytes].
        layer: Size of the layer [bytes].
    """

    vertices: int
    memory: float
    layer: float

    def plain(self) -> dict[str, float]:
        """The estimate for a report."""
        return {
            "fine_vertices": self.vertices,
            "memory_mb": round(self.memory / 1e6),
            "layer_mb": round(self.layer / 1e6, 1),
        }


def estimate(
    garments: Sequence[Garment], levels: Sequence[int], *, frames: int = 1, workers: int = 1, bound: int = 0
) -> Estimate:
    """Estimate a run.

    Args:
        levels: Number of subdivisions of each.
        frames: Number of time codes.
        workers: Processes that share the frames.
        bound: Points that follow the garments.
    """
    vertices = sum(fine_count(garment.mesh, level) for garment, level in zip(garments, levels, strict=True))
    processes = min(workers, max(frames, 1))
    memory = (PROCESS + PER_VERTEX * vertices) * processes + (PROCESS if processes > 1 else 0.0)
    layer = vertices * (LAYER_ONCE + LAYER_FRAME * frames) + bound * BOUND_FRAME * (frames + 1)
    return Estimate(vertices, memory + PER_BOUND * bound, layer)


def cannot_fit(
    garments: Sequence[Garment],
    levels: Sequence[int],
    *,
    frames: int = 1,
    workers: int = 1,
    memory: float | None = None,
) -> GarmentError | None:
    """The error naming a run too large for memory and the largest level to fit, or None if the run fits.

    Args:
        levels: Number of subdivisions of each.
        frames: Number of time codes.
        workers: Processes that share the frames.
        memory: Memory of the machine [bytes]; measured if None.
    """
    available = memory_there() if memory is None else memory
    size = estimate(garments, levels, frames=frames, workers=workers)
    if size.memory <= available:
        return None
    largest = max(range(len(garments)), key=lambda index: fine_count(garments[index].mesh, levels[index]))
    fits = (
        level
        for level in range(max(levels) - 1, -1, -1)
        if estimate(garments, [min(level, chosen) for chosen in levels], frames=frames, workers=workers).memory
        <= available
    )
    level = next(fits, None)
    problem = (
        f"level {levels[largest]} makes {size.vertices:,} fine vertices, which need about {size.memory / 1e9:.3g} GB"
    )
    remedy = "reduce the cage" if level is None else f"use --level {level}"
    fewer = " or fewer --workers" if workers > 1 else ""
    return GarmentError(
        garments[largest].path, f"{problem} of memory; this machine has {available / 1e9:.3g} GB", remedy=remedy + fewer
    )


def memory_there() -> float:
    """Memory of this machine [bytes]; infinite if unknown."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):  # Windows has no sysconf.
        return float("inf")


class Forecast:
    """Forecast of a run's end, revised as frames become slower or faster.

    The first frame starts from the cage and takes longer than the others, so it is left out of the means.
    """

    def __init__(self, count: int, workers: int) -> None:
        """Start at the begin of the frames.

        Args:
            count: Frames of the run.
            workers: Processes sharing the frames; the first frames to arrive are the first process's.
        """
        self._count, self._frames = count, -(-count // workers)
        self._ends = [0.0]
        self._given = 0.0

    def after(self, seconds: float) -> str:
        """The forecast after another frame, as text; "" if soon over, or not much changed since the last one.

        Args:
            seconds: Time since the begin of the frames [s].
        """
        self._ends.append(seconds)
        done = len(self._ends) - 1
        frames_left = self._frames - done
        if done < TIMED_FRAMES or frames_left <= 0:
            return ""
        recent = max(round(RECENT * (done - 1)), TIMED_FRAMES - 1)
        remaining = frames_left * mean(
            b - a for a, b in zip(self._ends[-recent - 1 :], self._ends[-recent:], strict=False)
        )
        total = seconds + remaining
        is_new = not 1 / REVISED < total / max(self._given, 1e-9) < REVISED
        if not is_new or (remaining < LONG_RUN and not self._given):
            return ""
        self._given = total
        at = clock.strftime("%H:%M", clock.localtime(clock.time() + remaining))
        minutes = f"{remaining / 60.0:.0f} min" if remaining < 5400.0 else f"{remaining / 3600.0:.1f} h"
        return f"{done} of {self._count} frames in {seconds:.0f} s: all in about {minutes} more, at {at}"
