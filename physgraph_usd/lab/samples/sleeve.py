"""A sleeve: an irregular triangulated tube, pushed together by a fifth and twisted."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from ...solver.fabric import PRESETS
from ...usd.write.plain import FaceVarying, Look, PlainStage
from .shapes import ease, mesh

AROUND, ROWS, EXTRA = 32, 52, 4
"""Vertices around an end, rows of vertices, and vertices added inside: 1,668, so that two splits give 26,304."""
LENGTH, RADIUS_TOP, RADIUS_CUFF = 0.53, 0.068, 0.052
"""Size of the sleeve at rest [m]."""
FRAMES = 24


def build() -> PlainStage:
    """A garment: over the shot the length falls by 20% and the cuff turns by 70 degrees."""
    flat = _scatter()
    triangles, corners = _triangulate(flat)
    samples = np.stack([_pose(flat, float(ease(i / (FRAMES - 1)))) for i in range(FRAMES)])
    sleeve = mesh(
        "Sleeve",
        triangles,
        _pose(flat, 0.0),
        Look("Jersey", (0.24, 0.42, 0.52)),
        samples=samples,
        uv=corners,
        pin=((flat[:, 1] < 1e-6) | (flat[:, 1] > 1 - 1e-6)).astype(float),
        fabric=PRESETS["jersey"],
    )
    doc = "A sleeve, compressed by a fifth and twisted"
    return PlainStage("SleeveShot", doc, (sleeve,), np.arange(1.0, FRAMES + 1))


def _scatter() -> np.ndarray:
    """Return (u, v) in the unit square, periodic in u: two even rings and jittered rows relaxed between them."""
    rng = np.random.default_rng(20)
    per_row = np.full(ROWS, AROUND)
    per_row[np.linspace(8, ROWS - 9, EXTRA).astype(int)] += 1
    rows = []
    for row, count in enumerate(per_row):
        inside = 0 < row < ROWS - 1
        u = (np.arange(count) + 0.5 * (row % 2) + inside * rng.uniform(-0.33, 0.33, count)) / count
        v = (row + inside * rng.uniform(-0.33, 0.33, count)) / (ROWS - 1)
        rows.append(np.stack([u % 1.0, np.broadcast_to(v, count)], axis=1))
    flat = np.concatenate(rows)
    fixed = (flat[:, 1] < 1e-9) | (flat[:, 1] > 1 - 1e-9)
    for _ in range(2):
        flat = _relax(flat, fixed)
    return flat


def _relax(flat: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """Move free points half way to the mean of their neighbours."""
    triangles, uv = _triangulate(flat)
    ends = uv.values[uv.indices].reshape(-1, 3, 2)
    total, count = np.zeros_like(flat), np.zeros(len(flat))
    for i in range(3):
        for j in ((i + 1) % 3, (i + 2) % 3):
            np.add.at(total, triangles[:, i], ends[:, j] - ends[:, i])
            np.add.at(count, triangles[:, i], 1.0)
    moved = flat + 0.5 * total / count[:, None]
    moved[:, 0] %= 1.0
    return np.where(fixed[:, None], flat, moved)


def _triangulate(flat: np.ndarray) -> tuple[np.ndarray, FaceVarying]:
    """Delaunay triangles on the unrolled tube, and UVs with a seam."""
    scale = np.array([2 * np.pi * 0.5 * (RADIUS_TOP + RADIUS_CUFF), LENGTH])
    count = len(flat)
    tiled = np.concatenate([flat + np.array([shift, 0.0]) for shift in (-1.0, 0.0, 1.0)])
    simplices = Delaunay(tiled * scale).simplices
    centre = tiled[simplices, 0].mean(axis=1)
    simplices = simplices[(centre >= 0.0) & (centre < 1.0)]
    a, b, c = (tiled[simplices[:, i]] for i in range(3))
    turned = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) < 0
    simplices[turned] = simplices[turned][:, ::-1]
    simplices = simplices[np.lexsort(simplices.T[::-1])]
    used, corners = np.unique(simplices, return_inverse=True)
    return (simplices % count).astype(np.int32), FaceVarying(tiled[used], corners.ravel().astype(np.int32))


def _pose(flat: np.ndarray, amount: float) -> np.ndarray:
    """Roll the flat points up and deform the tube; amount 0 is the rest shape, 1 the end of the shot."""
    u, v = flat[:, 0], flat[:, 1]
    angle = 2 * np.pi * u + np.radians(70.0) * amount * (1.0 - v)
    radius = RADIUS_CUFF + (RADIUS_TOP - RADIUS_CUFF) * ease(v)
    ring_x, ring_z = radius * np.cos(angle), -radius * np.sin(angle)
    along = LENGTH * (v - 0.5) * (1.0 - 0.2 * amount)
    bend = 0.5 * amount
    if bend < 1e-9:
        return np.stack([ring_x, along, ring_z], axis=1)
    arc = LENGTH * (1.0 - 0.2 * amount) / bend
    turn = along / arc
    return np.stack([(arc + ring_x) * np.cos(turn) - arc, (arc + ring_x) * np.sin(turn), ring_z], axis=1)
