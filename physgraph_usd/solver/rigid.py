"""Rigid motions: a turn and a shift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Rigid:
    """A turn and a shift of points [m].

    Attributes:
        turn: Rotation, shape (3, 3).
        middle: A point that `shift` moves, about which the points are turned [m], shape (3,).
        shift: Its move [m], shape (3,).
    """

    turn: np.ndarray
    middle: np.ndarray
    shift: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """The points after the motion [m], shape (N, 3)."""
        return _plus(_plus(_plus(points, -self.middle) @ self.turn.T, self.middle), self.shift)


def _plus(points: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Points, shape (N, 3), moved by a shift, shape (3,): axis by axis, for over rows of three numpy is slow."""
    out = np.empty(points.shape)
    for axis in range(3):
        np.add(points[:, axis], shift[axis], out=out[:, axis])
    return out


AT_REST = Rigid(np.eye(3), np.zeros(3), np.zeros(3))
"""The motion that leaves all points in place."""


def best_motion(before: np.ndarray, after: np.ndarray) -> Rigid:
    """The rigid motion that brings points closest to their later places, by least squares (Kabsch 1976).

    Args:
        before: Positions [m], shape (N, 3), float64.
        after: Later positions of the same points [m].

    Returns:
        The motion; `AT_REST` where none moved, or where some positions are not finite.
    """
    if np.array_equal(before, after) or not (np.isfinite(before).all() and np.isfinite(after).all()):
        return AT_REST
    centre, centre_after = before.mean(axis=0), after.mean(axis=0)
    u, _, vt = np.linalg.svd((after - centre_after).T @ (before - centre))
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return Rigid(turn, centre, centre_after - centre)
