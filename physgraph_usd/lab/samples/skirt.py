"""A flared skirt on hips that turn and swing: the hem follows late, twists and folds."""

from __future__ import annotations

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import Look, PlainMesh, PlainStage
from .drape import Drape, DrapeOptions
from .grid import ease, grid_uv, quad_grid

ROWS, AROUND, FOLDS = 23, 76, 8
"""Rows from waist to hem, columns around, and folds at the hem."""

WAIST, HEM, LENGTH = (0.146, 0.116), 0.36, 0.52
"""Half axes of the waist, radius of the hem at rest and length down the side [m]."""

FRAMES, WARM_UP, STEPS = 48, 40, 2

PROFILE = np.array(
    [
        [0.1225, 0.06, 0.045],
        [0.118, 0.09, 0.067],
        [0.11, 0.109, 0.081],
        [0.10, 0.118, 0.088],
        [0.04, 0.128, 0.098],
        [-0.02, 0.145, 0.113],
        [-0.09, 0.168, 0.130],
        [-0.16, 0.176, 0.136],
        [-0.24, 0.168, 0.120],
        [-0.32, 0.150, 0.100],
        [-0.38, 0.138, 0.090],
    ]
)
"""The hips: height, half axes across and deep [m]."""


def build() -> PlainStage:
    """Build the shot.

    Returns:
        A triangulated skirt, 48 samples, over a collider that moves by its transform.
    """
    rest = _rest()
    quads = quad_grid(ROWS, AROUND, closed=True)[:, ::-1]
    triangles, corners = _split(quads, grid_uv(ROWS, AROUND, closed=True).indices.reshape(-1, 4)[:, ::-1])
    uv = grid_uv(ROWS, AROUND, closed=True)
    poses = np.stack([_hips(frame / 24.0) for frame in range(FRAMES)])
    garment = PlainMesh(
        name="Skirt",
        counts=np.full(len(triangles), 3),
        indices=triangles.ravel(),
        points=rest,
        look=Look("Wool", (0.42, 0.10, 0.12)),
        samples=_swing(rest, quads),
        uv=type(uv)(uv.values, corners.ravel()),
        pin=(np.arange(len(rest)) < AROUND).astype(float),
        fabric=PRESETS["wool"],
    )
    shot = "A flared skirt on turning hips"
    return PlainStage("SkirtShot", shot, (garment, _hip_mesh(poses)), np.arange(1.0, FRAMES + 1))


def _rest() -> np.ndarray:
    """The skirt hanging in soft folds that open towards the hem, row by row."""
    v, a = np.meshgrid(np.linspace(0, 1, ROWS), 2 * np.pi * np.arange(AROUND) / AROUND, indexing="ij")
    v, a = v.ravel(), a.ravel()
    fold = 1.0 + 0.15 * v**1.6 * np.cos(FOLDS * a + 0.6 * np.sin(2 * a) + 0.4 * np.sin(3 * a + 1.0))
    across = (WAIST[0] + (HEM - WAIST[0]) * v) * fold
    deep = (WAIST[1] + (HEM - WAIST[1]) * v) * fold
    out = np.hypot((across - WAIST[0]) * np.cos(a), (deep - WAIST[1]) * np.sin(a))
    drop = np.sqrt((LENGTH * v) ** 2 - out**2)  # every line from waist to hem has the same length
    return np.stack([across * np.cos(a), 0.02 - drop, deep * np.sin(a)], axis=1)


