"""Colliders and their poses at one time code; numpy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..rigid import AT_REST, Rigid, best_motion

COLLIDER_KINDS = ("mesh", "sphere", "capsule", "cylinder", "cube", "plane")
RIGID = 1e-6
"""Largest deviation of points from a rigid motion, relative to their extent: float32's rounding."""


@dataclass(frozen=True)
class Collider:
    """Properties of a collider that are constant over the shot.

    Attributes:
        path: Prim path, used as the name in reports.
        kind: One of `COLLIDER_KINDS`.
        offset: Distance kept from the collider [m], added to the garment's offset.
        side: One of `SIDES`.
    """

    path: str
    kind: str
    offset: float = 0.0
    side: str = "auto"


@dataclass(frozen=True, eq=False)
class MeshPose:
    """A mesh at one time code.

    Attributes:
        points: Positions [m], world space, shape (V, 3), float64.
        triangles: Corners, shape (T, 3), int32; the array object is kept while the topology is unchanged. Wound as
            authored; for the sides "front" and "back" counterclockwise in the world on the front.
    """

    points: np.ndarray
    triangles: np.ndarray

    def corners(self) -> np.ndarray:
        """Points whose convex hull contains the mesh [m], shape (N, 3)."""
        return self.points

    def equals(self, other: Pose) -> bool:
        """True if both poses are bitwise equal."""
        return (
            isinstance(other, MeshPose)
            and np.array_equal(self.triangles, other.triangles)
            and np.array_equal(self.points, other.points)
        )

    def moved(self, since: Pose, along: Rigid = AT_REST) -> float:
        """Largest distance of a point from its image of another pose under a motion [m]; infinite for unlike poses."""
        if not isinstance(since, MeshPose) or not np.array_equal(self.triangles, since.triangles):
            return np.inf
        return _farthest(self.points, along(since.points))


@dataclass(frozen=True, eq=False)
class ShapePose:
    """A primitive at one time code.

    Attributes:
        kind: "sphere", "capsule", "cylinder", "cube" or "plane".
        turn: Rotation whose columns are the shape's axes in the world; the third column is the axis of a capsule or a
            cylinder, and the outer normal of a plane, shape (3, 3), float64.
        centre: Centre [m], world space, shape (3,), float64.
        size: Half sizes along the axes [m]: (r, r, r) of a sphere, (r, r, half height without caps) of a capsule or a
            cylinder, zero for a plane, shape (3,), float64.
    """

    kind: str
    turn: np.ndarray
    centre: np.ndarray
    size: np.ndarray

    def corners(self) -> np.ndarray:
        """Points whose convex hull contains the shape [m], shape (N, 3); for an unbounded plane its centre."""
        reach = self.size.sum()
        return self.centre + np.array([[-reach], [reach]])

    def equals(self, other: Pose) -> bool:
        """True if both poses are bitwise equal."""
        return (
            isinstance(other, ShapePose)
            and self.kind == other.kind
            and all(np.array_equal(getattr(self, n), getattr(other, n)) for n in ("turn", "centre", "size"))
        )

    def moved(self, since: Pose, along: Rigid = AT_REST) -> float:
        """Largest distance of an axis end from its image of another pose [m]; infinite for unlike kinds.

        The ends of a plane's axes lie at a metre.
        """
        if not isinstance(since, ShapePose) or self.kind != since.kind:
            return np.inf
        ends = [each.centre + (each.turn * (each.size if each.size.any() else 1.0)).T for each in (self, since)]
        return _farthest(ends[0], along(ends[1]))


Pose = MeshPose | ShapePose


def _farthest(points: np.ndarray, others: np.ndarray) -> float:
    """Largest distance of corresponding points [m], 0 without points; infinite for non-finite points."""
    if points.shape != others.shape:
        return np.inf
    far = float(np.linalg.norm(points - others, axis=1).max(initial=0.0))
    return far if np.isfinite(far) else np.inf


def moved_rigidly(before: np.ndarray, after: np.ndarray) -> bool:
    """True if the points moved rigidly, by comparison with the best rigid motion (Kabsch 1976).

    Args:
        before: Positions [m], shape (V, 3), float64.
        after: Positions of the points after the motion [m].
    """
    return _farthest(after, best_motion(before, after)(before)) <= RIGID * np.ptp(before, axis=0).max()
