"""A sheet that is pulled through a torus by a grip on its middle, and crushed in the hole."""

from __future__ import annotations

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainMesh, PlainStage
from .drape import Drape, DrapeOptions
from .grid import ease, grid_uv, quad_grid
from .solids import off_torus, torus

SIDE, CELLS = 0.66, 30
"""Side of the sheet [m] and its quads along a side."""

MAJOR, MINOR = 0.135, 0.045
"""Radius of the torus' circle and of its tube [m]."""

GAP = 0.005
"""Distance that the coarse sheet keeps from the torus [m]."""

PULL = 0.24
"""How far the grip goes down [m]."""

FRAMES, STEPS = 28, 3


def build() -> PlainStage:
    """Build the shot.

    Returns:
        One garment, 28 samples, over a static torus; the middle of the sheet is pinned.
    """
    side = np.linspace(-0.5 * SIDE, 0.5 * SIDE, CELLS + 1)
    z, x = np.meshgrid(-side, side, indexing="ij")
    rest = np.stack([x.ravel(), np.full(x.size, MINOR + GAP), z.ravel()], axis=1)
    quads = quad_grid(CELLS + 1, CELLS + 1)
    grip = np.flatnonzero(np.hypot(rest[:, 0], rest[:, 2]) < 1.5 * SIDE / CELLS)
    sheet = PlainMesh(
        name="Sheet",
        counts=np.full(len(quads), 4),
        indices=quads.ravel(),
        points=rest,
        look=Look("Silk", (0.50, 0.20, 0.34), 0.5),
        samples=_pull(rest, quads, grip),
        uv=grid_uv(CELLS + 1, CELLS + 1),
        pin=np.isin(np.arange(len(rest)), grip).astype(float),
        fabric=PRESETS["silk"],
    )
    solid = torus(MAJOR, MINOR, (64, 24))
    ring = PlainMesh(
        name="Ring",
        counts=solid.counts,
        indices=solid.indices,
        points=solid.points,
        look=Look("Wood", (0.42, 0.29, 0.16), 0.5),
        role="collider",
    )
    return PlainStage("TorusShot", "A sheet pulled through a torus", (sheet, ring), 1.0 + np.arange(FRAMES))


def _pull(rest: np.ndarray, quads: np.ndarray, grip: np.ndarray) -> np.ndarray:
    """Simulate the coarse sheet, shape (T, V, 3)."""
    options = DrapeOptions(step=1 / 24 / STEPS, spring=60.0, iterations=10, give=0.65, drag=4.0, contact=1.0)

    def project(points: np.ndarray, _: float) -> np.ndarray:
        return off_torus(points, MAJOR, MINOR + GAP)

    sheet = Drape(rest, quads, grip, options=options, project=project)
    frames = []
    for frame in range(FRAMES):
        frames.append(sheet.points)
        for step in range(STEPS):
            t = (frame + (step + 1) / STEPS) / (FRAMES - 1)
            sheet.step(rest[grip] - PULL * ease(t) * np.array([0.0, 1.0, 0.0]))
    return np.stack(frames)
