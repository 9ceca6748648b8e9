"""Triangles of spheres, capsules, cylinders, cones, boxes and planes, which stand for primitives in contact."""

from __future__ import annotations

import functools

import numpy as np

from .pose import Pose

KINDS = ("sphere", "capsule", "cylinder", "cone", "cube", "plane")
AROUND = 96
"""Usual segments about the axis: faces lie up to a thousandth of the radius inside the shape."""
LEAST_AROUND = 12
"""Fewest segments about the axis."""
SQUARES = (1.0, 10.0, 100.0, 1000.0)
"""Half sizes of the squares that stand for a plane [m]. They grow from its centre because the single precision of a
closest point is relative to the size of its triangle."""


def primitive(kind: str, size: np.ndarray, *, turn: np.ndarray, centre: np.ndarray, around: int = AROUND) -> Pose:
    """A primitive at one time code.

    Args:
        kind: One of `KINDS`.
        size: Sizes [m], shape (3,): half sizes along the axes of a cube, (r, r, r) of a sphere, (r, r, half height) of
            a cone; radius at the bottom, radius at the top and half height of a cylinder, or of a capsule without its
            caps. Ignored for a plane.
        turn: Matrix whose columns are the shape's axes in the world; the third is the axis of a cone, a cylinder or a
            capsule, and the outer normal of a plane, shape (3, 3).
        centre: Centre [m], world space, shape (3,).
        around: Segments about the axis, a multiple of 4.
    """
    points, triangles = _plane() if kind == "plane" else tessellated(kind, *map(float, size), around=around)
    return Pose(points @ turn.T + centre, triangles, endless=kind == "plane")


def segments(radius: float, within: float) -> int:
    """Fewest segments about an axis, a multiple of 4, with faces at most a distance inside the circle [both in m]."""
    turn = max(np.arccos(1.0 - min(within / max(radius, within), 1.0)), np.pi / AROUND)
    return int(np.clip(4 * np.ceil(np.pi / turn / 4.0), LEAST_AROUND, AROUND))


@functools.lru_cache(maxsize=64)
def tessellated(kind: str, x: float, y: float, z: float, *, around: int = AROUND) -> tuple[np.ndarray, np.ndarray]:
    """Points [m], shape (V, 3), and outward triangles, shape (T, 3), int32, of a primitive about its third axis.

    Args:
        kind: One of `KINDS` but "plane".
        x: First of the sizes of `primitive` [m].
        y: Second size [m].
        z: Third size [m].
        around: Segments about the axis, a multiple of 4.
    """
    if kind == "cube":
        return _box(np.array([x, y, z]))
    rises = around // 2
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, rises + 1)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    shift = np.array([0.0, z])
    profile = {
        "sphere": x * arc,
        "capsule": np.concatenate([x * arc[: rises // 2 + 1] - shift, y * arc[rises // 2 :] + shift]),
        "cylinder": np.array([[0.0, -z], [x, -z], [y, z], [0.0, z]]),
        "cone": np.array([[0.0, -z], [x, -z], [0.0, z]]),
    }[kind]
    rows = profile[1:-1]
    wide = rows[:, 0] > 0.0  # An end of radius 0 is a tip.
    return _revolved(rows[wide] if wide.any() else rows[:1], profile[[0, -1], 1], around)


def _revolved(profile: np.ndarray, poles: np.ndarray, around: int) -> tuple[np.ndarray, np.ndarray]:
    """Turn a profile of (radius, height) rows, upwards, about the third axis and close it at two heights."""
    rows = len(profile)
    a = 2.0 * np.pi * np.arange(around) / around
    ring = np.stack([profile[:, :1] * np.cos(a), profile[:, :1] * np.sin(a), profile[:, 1:] + 0.0 * a], axis=2)
    ends = np.array([[0.0, 0.0, poles[0]], [0.0, 0.0, poles[1]]])
    ids = np.arange(rows * around).reshape(rows, around)
    south, north = rows * around, rows * around + 1
    bottom = np.stack([np.full(around, south), np.roll(ids[0], -1), ids[0]], axis=1)
    top = np.stack([np.full(around, north), ids[-1], np.roll(ids[-1], -1)], axis=1)
    triangles = np.concatenate([*map(_between, ids[:-1], ids[1:]), bottom, top])
    return np.concatenate([ring.reshape(-1, 3), ends]), triangles.astype(np.int32)


def _between(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Triangles between two closed rows of equally many points, given by their numbers."""
    lower_next, upper_next = np.roll(lower, -1), np.roll(upper, -1)
    triangles = (lower, lower_next, upper_next), (lower, upper_next, upper)
    return np.concatenate([np.stack(corners, axis=1) for corners in triangles])


def _box(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The eight corners and twelve triangles of a box."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return signs * size, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


@functools.cache
def _plane() -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of nested squares, the innermost first."""
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    ids = np.arange(4 * len(SQUARES)).reshape(-1, 4)
    inner = np.array([[0, 1, 2], [0, 2, 3]])
    triangles = np.concatenate([inner, *map(_between, ids[1:], ids[:-1])])
    return np.concatenate([half * corners for half in SQUARES]), triangles.astype(np.int32)
