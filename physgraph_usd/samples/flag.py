"""A flag in a gusty wind: quads, pinned along the pole, no collider."""

from __future__ import annotations

import numpy as np

from ..fabric import PRESETS
from ..usd.plain import Look, PlainMesh, PlainStage
from .drape import Drape, DrapeOptions
from .grid import grid_uv, quad_grid

ROWS, COLUMNS = 28, 42
WIDTH, HEIGHT = 1.5, 1.0
"""Size of the flag [m]."""

FRAMES, WARM_UP, STEPS = 48, 30, 2


def build() -> PlainStage:
    """Build the shot.

    Returns:
        One garment, 48 samples; its first column is pinned.
    """
    v, u = np.meshgrid(np.linspace(0, 1, ROWS), np.linspace(0, 1, COLUMNS), indexing="ij")
    rest = np.stack([WIDTH * u.ravel(), HEIGHT * (v.ravel() - 0.5), 0.0 * u.ravel()], axis=1)
    quads = quad_grid(ROWS, COLUMNS)
    stripe = np.flatnonzero(np.arange(ROWS - 1) // 9 == 1)
    faces = (stripe[:, None] * (COLUMNS - 1) + np.arange(COLUMNS - 1)).ravel()
    mesh = PlainMesh(
        name="Flag",
        counts=np.full(len(quads), 4),
        indices=quads.ravel(),
        points=rest,
        look=Look("Red", (0.55, 0.07, 0.06)),
        samples=_wave(rest, quads),
        uv=grid_uv(ROWS, COLUMNS),
        subsets=((Look("White", (0.75, 0.73, 0.68)), faces),),
        pin=(u.ravel() == 0.0).astype(float),
        fabric=PRESETS["polyester"],
    )
    return PlainStage("FlagShot", "A flag in a gusty wind", (mesh,), np.arange(1.0, FRAMES + 1))


def _wave(rest: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Simulate the coarse flag, shape (T, V, 3)."""
    pinned = np.flatnonzero(rest[:, 0] == 0.0)
    options = DrapeOptions(spring=40.0, iterations=5, give=0.8, bend=0.9, drag=1.5, density=0.165)
    start = rest + 0.05 * np.sin(4.0 * rest[:, :1]) * [0.0, 0.0, 1.0]
    flag = Drape(rest, quads, pinned, options=options, start=start)
    hold = rest[pinned].copy()
    hold[:, 1] *= 0.88  # the two grommets were tied closer than the hoist is long
    frames = []
    for _ in range(WARM_UP + FRAMES):
        for _ in range(STEPS):
            flag.step(hold, force=_wind(flag))
        frames.append(flag.points)
    return np.stack(frames[WARM_UP:])


def _wind(flag: Drape) -> np.ndarray:
    """Pressure of the wind on each vertex [m/s^2], for a wind that swings about +X and travels along the flag."""
    x, y = flag.points[:, 0], flag.points[:, 1]
    phase = 2 * np.pi * (1.1 * flag.time - 0.55 * x)
    swing = 0.55 * np.sin(phase + 1.2 * y) + 0.25 * np.sin(1.7 * phase - 2.0 * y + 1.0)
    wind = 9.0 * np.stack([np.cos(swing), 0.12 + 0.0 * swing, np.sin(swing)], axis=1)
    normal = flag.normals()
    relative = wind - flag.velocity
    pressure = np.einsum("vk,vk->v", relative, normal)
    return 5.0 * pressure[:, None] * normal + 0.5 * relative
