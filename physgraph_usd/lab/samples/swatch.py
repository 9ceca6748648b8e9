"""A small hanging swatch whose top edge is gathered; variants in centimetres, with Z up and left-handed."""

from __future__ import annotations

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainStage
from .shapes import ease, flipped, grid_uv, mesh, quad_grid, spin

ROWS, COLUMNS, FRAMES = 20, 16, 24
"""Vertices down and across, and samples."""
WIDTH, LENGTH = 0.24, 0.30
"""Size of the swatch [m]."""
TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns Y up into Z up."""


def build(variant: str = "") -> PlainStage:
    """A slightly turning garment with the top edge gathered by a quarter.

    Args:
        variant: Empty, ``cm``, ``zup`` or ``lefthanded``; all show the same cloth in the same place.
    """
    scale = 100.0 if variant == "cm" else 1.0
    axes = TO_Z_UP if variant == "zup" else np.eye(3)
    quads, uv = quad_grid(ROWS, COLUMNS), grid_uv(ROWS, COLUMNS)
    if variant == "lefthanded":
        quads, uv = quads[:, ::-1], flipped(uv)
    poses = np.stack([_pose(float(ease(i / (FRAMES - 1)))) for i in range(FRAMES)])
    swatch = mesh(
        "Swatch",
        quads,
        scale * _pose(0.0) @ axes.T,
        Look("Silk", (0.50, 0.34, 0.10), 0.5),
        samples=scale * poses @ axes.T,
        uv=uv,
        pin=(np.arange(ROWS * COLUMNS) >= (ROWS - 1) * COLUMNS).astype(float),
        fabric=PRESETS["silk"],
        left_handed=variant == "lefthanded",
    )
    up_axis = "Z" if variant == "zup" else "Y"
    doc = "A hanging swatch whose top edge is gathered"
    return PlainStage(
        "SwatchShot", doc, (swatch,), np.arange(1.0, FRAMES + 1), metres_per_unit=1.0 / scale, up_axis=up_axis
    )


def _pose(amount: float) -> np.ndarray:
    """The swatch gathered by an amount between 0 and 1 [m], Y up."""
    v, u = np.meshgrid(np.linspace(0, 1, ROWS), np.linspace(-0.5, 0.5, COLUMNS), indexing="ij")
    u, v = u.ravel(), v.ravel()
    gather = 1.0 - amount * (0.25 * v**1.5 + 0.06)
    x = WIDTH * u * gather
    fold = 0.012 * amount * (1.0 - 0.7 * v) * np.cos(2 * np.pi * 1.5 * u + 0.4)
    bow = 0.10 * amount * (u * u - 0.08) * WIDTH * 4.0
    y = LENGTH * v * (1.0 - 0.03 * amount) + 0.2 + 0.02 * amount * u * (1.0 - v)
    return spin(np.stack([x, y, fold + bow], axis=1), np.radians(25.0) * amount * (1.0 - v))
