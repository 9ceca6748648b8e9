"""Hips, trunk and two legs that walk in place: a surface with a distance to it, and a motion of the space around it.

The motion is one smooth map for the body and for everything on it. It bends legs in planes of constant x, so that left
never meets right, and turns the trunk about the vertical: layers keep their order, as they do when skinned alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...solver.fabric import PRESETS
from ...usd.write.plain import FaceVarying, Look, PlainMesh
from .shapes import CANVAS, Solid, at_height, ease, grid_uv, mesh, quad_grid, spin

TRUNK = np.array(
    [
        [1.32, 0.150, 0.105],
        [1.22, 0.158, 0.112],
        [1.12, 0.144, 0.104],
        [1.03, 0.138, 0.100],
        [0.96, 0.156, 0.112],
        [0.88, 0.170, 0.122],
        [0.82, 0.173, 0.118],
        [0.77, 0.173, 0.108],
    ]
)
"""The trunk: height, half axes across and deep [m]."""
LEG = np.array(
    [
        [0.78, 0.0905, 0.0825, 0.112, 3.4],
        [0.66, 0.092, 0.077, 0.091, 2.8],
        [0.47, 0.094, 0.058, 0.062, 2.2],
        [0.35, 0.095, 0.054, 0.060, 2.0],
        [0.08, 0.096, 0.040, 0.044, 2.0],
    ]
)
"""A leg: height, distance of its axis from the middle, half axes across and deep [m], and how square it is."""
CROTCH, HIP, KNEE = 0.768, 0.86, 0.47
"""Heights of the crotch and of the joints [m]."""
WAIST, LARGER = 1.02, (1.04, 1.08, 1.04)
"""Height of the waist [m], and ratio of rest size to worn size for cloth pushed together."""
PERIOD = 1.25
"""Time of two steps [s]."""

Gap = Callable[[np.ndarray], np.ndarray]
"""Distance from the body [m] by height [m]."""


@dataclass(frozen=True)
class Cells:
    """How a surface round hips and legs is divided.

    Attributes:
        around: Quads around the trunk, a multiple of four.
        between: Quads along the crotch from front to back.
        trunk: Heights of the trunk's rows from the top [m].
        leg: Heights of a leg's rows from the top [m].
    """

    around: int
    between: int
    trunk: np.ndarray
    leg: np.ndarray


@dataclass(frozen=True, eq=False)
class Cage:
    """Quads round hips and legs.

    Attributes:
        points: Positions [m], shape (V, 3): the trunk's rows, the crotch, the left leg's rows, the right leg's.
        quads: Faces, shape (F, 4).
        uv: Trunk above, legs side by side below.
    """

    points: np.ndarray
    quads: np.ndarray
    uv: FaceVarying


def tube(heights: np.ndarray, around: int, gap: Gap) -> Cage:
    """Quads round the trunk alone: heights of the rows from the top [m], quads around, and distance from the body."""
    height, angle = np.meshgrid(heights, 2 * np.pi * np.arange(around) / around, indexing="ij")
    points = _trunk(height, angle, gap).reshape(-1, 3)
    rows = len(heights)
    return Cage(points, quad_grid(rows, around, closed=True), grid_uv(rows, around, closed=True))


def trousers(cells: Cells, gap: Gap) -> Cage:
    """Quads round hips and legs at a distance from the body, joined in the crotch.

    A row of quads leads from the lowest row of the trunk and the crotch to each leg's highest.
    """
    around, between, rows = cells.around, cells.between, len(cells.trunk) + 1
    height, angle = np.meshgrid([*cells.trunk, 0.0], 2 * np.pi * np.arange(around) / around, indexing="ij")
    height[-1] = 0.784 + np.where(np.sin(angle[-1]) > 0, 0.016, 0.028) * np.sin(angle[-1]) ** 2
    trunk = _trunk(height, angle, gap)
    front, back = trunk[-1, around // 4], trunk[-1, 3 * around // 4]
    s = (np.arange(1, between) / between)[:, None]
    crotch = front + (back - front) * s
    low = CROTCH - float(gap(np.array(CROTCH)))
    crotch[:, 1] -= (0.5 * (front[1] + back[1]) - low) * np.sin(np.pi * s[:, 0]) ** 0.7
    legs = [_leg(cells, side, gap) for side in (0, 1)]
    points = np.concatenate([trunk.reshape(-1, 3), crotch, *(leg.reshape(-1, 3) for leg in legs)])
    size = rows * around
    middle = size + np.arange(between - 1)
    half = np.arange(around // 2 + 1)
    upper = [
        np.concatenate([size - around + (3 * around // 4 + half) % around, middle]),
        np.concatenate([size - around + around // 4 + half, middle[::-1]]),
    ]
    return Cage(points, *_sew(cells, upper, size + between - 1))


def _sew(cells: Cells, upper: list[np.ndarray], start: int) -> tuple[np.ndarray, FaceVarying]:
    """Quads and UVs of the trunk and of both legs, whose first rows are vertices of the trunk and the crotch."""
    rows, ring = len(cells.leg), cells.around // 2 + cells.between
    trunk = quad_grid(len(cells.trunk) + 1, cells.around, closed=True)
    uv = grid_uv(len(cells.trunk) + 1, cells.around, closed=True)
    quads, values, corners = [trunk], [uv.values * (1.0, 0.4) + (0.0, 0.6)], [uv.indices]
    for side in (0, 1):
        number = np.concatenate([upper[side], start + side * rows * ring + np.arange(rows * ring)])
        quads.append(number[quad_grid(rows + 1, ring, closed=True)])
        part = grid_uv(rows + 1, ring, closed=True)
        corners.append(part.indices + sum(len(array) for array in values))
        values.append(part.values * (0.48, 0.58) + (0.52 * side, 0.0))
    return np.concatenate(quads), FaceVarying(np.concatenate(values), np.concatenate(corners))


def _trunk(height: np.ndarray, angle: np.ndarray, gap: Gap) -> np.ndarray:
    """Points round the trunk, shape (..., 3)."""
    across, deep = (axis + gap(height) for axis in at_height(TRUNK, height))
    c, s = _squared(angle, 2.3 + 0.9 * ease((0.95 - height) / 0.14))
    return np.stack([across * c, height, deep * s], axis=-1)


def _leg(cells: Cells, side: int, gap: Gap) -> np.ndarray:
    """Points round one leg, rows of `around / 2 + between` points from the back, or from the front of the right leg."""
    half, t = cells.around // 2, ease((cells.leg[0] - cells.leg) / 0.2)[:, None]
    corner = np.radians(136.0 - 18.0 * t)
    outer = corner * np.linspace(-1.0, 1.0, half + 1)
    inner = corner + (2 * np.pi - 2 * corner) * np.arange(1, cells.between) / cells.between
    angle = np.concatenate([outer, inner], axis=1)
    height = cells.leg[:, None] + 0.034 * (1.0 - t) * np.sin(angle) ** 2
    axis, across, deep, square = at_height(LEG, height)
    square = 2.1 + (square - 2.1) * (0.5 - 0.5 * np.cos(angle)) ** 0.5  # flat where the legs face each other
    c, s = _squared(angle, square)
    points = np.stack([axis + (across + gap(height)) * c, height, (deep + gap(height)) * s], axis=-1)
    return points * (1.0 - 2.0 * side, 1.0, 1.0 - 2.0 * side)


def _squared(angle: np.ndarray, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    c, s = np.cos(angle), np.sin(angle)
    reach = (np.abs(c) ** square + np.abs(s) ** square) ** (-1.0 / square)
    return reach * c, reach * s


def form(times: np.ndarray) -> PlainMesh:
    """Hips, trunk and legs that walk, as one body at times [s], closed at the chest and at the ankles."""
    cells = Cells(56, 14, np.linspace(1.32, 0.832, 26), np.linspace(0.745, 0.08, 34))
    cage = trousers(cells, np.zeros_like)
    ring, count = cells.around // 2 + cells.between, len(cage.points)
    last = count - len(cells.leg) * ring
    tips = np.array([[0.0, 1.335, 0.0], [LEG[-1, 1], 0.07, 0.0], [-LEG[-1, 1], 0.07, 0.0]])
    rings = [np.arange(cells.around)[::-1], last - ring + np.arange(ring), count - ring + np.arange(ring)]
    fans = [np.stack([np.full(len(r), count + i), r, np.roll(r, -1)], axis=1) for i, r in enumerate(rings)]
    solid = Solid(
        np.concatenate([cage.points, tips]),
        np.concatenate([np.full(len(cage.quads), 4), np.full(sum(len(fan) for fan in fans), 3)]),
        np.concatenate([cage.quads.ravel(), *(fan.ravel() for fan in fans)]),
    )
    return solid.collider("Form", CANVAS, samples=np.stack([walk(solid.points, time) for time in times]))


def garment(name: str, cage: Cage, samples: np.ndarray, look: Look, *, larger: bool = False) -> PlainMesh:
    """A garment of its look's fabric, held by its top row; ``larger`` at rest than it is worn, and pushed together."""
    top = cage.points[:, 1] > cage.points[:, 1].max() - 1e-6
    waist = np.array([0.0, WAIST, 0.0])
    return mesh(
        name,
        cage.quads,
        (cage.points - waist) * LARGER + waist if larger else cage.points,
        look,
        samples=samples,
        uv=cage.uv,
        pin=top.astype(float),
        fabric=PRESETS[look.name.lower()],
    )


