"""How many subdivisions a garment needs: no more than its wrinkles (DESIGN section 5)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .mesh.topology import edges_of
from .scene import Frame, Garment, GarmentFrame, Scene

AUTO = -1
MOST = 4
SAMPLED_FRAMES = 5
LEAST_STRAIN = 0.01
EDGES_PER_WAVE = 5.0


@dataclass(frozen=True)
class LevelChoice:
    """A garment's number of subdivisions and why."""

    level: int
    reason: str


def choose_levels(scene: Scene, frame_at: Callable[[float | None], Frame]) -> list[LevelChoice]:
    """Take each garment's own level, or for `AUTO` the least that resolves its wrinkles.

    The buckling wavelength is 2 pi sqrt(D / (Y strain)) with the compression of the cage's edges, 90th percentile over
    a few frames; a level resolves it when its mean edge is under a fifth of it.

    Args:
        scene: The scene.
        frame_at: Reads a frame; only asked for a few frames when some level is `AUTO`.

    Returns:
        One choice per garment.
    """
    if all(garment.level != AUTO for garment in scene.garments):
        return [LevelChoice(garment.level, "as authored or asked for") for garment in scene.garments]
    picks = np.linspace(0, len(scene.times) - 1, min(SAMPLED_FRAMES, len(scene.times))).round().astype(int)
    times: list[float | None] = [scene.times[i] for i in picks] or [None]
    frames = [frame_at(time) for time in times]
    return [
        _resolve(garment, [frame.garments[index] for frame in frames])
        if garment.level == AUTO
        else LevelChoice(garment.level, "as authored or asked for")
        for index, garment in enumerate(scene.garments)
    ]


def _resolve(garment: Garment, frames: list[GarmentFrame]) -> LevelChoice:
    ends = edges_of(garment.mesh.triangulate(garment.rest).triangles, garment.mesh.vertex_count).vertices
    if not len(ends):
        return LevelChoice(0, "auto: the garment has no faces")
    rest = np.linalg.norm(garment.rest[ends[:, 1]] - garment.rest[ends[:, 0]], axis=1)
    compression = [
        1.0 - np.linalg.norm(f.points[ends[:, 1]] - f.points[ends[:, 0]], axis=1) / np.maximum(rest, 1e-12)
        for f in frames
    ]
    strain = max(float(np.percentile(np.concatenate(compression), 90)), LEAST_STRAIN)
    fabric = frames[0].fabric
    wave = 2.0 * math.pi * math.sqrt(fabric.bend / (fabric.stretch * strain))
    edge = float(rest.mean())
    needed = math.ceil(math.log2(max(edge * EDGES_PER_WAVE / wave, 1.0)))
    level = min(needed, MOST)
    capped = f", {needed} needed and {MOST} is the most" if needed > MOST else ""
    reason = f"auto: wrinkles of {1e3 * wave:.1f} mm at {strain:.0%} compression, cage edges of {1e3 * edge:.1f} mm"
    return LevelChoice(level, reason + capped)
