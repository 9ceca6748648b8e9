"""A sheet dropped over a block: it lies on the top, bends over sharp edges and folds at the corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainStage
from .drape import Drape, DrapeOptions
from .shapes import box, mesh, off_box, spin, square

SIDE, CELLS = 0.72, 32
"""Side of the sheet [m] and its quads along a side."""
HALF = np.array([0.15, 0.19, 0.12])
"""Half sizes of the block, which stands on y = 0 [m]."""
GAP, ROUND, ABOVE = 0.005, 0.012, 0.03
"""Distance that the coarse sheet keeps from the block, by how much it cuts its corners, and its height at first [m]."""
TURNED = np.radians(17.0)
"""How far the sheet is turned against the block [rad]."""
FRAMES, STEPS = 24, 2


def build() -> PlainStage:
    """One garment over a static block of six faces."""
    level, quads, uv = square(SIDE, CELLS, 2.0 * HALF[1] + ABOVE)
    rest = spin(level, TURNED)
    look = Look("Cotton", (0.62, 0.34, 0.22))
    middle = np.array([0.0, HALF[1], 0.0])

    def project(points: np.ndarray, _: float) -> np.ndarray:
        return off_box(points - middle, HALF - ROUND, ROUND + GAP) + middle

    options = DrapeOptions(spring=100.0, iterations=16, give=0.82, drag=3.0, contact=1.0)
    cloth = Drape(rest, quads, np.zeros(0, int), options=options, project=project)
    samples = cloth.film(FRAMES, STEPS, lambda _: np.zeros((0, 3)))
    sheet = mesh("Sheet", quads, rest, look, samples=samples, uv=uv, fabric=PRESETS["cotton"])
    solid = box(HALF)
    standing = replace(solid, points=solid.points + middle)
    block = standing.collider("Block", Look("Stone", (0.45, 0.45, 0.44)))
    return PlainStage("BlockShot", "A sheet dropped over a block", (sheet, block), np.arange(1.0, FRAMES + 1))
