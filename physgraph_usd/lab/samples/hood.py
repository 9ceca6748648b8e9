"""A wide hood over a head that turns and leans; behind the ears it slumps into a fold of three layers.

The coarse hood is shaped, not simulated: a hull with the fold in it, moved by a smooth map of the space round the neck.
"""

from __future__ import annotations

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import FaceVarying, Look, PlainStage
from .shapes import CANVAS, ease, ellipsoid, grid_uv, join, mesh, quad_grid, spin

UP, DEEP, FOLD = 20, 15, (3, 5)
"""Quads from the neckline up one side to the top, from the face to the seam behind, and to the fold's two bends."""
ROUND = 0.6
"""How round an arch is on top: 1 for an ellipse, less for a broader one."""
FOLDED = np.radians(160.0)
"""How far the cloth turns back on itself in the fold [rad]."""
HEAD, HEAD_AT = np.array([0.078, 0.118, 0.098]), np.array([0.0, 0.175, 0.0])
BUST, BUST_AT = np.array([0.215, 0.080, 0.130]), np.array([0.0, -0.090, -0.010])
"""Half axes and middles of the head and of the shoulders [m]; the neckline is at y = 0."""
FRAMES = 24


def build() -> PlainStage:
    """A hood pinned along the neckline, a head with an animated transform, and static shoulders."""
    quads, used, uv = _faces()
    rest, worn = (points.reshape(-1, 3)[used] for points in (_hull(0.0, 0.39, 1.17), _hull(1.0, 0.315, 1.0)))
    times = np.arange(FRAMES) / 24.0
    hood = mesh(
        "Hood",
        quads,
        rest,
        Look("Jersey", (0.24, 0.36, 0.42)),
        samples=np.stack([_turn(worn, time, fraction=0.6) for time in times]),
        uv=uv,
        pin=(rest[:, 1] < 1e-9).astype(float),
        fabric=PRESETS["jersey"],
    )
    poses = np.stack([_pose(time) for time in times])
    head = ellipsoid(HEAD, HEAD_AT, (32, 22)).collider("Head", CANVAS, transforms=poses)
    neck = ellipsoid(np.array([0.052, 0.110, 0.054]), np.array([0.0, 0.03, -0.01]), (24, 14))
    bust = join(ellipsoid(BUST, BUST_AT, (40, 18)), neck).collider("Bust", CANVAS)
    doc = "A wide hood over a turning head, with a fold that lies on itself"
    return PlainStage("HoodShot", doc, (hood, head, bust), 1.0 + np.arange(FRAMES))


def _faces() -> tuple[np.ndarray, np.ndarray, FaceVarying]:
    """Quads of a grid from the face to the seam, whose last row is sewn to itself; the points used; UVs."""
    rows, columns = DEEP + 1, 2 * UP + 1
    j, k = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    number = np.where((j < DEEP) | (k <= UP), j * columns + k, j * columns + 2 * UP - k)
    used, quads = np.unique(number.ravel()[quad_grid(rows, columns)], return_inverse=True)
    return quads.reshape(-1, 4).astype(np.int32), used, grid_uv(rows, columns)


def _hull(folded: float, height: float, larger: float) -> np.ndarray:
    """Arches from the face to the seam behind, shape (rows, columns, 3), with the fold or without it [m].

    Above the neckline the cloth goes up, then by a growing angle outward and down again, then up into the arch.
    """
    j, k = np.meshgrid(np.arange(DEEP + 1), np.arange(2 * UP + 1) - UP, indexing="ij")
    back, step = j / DEEP, UP - np.abs(k)
    (wide, z), (across, behind) = (curve.T[:, j] for curve in _neckline())
    first, second = FOLD
    angle = FOLDED * folded * ease(back / 0.75)
    cell = height / UP
    slanted = cell * np.clip(step - first, 0, second - first)
    rise = cell * np.minimum(step, first) + slanted * np.cos(angle)
    above = height - 0.07 * folded * ease(2.0 * back - 1.0) - rise[:, UP : UP + 1]
    arch = _even(((step - second) / (UP - second)).clip(0.0), wide[:, 0], above[:, 0])
    out = slanted * np.sin(angle) * np.cos(arch) ** 2
    x = np.sign(k) * (wide * np.cos(arch) ** ROUND + out * across)
    y = rise + above * np.sin(arch)
    z = z + out * behind + 0.03 * np.sin(arch) * (1.0 - back)
    return np.stack([larger * x, y, larger * z], axis=-1)


def _even(fraction: np.ndarray, wide: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Angles on each row's arch after a fraction of its length, shape (rows, columns)."""
    t = 0.5 * np.pi * (1.0 - (1.0 - np.linspace(0.0, 1.0, 401)) ** 2)  # closer together at the top, where it turns
    angles = []
    for part, w, h in zip(fraction, wide, high, strict=True):
        curve = np.stack([w * np.cos(t) ** ROUND, h * np.sin(t)], axis=1)
        length = _lengths(curve)
        angles.append(np.interp(part * length[-1], length, t))
    return np.stack(angles)


def _lengths(curve: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])


def _neckline() -> tuple[np.ndarray, np.ndarray]:
    """One side of the neckline from the face to the seam in even steps: (x, z) [m] and unit normals outward."""
    t = np.linspace(0.0, 0.5 * np.pi, 2001)
    curve = np.stack([0.112 * np.cos(t) ** 0.5, 0.085 - 0.235 * np.sin(t) ** 0.9], axis=1)
    length = _lengths(curve)
    even = np.linspace(0.0, length[-1], DEEP + 1)
    resampled = np.stack([np.interp(even, length, curve[:, i]) for i in (0, 1)], axis=1)
    along = np.gradient(resampled, axis=0)
    along[-1] = -1.0, 0.0  # the other side goes on from here
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return resampled, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _angles(time: float) -> tuple[float, float]:
    """How far the head turns to one side and leans to the other at a time [rad]."""
    turn = np.radians(34.0) * (ease(time / 0.45) - 1.6 * ease((time - 0.40) / 0.55))
    lean = np.radians(11.0) * (ease((time - 0.1) / 0.4) - 1.8 * ease((time - 0.45) / 0.5))
    return float(turn), float(lean)


def _pose(time: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = _rotate(np.eye(3), *_angles(time)).T
    return matrix


def _turn(points: np.ndarray, time: float, *, fraction: float) -> np.ndarray:
    """The hood at a time [s]: it follows the head by a fraction, less towards the neck and late by a frame."""
    turn, lean = _angles(time - 0.03)
    height = ease((points[:, 1] - 0.01) / 0.16)
    return _rotate(points, fraction * turn * height, lean * height)


def _rotate(points: np.ndarray, turn: np.ndarray | float, lean: np.ndarray | float) -> np.ndarray:
    """Turn points about the vertical, then lean them about z."""
    x, y, z = spin(points, turn).T
    c, s = np.cos(lean), np.sin(lean)
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)
