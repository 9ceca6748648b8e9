"""Shapes that several samples share: grids of quads, closed bodies, and pushes that keep coarse cloth out of bodies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...usd.write.plain import FaceVarying, Look, PlainMesh

CANVAS = Look("Canvas", (0.60, 0.56, 0.50))
"""Material of the bodies."""


def mesh(name: str, faces: np.ndarray, points: np.ndarray, look: Look, **values: Any) -> PlainMesh:
    """A mesh of triangles or quads, shape (F, 3) or (F, 4), with any further fields of `PlainMesh`."""
    return PlainMesh(name, np.full(len(faces), faces.shape[1]), faces.ravel(), points, look, **values)


def quad_grid(rows: int, columns: int, *, closed: bool = False) -> np.ndarray:
    """Quads of a grid of vertices, row by row, shape (F, 4) int32; ``closed`` joins the last column to the first.

    A vertex's number is ``row * columns + column``.
    """
    across = columns if closed else columns - 1
    row, column = np.divmod(np.arange((rows - 1) * across), across)
    right = (column + 1) % columns
    low, high = row * columns, (row + 1) * columns
    return np.stack([low + column, low + right, high + right, high + column], axis=1).astype(np.int32)


def grid_uv(rows: int, columns: int, *, closed: bool = False) -> FaceVarying:
    """UVs in 0..1 on the corners of `quad_grid`'s quads, with a seam where a closed grid meets itself."""
    width = columns + 1 if closed else columns
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, width), indexing="ij")
    return FaceVarying(np.stack([u.ravel(), v.ravel()], axis=1), quad_grid(rows, width).ravel())


