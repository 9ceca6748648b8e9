"""A flared skirt on hips that turn and swing: the hem follows late, twists and folds."""

from __future__ import annotations

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import FaceVarying, Look, PlainMesh, PlainStage
from .drape import Drape, DrapeOptions
from .shapes import Solid, at_height, ease, grid_uv, lathe, mesh, quad_grid, rings

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
    """A triangulated skirt over a collider moved by a transform."""
    rest = _rest()
    quads = quad_grid(ROWS, AROUND, closed=True)[:, ::-1]
    uv = grid_uv(ROWS, AROUND, closed=True)
    triangles, corners = (_split(faces) for faces in (quads, uv.indices.reshape(-1, 4)[:, ::-1]))
    garment = mesh(
        "Skirt",
        triangles,
        rest,
        Look("Wool", (0.42, 0.10, 0.12)),
        samples=_swing(rest, quads),
        uv=FaceVarying(uv.values, corners.ravel()),
        pin=(np.arange(len(rest)) < AROUND).astype(float),
        fabric=PRESETS["wool"],
    )
    doc = "A flared skirt on turning hips"
    return PlainStage("SkirtShot", doc, (garment, _body()), np.arange(1.0, FRAMES + 1))


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


def _split(quads: np.ndarray) -> np.ndarray:
    """Quads, or their UV corners, as triangles with alternating diagonals."""
    is_odd = (np.arange(len(quads)) // AROUND + np.arange(len(quads)) % AROUND) % 2 == 1
    turned = np.where(is_odd[:, None], np.roll(quads, 1, axis=1), quads)
    return np.stack([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]], axis=1).reshape(-1, 3)


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
    options = DrapeOptions(spring=40.0, iterations=5, give=0.84, bend=0.12, drag=1.2, density=0.235)
    band = np.arange(2 * AROUND)

    def project(points: np.ndarray, time: float) -> np.ndarray:
        return _push_out(points, _hips(time - WARM_UP * options.step))

    start = rest @ _hips(0.0)[:3, :3].T + _hips(0.0)[:3, 3]
    skirt = Drape(rest, quads, band, options=options, project=project, start=start)
    for _ in range(WARM_UP):
        skirt.step(start[band])

    def held(time: float) -> np.ndarray:
        pose = _hips(time - WARM_UP * options.step)
        return rest[band] @ pose[:3, :3].T + pose[:3, 3]

    return skirt.film(FRAMES, STEPS, held)


def _push_out(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Move points that are inside the hips to 15 mm outside, horizontally."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    across, deep = (axis + 0.015 for axis in at_height(PROFILE, local[:, 1]))
    reach = np.hypot(local[:, 0] / across, local[:, 2] / deep)
    grow = np.where((reach < 1.0) & (local[:, 1] > PROFILE[-1, 0]), 1.0 / np.maximum(reach, 1e-3), 1.0)
    return (local * np.stack([grow, np.ones_like(grow), grow], axis=1)) @ pose[:3, :3].T + pose[:3, 3]


def _body() -> PlainMesh:
    """The hips as a closed mesh of quads with triangle fans at both ends; its quads face inwards."""
    around, rows = 40, 30
    height = np.concatenate([[0.1225, 0.118, 0.11], np.linspace(0.10, PROFILE[-1, 0], rows - 3)])
    across, deep = at_height(PROFILE, height)
    ends = np.array([[0.0, PROFILE[0, 0] + 0.001, 0.0], [0.0, PROFILE[-1, 0] - 0.02, 0.0]])
    solid = lathe(rings(across, height, deep, around), ends)
    quads, fans = np.split(solid.indices, [4 * (rows - 1) * around])
    hips = Solid(solid.points, solid.counts, np.concatenate([quads.reshape(-1, 4)[:, ::-1].ravel(), fans]))
    poses = np.stack([_hips(frame / 24.0) for frame in range(FRAMES)])
    return hips.collider("Hips", Look("Form", (0.60, 0.56, 0.50)), transforms=poses)
