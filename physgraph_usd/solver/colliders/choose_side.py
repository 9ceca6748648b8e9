"""Allowed side of an open mesh, from the mesh's winding number at the coarse cloth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .orient import pieces_of

ASKED = 64
"""Number of cage vertices, spread over the cage, whose winding numbers stand for all: enough to tell a half from a
quarter."""
INSIDE = 0.5
"""Winding number from which a point is inside."""
CLEAR = 0.75
"""Least fraction of a cage on one side of a floor or wall; cloth hanging over a wall has half on each side."""


def choose_side(points: np.ndarray, triangles: np.ndarray, cages: Sequence[np.ndarray]) -> str:
    """The side, one of `schema.SIDES`, for a mesh without an authored side.

    "winding" for a mesh with pieces that have an inside, unless most of a cage lies inside: a coat round a shirt.
    "front" or "back" for floors and walls: planes larger than the cloth, with the cloth on one side. "auto" for all
    remaining meshes.

    Args:
        points: Positions [m], shape (V, 3).
        triangles: Corners, counterclockwise on the front, shape (T, 3).
        cages: Positions of each cage [m], shape (U, 3).
    """
    cages = [cage[:: max(1, len(cage) // ASKED)] for cage in cages if len(cage)]
    usual = pieces_of(points, triangles)
    if not len(usual.open) or not cages:
        return "auto"
    hollow = pieces_of(points, triangles, side="winding")
    if len(hollow.closed) > len(usual.closed):
        inside = [float((winding_numbers(points, hollow.closed, cage) > INSIDE).mean()) for cage in cages]
        return "winding" if max(inside) <= 0.5 else "auto"
    plane = pieces_of(points, triangles, side="front").open
    small = _size(points[plane].reshape(-1, 3)) < max(map(_size, cages))
    if small or not np.array_equal(plane, usual.open):  # Its faces do not look one way.
        return "auto"
    behind = [float((winding_numbers(points, plane, cage) > 0.0).mean()) for cage in cages]
    return "front" if max(behind) <= 1.0 - CLEAR else "back" if min(behind) >= CLEAR else "auto"


def _size(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def winding_numbers(points: np.ndarray, triangles: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Generalised winding numbers of a mesh, positive behind its faces, shape (N,) (Jacobson et al. 2013).

    Each face adds its solid angle over 4 pi (Van Oosterom and Strackee 1983).

    Args:
        points: Positions [m], shape (V, 3).
        triangles: Corners, shape (T, 3).
        x: Query points [m], shape (N, 3).
    """
    numbers = np.empty(len(x))
    for index, place in enumerate(x):
        a, b, c = (points[triangles[:, corner]] - place for corner in range(3))
        la, lb, lc = (np.linalg.norm(each, axis=1) for each in (a, b, c))
        volume = np.einsum("td,td->t", a, np.cross(b, c))
        dots = (np.einsum("td,td->t", *pair) for pair in ((a, b), (b, c), (c, a)))
        below = la * lb * lc + sum(dot * length for dot, length in zip(dots, (lc, la, lb), strict=True))
        numbers[index] = np.arctan2(volume, below).sum() / (2.0 * np.pi)
    return numbers