def _split(quads: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles with alternating diagonals, and the same split of the UV corners."""
    odd = (np.arange(len(quads)) // AROUND + np.arange(len(quads)) % AROUND) % 2 == 1
    both = []
    for four in (quads, corners):
        turned = np.where(odd[:, None], np.roll(four, 1, axis=1), four)
        both.append(np.stack([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]], axis=1).reshape(-1, 3))
    return both[0], both[1]


def _hips(time: float) -> np.ndarray:
    """The hips' matrix at a time [s]: a turn, a quick turn back, and a swing from side to side."""
    turn = np.radians(55.0) * ease(time / 0.8) - np.radians(90.0) * ease((time - 0.85) / 1.15)
    sway = 0.025 * np.sin(2 * np.pi * time / 1.4) * ease(time / 0.5)
    roll = 1.6 * sway
    c, s, p, q = np.cos(turn), np.sin(turn), np.cos(roll), np.sin(roll)
    yaw = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    tilt = np.array([[p, -q, 0], [q, p, 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = tilt @ yaw, (sway, 0.95, 0.0)
    return matrix


def _swing(rest: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Simulate the coarse skirt, shape (T, V, 3)."""
    options = DrapeOptions(spring=40.0, iterations=5, give=0.84, bend=0.12, drag=1.2, density=0.235)
    band = np.arange(2 * AROUND)

    def project(points: np.ndarray, time: float) -> np.ndarray:
        return _push_out(points, _hips(time - WARM_UP * options.step))

    start = rest @ _hips(0.0)[:3, :3].T + _hips(0.0)[:3, 3]
    skirt = Drape(rest, quads, band, options=options, project=project, start=start)
    for _ in range(WARM_UP):
        skirt.step(start[band])
    frames = []
    for _ in range(FRAMES):
        frames.append(skirt.points)
        for _ in range(STEPS):
            pose = _hips(skirt.time + options.step - WARM_UP * options.step)
            skirt.step(rest[band] @ pose[:3, :3].T + pose[:3, 3])
    return np.stack(frames)


def _push_out(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Move points that are inside the hips to 15 mm outside, horizontally."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    across = np.interp(-local[:, 1], -PROFILE[:, 0], PROFILE[:, 1]) + 0.015
    deep = np.interp(-local[:, 1], -PROFILE[:, 0], PROFILE[:, 2]) + 0.015
    reach = np.hypot(local[:, 0] / across, local[:, 2] / deep)
    grow = np.where((reach < 1.0) & (local[:, 1] > PROFILE[-1, 0]), 1.0 / np.maximum(reach, 1e-3), 1.0)
    return (local * np.stack([grow, np.ones_like(grow), grow], axis=1)) @ pose[:3, :3].T + pose[:3, 3]


def _hip_mesh(poses: np.ndarray) -> PlainMesh:
    """The hips as a closed mesh of quads with triangle fans at both ends."""
    around, rows = 40, 30
    height = np.concatenate([[0.1225, 0.118, 0.11], np.linspace(0.10, PROFILE[-1, 0], rows - 3)])
    across = np.interp(-height, -PROFILE[:, 0], PROFILE[:, 1])
    deep = np.interp(-height, -PROFILE[:, 0], PROFILE[:, 2])
    a = 2 * np.pi * np.arange(around) / around
    ring = np.stack(np.broadcast_arrays(across[:, None] * np.cos(a), height[:, None], deep[:, None] * np.sin(a)), -1)
    ends = np.array([[0.0, PROFILE[0, 0] + 0.001, 0.0], [0.0, PROFILE[-1, 0] - 0.02, 0.0]])
    points = np.concatenate([ring.reshape(-1, 3), ends])
    quads = quad_grid(rows, around, closed=True)[:, ::-1]
    step = (np.arange(around) + 1) % around
    top = np.stack([np.full(around, len(points) - 2), step, np.arange(around)], axis=1)
    last = (rows - 1) * around
    bottom = np.stack([np.full(around, len(points) - 1), last + np.arange(around), last + step], axis=1)
    return PlainMesh(
        name="Hips",
        counts=np.concatenate([np.full(len(quads), 4), np.full(2 * around, 3)]),
        indices=np.concatenate([quads.ravel(), top.ravel(), bottom.ravel()]),
        points=points,
        look=Look("Form", (0.60, 0.56, 0.50)),
        role="collider",
        transforms=poses,
    )
