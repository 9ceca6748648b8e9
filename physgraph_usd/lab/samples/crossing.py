"""Two sheets on two rods, with the lower ends crossed at the start, to be untangled."""

from __future__ import annotations

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainMesh, PlainStage
from .shapes import flipped, grid_uv, mesh, quad_grid

CELL = 0.021
"""Side of a quad at rest [m]."""
APART, THROUGH = 0.028, 0.016
"""Half the distance between the rods, and half the overlap of the lower edges [m]."""
FRAMES = 12


def build() -> PlainStage:
    """Two garments crossing along a line some 5 cm above the lower edges."""
    times = np.arange(FRAMES) / 24.0
    front = _sheet("Front", (26, 25), 1.0, times=times, look=Look("Silk", (0.55, 0.16, 0.14), 0.5))
    back = _sheet("Back", (25, 21), -1.0, times=times, look=Look("Cotton", (0.16, 0.30, 0.45)))
    doc = "Two hanging sheets whose lower ends start crossed"
    return PlainStage("CrossingShot", doc, (front, back), 1.0 + np.arange(FRAMES))


def _sheet(name: str, size: tuple[int, int], side: float, *, times: np.ndarray, look: Look) -> PlainMesh:
    """A sheet of rows and columns of vertices, the top row first, hanging on a single side of z = 0."""
    rows, columns = size
    v, u = np.meshgrid(np.linspace(0.0, 1.0, rows), np.linspace(-0.5, 0.5, columns), indexing="ij")
    u, v = u.ravel(), v.ravel()
    wide, long = CELL * (columns - 1), CELL * (rows - 1)
    rest = np.stack([wide * u, 1.2 - long * v, np.full_like(u, side * APART)], axis=1)
    quads = quad_grid(rows, columns)[:, ::-1]
    return mesh(
        name,
        quads,
        rest,
        look,
        samples=np.stack([_hang(u, v, (wide, long), side=side, time=time) for time in times]),
        uv=flipped(grid_uv(rows, columns)),
        pin=(v == 0.0).astype(float),
        fabric=PRESETS[look.name.lower()],
    )


def _hang(u: np.ndarray, v: np.ndarray, size: tuple[float, float], *, side: float, time: float) -> np.ndarray:
    """A sheet at a time [s]: gathered by a little, its lower end past the other's."""
    past = ((v - 0.45).clip(0.0) / 0.55) ** 2 * (1.0 + 0.25 * side * u)
    fold = 0.006 * (1.0 - 0.5 * v) * np.cos(2 * np.pi * 2.5 * u + 0.5)
    sway = 0.004 * v * v * np.sin(2 * np.pi * 1.2 * time + 2.0 * u)
    z = side * (APART - (APART + THROUGH) * past) + fold + sway
    gathered = 0.93 + 0.02 * v + 0.03 * np.exp(-(((v - 0.6) / 0.2) ** 2)) * np.cos(3.0 * u)
    return np.stack([size[0] * u * gathered + 0.012 * side, 1.2 - 0.94 * size[1] * v, z], axis=1)
