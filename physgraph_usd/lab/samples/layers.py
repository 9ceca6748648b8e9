"""Trousers, a shirt over them and a belt over both, on hips and legs that walk in place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...usd.write.plain import Look, PlainMesh, PlainStage
from .shapes import ease
from .walker import WAIST, Cells, form, garment, trousers, tube, walk

FRAMES, RATE = 30, 24.0
GAPS = (0.005, 0.010, 0.0152)
"""Distance of trousers, shirt and belt from the body, where all three overlap [m]."""


def build() -> PlainStage:
    """Three garments in three layers and a body."""
    times = np.arange(FRAMES) / RATE
    doc = "Trousers, shirt and belt in three layers on a body that walks in place"
    meshes = (_trousers(times), _shirt(times), _belt(times), form(times))
    return PlainStage("LayersShot", doc, meshes, 1.0 + np.arange(FRAMES))


def _trousers(times: np.ndarray) -> PlainMesh:
    """Flared trousers; the hems lag behind the legs."""
    cells = Cells(40, 10, np.linspace(1.05, 0.835, 10), np.linspace(0.745, 0.115, 27))
    cage = trousers(cells, lambda height: GAPS[0] + 0.015 * ease((0.62 - height) / 0.35))
    late = 0.006 * ease((0.5 - cage.points[:, 1]) / 0.4)
    samples = np.stack([walk(cage.points, time - late) for time in times])
    return garment("Trousers", cage, samples, Look("Denim", (0.12, 0.17, 0.30)), larger=True)


def _shirt(times: np.ndarray) -> PlainMesh:
    """A shirt without sleeves from the chest to below the hips; its hem swings."""
    cage = tube(np.linspace(1.27, 0.845, 21), 46, lambda height: GAPS[1] + 0.010 * ease((0.98 - height) / 0.12))
    free = ease((0.97 - cage.points[:, 1]) / 0.12)
    samples = []
    for time in times:
        phase = 2 * np.pi * (time - 0.06) / 0.625
        swing = 0.004 * ease(time / 0.35) * np.array([np.sin(0.5 * phase), 0.0, np.sin(phase)])
        samples.append(walk(cage.points, time) + free[:, None] * swing)
    return garment("Shirt", cage, np.stack(samples), Look("Cotton", (0.72, 0.70, 0.64)), larger=True)


def _belt(times: np.ndarray) -> PlainMesh:
    """A leather belt of the worn length, without support."""
    cage = tube(WAIST + np.linspace(0.0225, -0.0225, 4), 44, lambda height: np.full_like(height, GAPS[2]))
    samples = np.stack([walk(cage.points, time) for time in times])
    return replace(garment("Belt", cage, samples, Look("Leather", (0.16, 0.09, 0.05), 0.5)), pin=None)