def walk(points: np.ndarray, time: np.ndarray | float) -> np.ndarray:
    """Positions at a time of points of the standing body, or near it [m], shape (V, 3).

    Args:
        points: Positions round the standing body [m], shape (V, 3).
        time: Time since standing still [s], a number or an array of shape (V,); cloth may lag.
    """
    x, y, z = points.T
    stride = ease(np.asarray(time) / 0.35)
    phase = 2 * np.pi * np.asarray(time) / PERIOD
    width = 0.006 + 0.09 * ease((y - 0.735) / 0.07)
    left = ease(0.5 + x / width)
    swing = np.radians(19.0) * stride * np.sin(phase) * (2.0 * left - 1.0) + np.radians(2.0) * stride
    lifted = (np.cos(phase) * (2.0 * left - 1.0)).clip(0.0) ** 2
    knee = np.radians(34.0) * stride * lifted * ease((KNEE + 0.09 - y) / 0.18)
    y, z = _bend(y, z, -knee, at=(KNEE, 0.0))
    y, z = _bend(y, z, swing * ease((0.92 - points[:, 1]) / 0.25), at=(HIP, 0.0))
    chest = ease((points[:, 1] - 0.96) / 0.30)
    turn = np.radians(7.0) * stride * np.sin(phase) * (1.6 * chest - 1.0)
    sway = 0.016 * stride * np.sin(phase + 0.6)
    bob = 0.010 * stride * np.cos(2.0 * phase)
    return spin(np.stack([x, y, z], axis=1), turn) + np.stack(np.broadcast_arrays(sway, bob, 0.0), axis=-1)


def _bend(y: np.ndarray, z: np.ndarray, angle: np.ndarray, *, at: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Turn points about an axis along x; a positive angle takes a leg forward."""
    c, s = np.cos(angle), np.sin(angle)
    y, z = y - at[0], z - at[1]
    return at[0] + c * y + s * z, at[1] + c * z - s * y
