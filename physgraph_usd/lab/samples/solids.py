"""Closed bodies of the samples: their meshes, and pushes that keep coarse cloth out of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .grid import quad_grid


@dataclass(frozen=True, eq=False)
class Solid:
    """A mesh that is closed, or several of them that overlap.

    Attributes:
        points: Positions [m], shape (V, 3).
        counts: Vertices per face, shape (F,).
        indices: Vertices of the face corners, counter-clockwise seen from outside, shape (C,).
    """

    points: np.ndarray
    counts: np.ndarray
    indices: np.ndarray


def lathe(rings: np.ndarray, ends: np.ndarray) -> Solid:
    """Close a stack of rings by a fan at each end.

    Args:
        rings: Rings [m], shape (R, A, 3); seen from the first ring's end they run clockwise.
        ends: Tips of the fans beyond the first and the last ring [m], shape (2, 3).

    Returns:
        The solid; its points are the rings, then the two tips.
    """
    count, around = rings.shape[:2]
    here = np.arange(around)
    following = np.roll(here, -1)
    first, last = count * around, (count - 1) * around
    fans = [
        np.stack([np.full(around, first), following, here], axis=1),
        np.stack([np.full(around, first + 1), last + here, last + following], axis=1),
    ]
    quads = quad_grid(count, around, closed=True)
    return Solid(
        np.concatenate([rings.reshape(-1, 3), ends]),
        np.concatenate([np.full(len(quads), 4), np.full(2 * around, 3)]),
        np.concatenate([quads.ravel(), *(fan.ravel() for fan in fans)]),
    )


def join(*solids: Solid) -> Solid:
    """Several solids as one mesh; they may overlap."""
    starts = np.cumsum([0, *(len(solid.points) for solid in solids)])
    return Solid(
        np.concatenate([solid.points for solid in solids]),
        np.concatenate([solid.counts for solid in solids]),
        np.concatenate([solid.indices + start for solid, start in zip(solids, starts, strict=False)]),
    )


def box(half: np.ndarray) -> Solid:
    """A box of six quads about the origin.

    Args:
        half: Half sizes [m], shape (3,).
    """
    corner = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return Solid(corner * half, np.full(6, 4), quads.ravel())


def torus(major: float, minor: float, cells: tuple[int, int]) -> Solid:
    """A torus of quads about the Y axis.

    Args:
        major: Radius of the circle in the middle of the tube [m].
        minor: Radius of the tube [m].
        cells: Quads around the axis and around the tube.
    """
    a, b = np.meshgrid(*(2 * np.pi * np.arange(count) / count for count in cells), indexing="ij")
    reach = major + minor * np.cos(b)
    points = np.stack([reach * np.cos(a), minor * np.sin(b), reach * np.sin(a)], axis=-1).reshape(-1, 3)
    i, j = np.divmod(np.arange(cells[0] * cells[1]), cells[1])
    over, up = (i + 1) % cells[0] * cells[1], (j + 1) % cells[1]
    quads = np.stack([i * cells[1] + j, i * cells[1] + up, over + up, over + j], axis=1)
    return Solid(points, np.full(len(quads), 4), quads.ravel())


def ellipsoid(axes: np.ndarray, middle: np.ndarray, cells: tuple[int, int]) -> Solid:
    """An ellipsoid of quads, with a fan at its top and at its bottom.

    Args:
        axes: Half axes [m], shape (3,).
        middle: Its centre [m], shape (3,).
        cells: Faces around and from top to bottom.
    """
    down = np.pi * np.arange(1, cells[1])[:, None] / cells[1]
    around = 2 * np.pi * np.arange(cells[0]) / cells[0]
    ring = [np.sin(down) * np.cos(around), np.cos(down), np.sin(down) * np.sin(around)]
    rings = np.stack(np.broadcast_arrays(*ring), axis=-1)
    return lathe(middle + axes * rings, middle + axes * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]))


def off_box(points: np.ndarray, half: np.ndarray, gap: float) -> np.ndarray:
    """Move points that are closer to a box about the origin than a gap straight out.

    Args:
        points: Positions [m], shape (V, 3).
        half: Half sizes of the box [m], shape (3,).
        gap: Distance kept, and the radius of the edges of the surface on which points come to lie [m].

    Returns:
        The positions [m], shape (V, 3).
    """
    outside = np.abs(points) - half
    far = outside.clip(0.0)
    distance = np.linalg.norm(far, axis=1) + outside.max(axis=1).clip(max=0.0)
    side = np.where(outside.max(axis=1, keepdims=True) > 0.0, far, outside == outside.max(axis=1, keepdims=True))
    side = np.sign(points) * side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    return points + (gap - distance).clip(0.0)[:, None] * side


def off_torus(points: np.ndarray, major: float, minor: float) -> np.ndarray:
    """Move points that are inside a torus about the Y axis out to its surface.

    Args:
        points: Positions [m], shape (V, 3).
        major: Radius of the circle in the middle of the tube [m].
        minor: Radius of the tube [m].

    Returns:
        The positions [m], shape (V, 3).
    """
    middle = points * (1.0, 0.0, 1.0)
    middle *= major / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    return off_points(points, middle, minor)


def off_points(points: np.ndarray, middle: np.ndarray, radius: np.ndarray | float) -> np.ndarray:
    """Move each point to a distance from its own centre, when it is closer.

    Args:
        points: Positions [m], shape (V, 3).
        middle: Centres [m], shape (V, 3).
        radius: Distances kept [m], shape (V,) or one for all.

    Returns:
        The positions [m], shape (V, 3).
    """
    away = points - middle
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    return points + ((radius - distance).clip(0.0) / distance)[:, None] * away