def spin(points: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Positions [m], shape (V, 3), turned about the Y axis by an angle [rad], one for all or one each."""
    x, y, z = points.T
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * x + s * z, y, c * z - s * x], axis=1)


def at_height(table: np.ndarray, height: np.ndarray) -> list[np.ndarray]:
    """The columns of a table at heights, interpolated between rows; the first column is the falling height."""
    return [np.interp(-height, -table[:, 0], column) for column in table[:, 1:].T]


def flipped(uv: FaceVarying) -> FaceVarying:
    """UVs of quads with reversed corners."""
    return FaceVarying(uv.values, uv.indices.reshape(-1, 4)[:, ::-1].ravel())


def square(side: float, cells: int, height: float) -> tuple[np.ndarray, np.ndarray, FaceVarying]:
    """A level square of cloth: positions [m], shape (V, 3), quads, shape (F, 4), and UVs."""
    line = np.linspace(-0.5 * side, 0.5 * side, cells + 1)
    z, x = np.meshgrid(-line, line, indexing="ij")
    points = np.stack([x.ravel(), np.full(x.size, height), z.ravel()], axis=1)
    return points, quad_grid(cells + 1, cells + 1), grid_uv(cells + 1, cells + 1)


def springs(faces: np.ndarray) -> np.ndarray:
    """Edges and diagonals of triangles or quads: vertex pairs, each once and the lower number first, shape (S, 2)."""
    size = faces.shape[1]
    pairs = [faces[:, [i, (i + 1) % size]] for i in range(size)]
    if size == 4:
        pairs += [faces[:, [0, 2]], faces[:, [1, 3]]]
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)


def ease(t: np.ndarray | float) -> np.ndarray:
    """Smooth step 6 t^5 - 15 t^4 + 10 t^3 of a time clamped to 0..1: no velocity and no acceleration at its ends."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * t * (t * (6.0 * t - 15.0) + 10.0)


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed mesh, or several overlapping ones.

    Attributes:
        points: Positions [m], shape (V, 3).
        counts: Vertices per face, shape (F,).
        indices: Vertices of the face corners, counter-clockwise seen from outside, shape (C,).
    """

    points: np.ndarray
    counts: np.ndarray
    indices: np.ndarray

    def collider(self, name: str, look: Look, **values: Any) -> PlainMesh:
        """The solid as a body that cloth touches, with any further fields of `PlainMesh`."""
        return PlainMesh(name, self.counts, self.indices, self.points, look, role="collider", **values)


def rings(across: np.ndarray, height: np.ndarray, deep: np.ndarray, around: int) -> np.ndarray:
    """Ellipses about the Y axis from half axes and heights [m], shape (R,) each: points of shape (R, around, 3)."""
    a = 2 * np.pi * np.arange(around) / around
    across, height, deep = (values[:, None] for values in (across, height, deep))
    return np.stack(np.broadcast_arrays(across * np.cos(a), height, deep * np.sin(a)), axis=-1)


def lathe(rings: np.ndarray, ends: np.ndarray) -> Solid:
    """Rings [m], shape (R, A, 3), closed by fans to a tip at each end [m], shape (2, 3).

    Seen from the first ring's end the rings run clockwise. The solid's points are the rings, then the two tips.
    """
    count, around = rings.shape[:2]
    ring = np.arange(around)
    following = np.roll(ring, -1)
    first, last = count * around, (count - 1) * around
    fans = [
        np.stack([np.full(around, first), following, ring], axis=1),
        np.stack([np.full(around, first + 1), last + ring, last + following], axis=1),
    ]
    quads = quad_grid(count, around, closed=True)
    return Solid(
        np.concatenate([rings.reshape(-1, 3), ends]),
        np.concatenate([np.full(len(quads), 4), np.full(2 * around, 3)]),
        np.concatenate([quads.ravel(), *(fan.ravel() for fan in fans)]),
    )


def join(*solids: Solid) -> Solid:
    """Several solids, possibly overlapping, as one mesh."""
    starts = np.cumsum([0, *(len(solid.points) for solid in solids)])
    return Solid(
        np.concatenate([solid.points for solid in solids]),
        np.concatenate([solid.counts for solid in solids]),
        np.concatenate([solid.indices + start for solid, start in zip(solids, starts, strict=False)]),
    )


def box(half: np.ndarray) -> Solid:
    """A box of six quads about the origin, from its half sizes [m], shape (3,)."""
    corner = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return Solid(corner * half, np.full(6, 4), quads.ravel())


def torus(major: float, minor: float, cells: tuple[int, int]) -> Solid:
    """A torus of quads about the Y axis: radii of the tube's middle and of the tube [m], quads around either."""
    a, b = np.meshgrid(*(2 * np.pi * np.arange(count) / count for count in cells), indexing="ij")
    radius = major + minor * np.cos(b)
    points = np.stack([radius * np.cos(a), minor * np.sin(b), radius * np.sin(a)], axis=-1).reshape(-1, 3)
    quads = quad_grid(cells[0] + 1, cells[1], closed=True) % len(points)
    return Solid(points, np.full(len(quads), 4), quads.ravel())


def ellipsoid(axes: np.ndarray, middle: np.ndarray, cells: tuple[int, int]) -> Solid:
    """An ellipsoid of quads with a fan at the top and at the bottom.

    Half axes and centre [m] have shape (3,); ``cells`` are the faces around and from top to bottom.
    """
    down = np.pi * np.arange(1, cells[1]) / cells[1]
    ball = rings(np.sin(down), np.cos(down), np.sin(down), cells[0])
    return lathe(middle + axes * ball, middle + axes * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]))


def off_box(points: np.ndarray, half: np.ndarray, gap: float) -> np.ndarray:
    """Positions [m], shape (V, 3), with those closer to a box about the origin than a gap moved straight out.

    The box has half sizes [m], shape (3,); the surface on which points come to lie has edges of the gap's radius [m].
    """
    outside = np.abs(points) - half
    far = outside.clip(0.0)
    distance = np.linalg.norm(far, axis=1) + outside.max(axis=1).clip(max=0.0)
    side = np.where(outside.max(axis=1, keepdims=True) > 0.0, far, outside == outside.max(axis=1, keepdims=True))
    side = np.sign(points) * side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    return points + (gap - distance).clip(0.0)[:, None] * side


def off_torus(points: np.ndarray, major: float, minor: float) -> np.ndarray:
    """Positions [m], shape (V, 3), with those inside a torus about the Y axis moved to its surface; radii [m]."""
    middle = points * (1.0, 0.0, 1.0)
    middle *= major / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    away = points - middle
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    return points + ((minor - distance).clip(0.0) / distance)[:, None] * away
