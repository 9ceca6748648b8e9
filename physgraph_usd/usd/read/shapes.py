"""Triangle meshes of USD's primitives, for those that a transform makes into something without a name."""

from __future__ import annotations

import numpy as np

AROUND, ALONG = 64, 24
"""Segments around the axis and along a half circle."""

UPRIGHT = {
    "X": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "Y": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "Z": np.eye(3),
}
"""For each axis token, the matrix that turns a shape about its third axis to it."""


def tessellated(kind: str, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a primitive about its third axis.

    Args:
        kind: "sphere", "capsule", "cylinder", "cone" or "cube".
        size: Half sizes, the capsule's without its caps, shape (3,).

    Returns:
        Points, shape (V, 3), and triangles wound outward, shape (T, 3), int32.
    """
    if kind == "cube":
        return _box(size)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, ALONG + 1)
    arc = size[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    height = size[2]
    shift = np.array([0.0, height])
    profiles = {
        "sphere": arc,
        "capsule": np.concatenate([arc[: ALONG // 2 + 1] - shift, arc[ALONG // 2 :] + shift]),
        "cylinder": np.array([[0.0, -height], [size[0], -height], [size[0], height], [0.0, height]]),
        "cone": np.array([[0.0, -height], [size[0], -height], [0.0, height]]),
    }
    return _revolved(profiles[kind][1:-1], profiles[kind][[0, -1], 1])


def _revolved(profile: np.ndarray, poles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn a profile of (radius, height) rows, upwards, about the third axis and close it at two heights."""
    rows = len(profile)
    a = 2.0 * np.pi * np.arange(AROUND) / AROUND
    ring = np.stack([profile[:, :1] * np.cos(a), profile[:, :1] * np.sin(a), profile[:, 1:] + 0.0 * a], axis=2)
    ends = np.array([[0.0, 0.0, poles[0]], [0.0, 0.0, poles[1]]])
    ids = np.arange(rows * AROUND).reshape(rows, AROUND)
    here, there = ids, np.roll(ids, -1, axis=1)
    quads = np.stack([here[:-1], there[:-1], there[1:], here[1:]], axis=-1).reshape(-1, 4)
    south, north = rows * AROUND, rows * AROUND + 1
    bottom = np.stack([np.full(AROUND, south), there[0], here[0]], axis=1)
    top = np.stack([np.full(AROUND, north), here[-1], there[-1]], axis=1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], bottom, top])
    return np.concatenate([ring.reshape(-1, 3), ends]), triangles.astype(np.int32)


def _box(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The eight corners and twelve triangles of a box."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return signs * size, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
