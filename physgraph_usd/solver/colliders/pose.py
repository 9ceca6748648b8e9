"""Colliders, and poses of colliders at a time code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..rigid import AT_REST, Rigid, best_motion

RIGID = 1e-6
"""Largest deviation of points from a rigid motion, relative to their extent: float32's rounding."""
FEW = 64
"""Number of points whose distances are compared first."""


@dataclass(frozen=True)
class Collider:
    """Properties of a collider that are constant over the shot.

    Attributes:
        path: Prim path, used as the name in reports.
        kind: "mesh", or one of `primitives.KINDS`.
        offset: Distance kept from the collider [m], added to the garment's offset.
        side: One of `SIDES`.
    """

    path: str
    kind: str
    offset: float = 0.0
    side: str = "auto"


@dataclass(frozen=True, eq=False)
class Pose:
    """The triangles of a collider at one time code.

    Attributes:
        points: Positions [m], world space, shape (V, 3), float64.
        triangles: Corners, shape (T, 3), int32; the array object is kept while the topology is unchanged. Wound as
            authored; for the sides "front" and "back" counterclockwise in the world on the front.
        endless: True if the mesh stands for a plane: only its first four points count for bounds and pictures.
    """

    points: np.ndarray
    triangles: np.ndarray
    endless: bool = False

    def corners(self) -> np.ndarray:
        """Points whose convex hull contains the drawn part of the mesh [m], shape (N, 3)."""
        return self.points[:4] if self.endless else self.points

    def equals(self, pose: Pose) -> bool:
        """True if both poses are bitwise equal."""
        return np.array_equal(self.triangles, pose.triangles) and np.array_equal(self.points, pose.points)

    def moved(self, reference: Pose, along: Rigid = AT_REST) -> float:
        """Largest distance of a corner from the moved reference pose [m]; infinite if the topology differs."""
        if self.triangles is not reference.triangles and not np.array_equal(self.triangles, reference.triangles):
            return np.inf
        return _farthest(self.corners(), reference.corners() if along is AT_REST else along(reference.corners()))


def _farthest(points: np.ndarray, targets: np.ndarray) -> float:
    """Largest distance of corresponding points [m], 0 without points; infinite for non-finite points."""
    if points.shape != targets.shape:
        return np.inf
    differences = points - targets
    far = float(np.sqrt(np.einsum("vc,vc->v", differences, differences).max(initial=0.0)))
    return far if np.isfinite(far) else np.inf


def bounds_of(points: np.ndarray) -> np.ndarray:
    """Least and greatest corner, shape (2, 3); without points an empty box that meets nothing."""
    if not len(points):
        return np.stack([np.full(3, np.inf), np.full(3, -np.inf)])
    columns = np.ascontiguousarray(points.T)  # Over rows of three numpy is slow.
    return np.stack([columns.min(axis=1), columns.max(axis=1)])


def extent(points: np.ndarray) -> np.ndarray:
    """Extent of points, shape (N, 3), along each axis, shape (3,); minus infinity without points."""
    low, high = bounds_of(points)
    return high - low


def moved_rigidly(before: np.ndarray, after: np.ndarray) -> bool:
    """True if the points moved rigidly, by comparison with the best rigid motion (Kabsch 1976).

    A rigid motion keeps the distances between points. A few distances are compared first, which excludes most bending.

    Args:
        before: Positions [m], shape (V, 3), float64.
        after: Positions of the points after the motion [m].
    """
    allowed, sample = RIGID * extent(before).max(), slice(None, None, len(before) // FEW + 1)
    steps_before, steps_after = (np.linalg.norm(np.diff(points[sample], axis=0), axis=1) for points in (before, after))
    if (np.abs(steps_after - steps_before) > 2.0 * allowed).any():
        return False
    return _farthest(after, best_motion(before, after)(before)) <= allowed
