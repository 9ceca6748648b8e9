"""What a collider is, and how it is posed at one time code; numpy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..rigid import AT_REST, Rigid, best_motion

KINDS = ("mesh", "sphere", "capsule", "cylinder", "cube", "plane")
RIGID = 1e-6
"""How far points may be from where a turn and a shift bring them, relative to their extent: float32's rounding."""


@dataclass(frozen=True)
class Collider:
    """What stays the same over the shot.

    Attributes:
        path: Prim path, its name in reports.
        kind: One of `KINDS`.
        offset: Distance kept from it [m], added to the garment's.
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
        triangles: Corners, shape (T, 3), int32; the same array while the topology stays the same. Wound as authored;
            for the sides "front" and "back" so that the front is where they are counterclockwise in the world.
    """

    points: np.ndarray
    triangles: np.ndarray

    def corners(self) -> np.ndarray:
        """Points that hold all of it between them [m], shape (N, 3)."""
        return self.points

    def equals(self, other: Pose) -> bool:
        """Whether both are the same to the bit."""
        return (
            isinstance(other, MeshPose)
            and np.array_equal(self.triangles, other.triangles)
            and np.array_equal(self.points, other.points)
        )

    def moved(self, since: Pose, along: Rigid = AT_REST) -> float:
        """How far any point is from where a motion takes another pose [m]; infinite where the two are not alike."""
        if not isinstance(since, MeshPose) or not np.array_equal(self.triangles, since.triangles):
            return np.inf
        return _farthest(self.points, along(since.points))


@dataclass(frozen=True, eq=False)
class ShapePose:
    """A primitive at one time code.

    Attributes:
        kind: "sphere", "capsule", "cylinder", "cube" or "plane".
        turn: Rotation whose columns are the shape's axes in the world; the third is the axis of a capsule, a cylinder
            and a plane (its outer normal), shape (3, 3), float64.
        centre: [m], world space, shape (3,), float64.
        size: Half sizes along its axes [m]: (r, r, r) of a sphere, (r, r, half height without caps) of a capsule or a
            cylinder, zero for a plane, shape (3,), float64.
    """

    kind: str
    turn: np.ndarray
    centre: np.ndarray
    size: np.ndarray

    def corners(self) -> np.ndarray:
        """Points that hold all of it between them [m], shape (N, 3); the centre of a plane, which nothing holds."""
        reach = self.size.sum()
        return self.centre + np.array([[-reach], [reach]])

    def equals(self, other: Pose) -> bool:
        """Whether both are the same to the bit."""
        return (
            isinstance(other, ShapePose)
            and self.kind == other.kind
            and all(np.array_equal(getattr(self, n), getattr(other, n)) for n in ("turn", "centre", "size"))
        )

    def moved(self, since: Pose, along: Rigid = AT_REST) -> float:
        """How far its axes' ends are from where a motion takes another pose's [m]; infinite for other kinds.

        A plane's ends lie at a metre.
        """
        if not isinstance(since, ShapePose) or self.kind != since.kind:
            return np.inf
        ends = [each.centre + (each.turn * (each.size if each.size.any() else 1.0)).T for each in (self, since)]
        return _farthest(ends[0], along(ends[1]))


Pose = MeshPose | ShapePose


def _farthest(points: np.ndarray, others: np.ndarray) -> float:
    """How far any point is from its other place [m], 0 without points; infinite where they are no places."""
    if points.shape != others.shape:
        return np.inf
    far = float(np.linalg.norm(points - others, axis=1).max(initial=0.0))
    return far if np.isfinite(far) else np.inf


def moved_rigidly(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether points were turned and shifted alone, by the best such move (Kabsch 1976).

    Args:
        before: Positions [m], shape (V, 3), float64.
        after: Positions of the same points [m].
    """
    return _farthest(after, best_motion(before, after)(before)) <= RIGID * np.ptp(before, axis=0).max()
