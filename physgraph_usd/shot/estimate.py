"""A shot's cost, from its cages alone: fine vertices, memory, the layer's size and time.

``python -m benchmarks.estimate`` measures the constants. Memory and size are within a factor of 2; times, which how
crowded a cage is decides, within 2.8 for a few frames of real shots, and 4 for single ones where cloth jumps.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from ..errors import GarmentError
from ..solver.contact.crowding import Crowding
from ..solver.mesh.subdivide import fine_count
from ..solver.scene import Garment

PROCESS = 5.2e8
"""Memory of a process that has done nothing yet but import [bytes]: torch, Warp and its kernels, USD."""
PER_VERTEX = 6.5e3
"""Memory for each fine vertex, coarser levels, forces, metric and hierarchies included [bytes]."""
LAYER_ONCE, LAYER_FRAME = 60.0, 24.0
"""Data of each fine vertex in a layer: faces, UVs and the default once; points and normals per sample [bytes]."""
COLD, WARM = (6e-5, 6e-5, 4e-4, 0.0, 5e-4, 1e-3), (1.2e-5, 1e-5, 1.5e-4, 1.2e-4, 2e-4, 7e-4)
"""Time of one core for each fine vertex [s], in the first frame and in each warm one: of free cloth, and what is added
where it touches a body, with the root of `Crowding.crossings`, with `crossings`, with `near`, and with the root of
`inside`."""


@dataclass(frozen=True)
class Estimate:
    """Cost of refining.

    Attributes:
        vertices: Fine vertices of all garments.
        memory: Peak memory of all processes [bytes].
        layer: Size of the layer [bytes].
        first: Time of one core for the first frame [s]; None where it is not known how crowded the cages are.
        seconds: Time of one core for each further frame, on average [s]; None as well.
        frames: Number of time codes.
    """

    vertices: int
    memory: float
    layer: float
    first: float | None
    seconds: float | None
    frames: int

    def plain(self) -> dict[str, float]:
        """The estimate for a report."""
        sizes = {
            "fine_vertices": self.vertices,
            "memory_mb": round(self.memory / 1e6),
            "layer_mb": round(self.layer / 1e6, 1),
        }
        if self.first is None or self.seconds is None:
            return sizes
        times = {"first_frame_seconds": self.first, "seconds_a_frame": self.seconds}
        times |= {"core_seconds": self.first + self.seconds * (self.frames - 1)}
        return sizes | {name: float(f"{value:.2g}") for name, value in times.items()}


def estimate(
    garments: Sequence[Garment],
    levels: Sequence[int],
    *,
    frames: int = 1,
    workers: int = 1,
    crowding: Sequence[Crowding] = (),
) -> Estimate:
    """Estimate a run.

    Args:
        garments: The garments.
        levels: Number of subdivisions of each.
        frames: Number of time codes.
        workers: Processes that share the frames.
        crowding: How crowded the cages are in the first frame, and in others spread over the shot; empty where nobody
            looked, and no time is estimated.
    """
    counts = [fine_count(garment.mesh, level) for garment, level in zip(garments, levels, strict=True)]
    vertices, processes = sum(counts), min(workers, max(frames, 1))
    first = vertices * _rate(COLD, crowding[0]) if crowding else None
    seconds = vertices * sum(_rate(WARM, each) for each in crowding) / len(crowding) if crowding else None
    memory = (PROCESS + PER_VERTEX * vertices) * processes + (PROCESS if processes > 1 else 0.0)
    return Estimate(vertices, memory, vertices * (LAYER_ONCE + LAYER_FRAME * frames), first, seconds, frames)


def _rate(by: Sequence[float], crowding: Crowding) -> float:
    """Time of one core for each fine vertex [s], by `COLD` or `WARM`."""
    root = crowding.crossings**0.5
    parts = (1.0, float(crowding.touches), root, crowding.crossings, crowding.near, crowding.inside**0.5)
    return sum(rate * part for rate, part in zip(by, parts, strict=True))


def cannot_fit(
    garments: Sequence[Garment],
    levels: Sequence[int],
    *,
    frames: int = 1,
    workers: int = 1,
    memory: float | None = None,
) -> GarmentError | None:
    """The error that names what this machine's memory cannot hold, and the level that it can; or None.

    Args:
        garments: The garments.
        levels: Number of subdivisions of each.
        frames: Number of time codes.
        workers: Processes that share the frames.
        memory: What the machine has [bytes]; asked of it when None.
    """
    there = memory_there() if memory is None else memory
    whole = estimate(garments, levels, frames=frames, workers=workers)
    if whole.memory <= there:
        return None
    largest = max(range(len(garments)), key=lambda index: fine_count(garments[index].mesh, levels[index]))
    fits = (
        level
        for level in range(max(levels) - 1, -1, -1)
        if estimate(garments, [min(level, each) for each in levels], frames=frames, workers=workers).memory <= there
    )
    level = next(fits, None)
    problem = (
        f"level {levels[largest]} makes {whole.vertices:,} fine vertices, which need about {whole.memory / 1e9:.3g} GB"
    )
    remedy = "reduce the cage" if level is None else f"use --level {level}"
    fewer = " or fewer --workers" if workers > 1 else ""
    return GarmentError(
        garments[largest].path, f"{problem} of memory; this machine has {there / 1e9:.3g} GB", remedy=remedy + fewer
    )


def memory_there() -> float:
    """Memory of this machine [bytes]; infinite where it does not say."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):  # Windows has no sysconf.
        return float("inf")
