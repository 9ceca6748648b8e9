"""A coat over a shirt, each moved by a motion of its own: their cages cross a thousand times in every frame."""

from __future__ import annotations

import numpy as np

from ...usd.write.plain import Look, PlainStage
from .shapes import ease
from .walker import Cage, form, garment, tube, walk

FRAMES, RATE = 24, 24.0
GAPS = (0.012, 0.013)
"""Mean distances of the shirt and the coat from the body [m]."""
FOLD = 0.007
"""Height of the folds of the cages [m]: those of the shirt stand through the coat."""
LATE = 0.05
"""Time by which the coat's hem lags behind the shirt's [s]."""


def build() -> PlainStage:
    """Two garments and a body."""
    times = np.arange(FRAMES) / RATE
    under, over = _folded((1.27, 0.86, 22), 48, 12, GAPS[0]), _folded((1.28, 0.80, 25), 52, 9, GAPS[1])
    late = LATE * ease((1.1 - over.points[:, 1]) / 0.25)
    walking = np.stack([walk(under.points, time) for time in times])
    lagging = np.stack([walk(over.points, time - late) for time in times])
    shirt = garment("Shirt", under, walking, Look("Cotton", (0.72, 0.70, 0.64)))
    coat = garment("Coat", over, lagging, Look("Wool", (0.20, 0.16, 0.14)))
    doc = "A coat over a shirt, skinned apart: their cages cross in every frame"
    return PlainStage("OvercoatShot", doc, (shirt, coat, form(times)), 1.0 + np.arange(FRAMES))


def _folded(rows: tuple[float, float, int], around: int, folds: int, gap: float) -> Cage:
    """A tube with upright folds.

    Args:
        rows: Height of the first and the last row [m], and number of rows.
        around: Quads around.
        folds: Folds around.
        gap: Mean distance from the body [m].
    """
    cage = tube(np.linspace(*rows), around, lambda height: np.full_like(height, gap))
    angle = np.arctan2(cage.points[:, 2], cage.points[:, 0])
    low = ease((rows[0] - cage.points[:, 1]) / 0.15)
    out = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    cage.points[:] += (FOLD * low * np.cos(folds * angle + 2.0 * cage.points[:, 1] / 0.3))[:, None] * out
    return cage
