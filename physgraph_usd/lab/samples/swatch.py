"""A small hanging swatch whose top edge is gathered; variants in centimetres, with Z up and left-handed."""

from __future__ import annotations

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainMesh, PlainStage
from .grid import ease, grid_uv, quad_grid

ROWS, COLUMNS = 20, 16
"""Vertices down and across."""

WIDTH, LENGTH = 0.24, 0.30
"""Size of the swatch [m]."""

FRAMES = 24

TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns Y up into Z up."""


def build(variant: str = "") -> PlainStage:
    """Build the shot.

    Args:
        variant: Empty, ``cm``, ``zup`` or ``lefthanded``; all show the same cloth in the same place.

    Returns:
        One garment, 24 samples: its top edge is gathered by a quarter while it turns a little.
    """
    scale = 100.0 if variant == "cm" else 1.0
    axes = TO_Z_UP if variant == "zup" else np.eye(3)
    quads, uv = quad_grid(ROWS, COLUMNS), grid_uv(ROWS, COLUMNS)
    if variant == "lefthanded":
        quads = quads[:, ::-1]
        uv = type(uv)(uv.values, uv.indices.reshape(-1, 4)[:, ::-1].ravel())
    poses = np.stack([_pose(float(ease(i / (FRAMES - 1)))) for i in range(FRAMES)])
    mesh = PlainMesh(
        name="Swatch",
        counts=np.full(len(quads), 4),
        indices=quads.ravel(),
        points=scale * _pose(0.0) @ axes.T,
        look=Look("Silk", (0.50, 0.34, 0.10), 0.5),
        samples=scale * poses @ axes.T,
        uv=uv,
        pin=(np.arange(ROWS * COLUMNS) >= (ROWS - 1) * COLUMNS).astype(float),
        fabric=PRESETS["silk"],
        left_handed=variant == "lefthanded",
    )
    return PlainStage(
        "SwatchShot",
        "A hanging swatch whose top edge is gathered",
        (mesh,),
        np.arange(1.0, FRAMES + 1),
        metres_per_unit=1.0 / scale,
        up_axis="Z" if variant == "zup" else "Y",
    )


def _pose(amount: float) -> np.ndarray:
    """The swatch gathered by an amount between 0 and 1 [m], Y up."""
    v, u = np.meshgrid(np.linspace(0, 1, ROWS), np.linspace(-0.5, 0.5, COLUMNS), indexing="ij")
    u, v = u.ravel(), v.ravel()
    gather = 1.0 - amount * (0.25 * v**1.5 + 0.06)
    x = WIDTH * u * gather
    fold = 0.012 * amount * (1.0 - 0.7 * v) * np.cos(2 * np.pi * 1.5 * u + 0.4)
    bow = 0.10 * amount * (u * u - 0.08) * WIDTH * 4.0
    turn = np.radians(25.0) * amount * (1.0 - v)
    z = fold + bow
    y = LENGTH * v * (1.0 - 0.03 * amount) + 0.2 + 0.02 * amount * u * (1.0 - v)
    return np.stack([np.cos(turn) * x + np.sin(turn) * z, y, np.cos(turn) * z - np.sin(turn) * x], axis=1)
