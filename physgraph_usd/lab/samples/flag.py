"""A flag in a gusty wind: quads, pinned along the pole, no collider."""

from __future__ import annotations

import numpy as np

from ...solver.fabric import Fabric
from ...usd.write.plain import Look, PlainStage
from .shapes import grid_uv, mesh, quad_grid

ROWS, COLUMNS = 28, 42
WIDTH, HEIGHT = 1.5, 1.0
"""Size of the flag [m]."""
FRAMES = 48
SAILCLOTH = Fabric(stretch=60.0, bend=60e-6, density=0.18)
"""A flag's cloth is finished with resin: some ten times stiffer in bending than clothes."""


def build() -> PlainStage:
    """A garment with the first column pinned."""
    down, across = np.meshgrid(np.linspace(0, 1, ROWS), np.linspace(0, 1, COLUMNS), indexing="ij")
    rest = np.stack([WIDTH * across.ravel(), HEIGHT * (down.ravel() - 0.5), 0.0 * across.ravel()], axis=1)
    quads = quad_grid(ROWS, COLUMNS)
    stripe = np.flatnonzero(np.arange(ROWS - 1) // 9 == 1)
    faces = (stripe[:, None] * (COLUMNS - 1) + np.arange(COLUMNS - 1)).ravel()
    u, v = np.linspace(0.0, 1.0, COLUMNS)[None, :], np.linspace(-0.5, 0.5, ROWS)[:, None]
    flag = mesh(
        "Flag",
        quads,
        rest,
        Look("Red", (0.55, 0.07, 0.06)),
        samples=np.stack([_pose(u, v, frame / 24.0) for frame in range(FRAMES)]),
        uv=grid_uv(ROWS, COLUMNS),
        subsets=((Look("White", (0.75, 0.73, 0.68)), faces),),
        pin=(rest[:, 0] == 0.0).astype(float),
        fabric=SAILCLOTH,
    )
    return PlainStage("FlagShot", "A flag in a gusty wind", (flag,), np.arange(1.0, FRAMES + 1))


def _pose(u: np.ndarray, v: np.ndarray, time: float) -> np.ndarray:
    """One sample, shape (V, 3): travelling waves that keep the length of a row but for some compression.

    The direction of each row is integrated from the pole outwards.
    """
    phase = 2 * np.pi * (1.45 * u - 1.0 * time + 0.22 * v)
    gust = 1.0 + 0.25 * np.sin(2 * np.pi * 0.5 * time + 1.0)
    lead = u * (2.0 - u)
    angle = gust * lead * (0.95 * np.sin(phase) + 0.30 * np.sin(2.1 * phase + 4.0 * v + 1.0)) + 0.25
    droop = 0.30 * u * (1.0 + 0.35 * np.sin(phase - 1.0)) + 0.10
    short = 1.0 - 0.16 * np.exp(-(((v - 0.5 + 1.1 * u) / 0.35) ** 2)) - 0.05 * (1.0 + np.sin(phase + 2.0))
    step = WIDTH / (COLUMNS - 1) * short
    along = [step * np.cos(droop) * np.cos(angle), -step * np.sin(droop), step * np.cos(droop) * np.sin(angle)]
    x, y, z = (np.cumsum(part, axis=1) - part[:, :1] for part in np.broadcast_arrays(*along))
    height = HEIGHT * (1.0 - 0.12 * np.exp(-3.0 * u) - 0.06 * u * np.sin(phase) ** 2)
    lean = 0.10 * u * np.sin(phase + 0.8)
    return np.stack([x + 0.05 * v * u, y + v * height, z + lean * v], axis=-1).reshape(-1, 3)
