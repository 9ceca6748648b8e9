"""A sheet dropped over a block: it lies on the top, bends over sharp edges and folds at the corners."""

from __future__ import annotations

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainMesh, PlainStage
from .drape import Drape, DrapeOptions
from .grid import grid_uv, quad_grid
from .solids import box, off_box

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
    """Build the shot.

    Returns:
        One garment, 24 samples, over a static block of six faces.
    """
    side = np.linspace(-0.5 * SIDE, 0.5 * SIDE, CELLS + 1)
    z, x = np.meshgrid(-side, side, indexing="ij")
    c, s = np.cos(TURNED), np.sin(TURNED)
    level = np.full(x.size, 2.0 * HALF[1] + ABOVE)
    rest = np.stack([c * x.ravel() + s * z.ravel(), level, c * z.ravel() - s * x.ravel()], axis=1)
    quads = quad_grid(CELLS + 1, CELLS + 1)
    sheet = PlainMesh(
        name="Sheet",
        counts=np.full(len(quads), 4),
        indices=quads.ravel(),
        points=rest,
        look=Look("Cotton", (0.62, 0.34, 0.22)),
        samples=_drop(rest, quads),
        uv=grid_uv(CELLS + 1, CELLS + 1),
        fabric=PRESETS["cotton"],
    )
    solid = box(HALF)
    block = PlainMesh(
        name="Block",
        counts=solid.counts,
        indices=solid.indices,
        points=solid.points + np.array([0.0, HALF[1], 0.0]),
        look=Look("Stone", (0.45, 0.45, 0.44)),
        role="collider",
    )
    return PlainStage("BlockShot", "A sheet dropped over a block", (sheet, block), np.arange(1.0, FRAMES + 1))


def _drop(rest: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Simulate the coarse sheet, shape (T, V, 3)."""
    options = DrapeOptions(spring=100.0, iterations=16, give=0.82, drag=3.0, contact=1.0)
    middle = np.array([0.0, HALF[1], 0.0])

    def project(points: np.ndarray, _: float) -> np.ndarray:
        return off_box(points - middle, HALF - ROUND, ROUND + GAP) + middle

    sheet = Drape(rest, quads, np.zeros(0, int), options=options, project=project)
    frames = []
    for _ in range(FRAMES):
        frames.append(sheet.points)
        for _ in range(STEPS):
            sheet.step(np.zeros((0, 3)))
    return np.stack(frames)
