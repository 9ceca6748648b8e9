"""A sheet that is pulled through a torus by a grip on its middle, and crushed in the hole."""

from __future__ import annotations

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainStage
from .drape import Drape, DrapeOptions
from .shapes import ease, mesh, off_torus, square, torus

SIDE, CELLS = 0.66, 30
"""Side of the sheet [m] and its quads along a side."""
MAJOR, MINOR, GAP = 0.135, 0.045, 0.005
"""Radii of the torus' circle and tube, and the distance of the coarse sheet from the torus [m]."""
PULL = 0.24
"""How far the grip goes down [m]."""
FRAMES, STEPS = 28, 3


def build() -> PlainStage:
    """One garment over a static torus; the middle of the sheet is pinned."""
    rest, quads, uv = square(SIDE, CELLS, MINOR + GAP)
    grip = np.flatnonzero(np.hypot(rest[:, 0], rest[:, 2]) < 1.5 * SIDE / CELLS)

    def project(points: np.ndarray, _: float) -> np.ndarray:
        return off_torus(points, MAJOR, MINOR + GAP)

    options = DrapeOptions(step=1 / 24 / STEPS, spring=60.0, iterations=10, give=0.65, drag=4.0, contact=1.0)
    cloth, down = Drape(rest, quads, grip, options=options, project=project), PULL * np.array([0.0, 1.0, 0.0])
    sheet = mesh(
        "Sheet",
        quads,
        rest,
        Look("Silk", (0.50, 0.20, 0.34), 0.5),
        samples=cloth.film(FRAMES, STEPS, lambda time: rest[grip] - ease(24.0 * time / (FRAMES - 1)) * down),
        uv=uv,
        pin=np.isin(np.arange(len(rest)), grip).astype(float),
        fabric=PRESETS["silk"],
    )
    ring = torus(MAJOR, MINOR, (64, 24)).collider("Ring", Look("Wood", (0.42, 0.29, 0.16), 0.5))
    return PlainStage("TorusShot", "A sheet pulled through a torus", (sheet, ring), 1.0 + np.arange(FRAMES))
