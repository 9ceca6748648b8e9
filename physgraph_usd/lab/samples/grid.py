"""Quad grids: topology, UVs, springs and easing that several samples share."""

from __future__ import annotations

import numpy as np

from ...usd.write.plain import FaceVarying


def quad_grid(rows: int, columns: int, *, closed: bool = False) -> np.ndarray:
    """Quads of a grid of vertices, row by row.

    Args:
        rows: Rows of vertices.
        columns: Columns of vertices.
        closed: Join the last column to the first.

    Returns:
        Quads, shape (F, 4) int32; a vertex's number is ``row * columns + column``.
    """
    across = columns if closed else columns - 1
    row, column = np.divmod(np.arange((rows - 1) * across), across)
    right = (column + 1) % columns
    low, high = row * columns, (row + 1) * columns
    return np.stack([low + column, low + right, high + right, high + column], axis=1).astype(np.int32)


def grid_uv(rows: int, columns: int, *, closed: bool = False) -> FaceVarying:
    """UVs of a grid, with a seam where a closed one meets itself.

    Args:
        rows: Rows of vertices.
        columns: Columns of vertices.
        closed: As for ``quad_grid``.

    Returns:
        UVs in 0..1 on the corners of ``quad_grid``'s quads.
    """
    width = columns + 1 if closed else columns
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, width), indexing="ij")
    return FaceVarying(np.stack([u.ravel(), v.ravel()], axis=1), quad_grid(rows, width).ravel())


def springs(faces: np.ndarray) -> np.ndarray:
    """Edges and diagonals of triangles or quads.

    Args:
        faces: Vertex numbers, shape (F, 3) or (F, 4).

    Returns:
        Vertex pairs without repetition, lower number first, shape (S, 2).
    """
    size = faces.shape[1]
    pairs = [faces[:, [i, (i + 1) % size]] for i in range(size)]
    if size == 4:
        pairs += [faces[:, [0, 2]], faces[:, [1, 3]]]
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)


def ease(t: np.ndarray | float) -> np.ndarray:
    """Smooth step from 0 to 1 with zero velocity and acceleration at both ends.

    Args:
        t: Time, clamped to 0..1.

    Returns:
        6 t^5 - 15 t^4 + 10 t^3.
    """
    t = np.clip(t, 0.0, 1.0)
    return t * t * t * (t * (6.0 * t - 15.0) + 10.0)
