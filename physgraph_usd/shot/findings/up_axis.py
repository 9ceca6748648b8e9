"""Detects gravity pulling across the wearers of the garments, as on a stage with a wrong upAxis.

USD has two up axes, Y and Z, and a stage may name the wrong axis. A body or a garment alone is no evidence: a table is
wide and low, a sleeve runs along an arm. A garment around a body, with the body standing along the same axis, is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...solver.colliders.pose import Pose
from ...solver.scene import Frame, Garment, Scene
from .untagged import Candidate

STANDS = 1.7
"""Least spread of a body's points along an axis that the body stands along, over the spread along gravity. Points of
people standing, walking or dancing spread 1.7 to 8 times as far upwards as forwards, of hips alone 1.8 times; a
four-legged animal is at most half as long again as high."""
ROUND = 1.4
"""Least area facing both ways along gravity, over the area facing both ways along the axis that a garment goes round.
Of garments that are worn upright this is at most 0.63, of the same on a stage with the other axis at least 1.41; the
least and the most are a dress with tiers in a kick, whose ruffles face up and down."""


def across_gravity(scene: Scene, frames: Sequence[Frame], beside: Sequence[Candidate]) -> tuple[str, str, str] | None:
    """A garment, a body inside the garment, and their common axis, "Y" or "Z", if gravity pulls across the axis.

    A garment goes round an axis if `ROUND` times as much area faces both ways along gravity as both ways along the
    axis, in the frames and in the rest shape: the rest shape of a lying person stands.

    Args:
        frames: A few of its frames.
        beside: Bodies touched by garments but not used as colliders.
    """
    down = int(np.abs(scene.gravity).argmax())
    for index, garment in enumerate(scene.garments):
        cages = [frame.garments[index].points for frame in frames]
        rest, moving = _faces(garment, garment.rest), sum((_faces(garment, points) for points in cages), np.zeros(3))
        bodies = [
            (candidate.path, [candidate.pose])
            for candidate in beside
            if candidate.pose and garment.path in candidate.shares
        ]
        bodies += [(collider.path, _around(frames, index, number)) for number, collider in enumerate(scene.colliders)]
        for axis in {1, 2} - {down}:
            if all(ROUND * faced[axis] < faced[down] for faced in (rest, moving)):
                for path, poses in bodies:
                    spread = sum((pose.corners().std(axis=0) for pose in poses), np.zeros(3))
                    if spread[axis] > STANDS * spread[down]:
                        return garment.path, path, "XYZ"[axis]
    return None


def _faces(garment: Garment, points: np.ndarray) -> np.ndarray:
    """Area of a cage facing along each axis, the smaller of the two directions' areas [m^2], shape (3,)."""
    a, b, c = (points[corner] for corner in garment.mesh.triangulate(garment.rest).triangles.T)
    area = 0.5 * np.cross(b - a, c - a)
    return np.minimum(np.maximum(area, 0.0).sum(axis=0), np.maximum(-area, 0.0).sum(axis=0))


def _around(frames: Sequence[Frame], garment: int, collider: int) -> list[Pose]:
    """A collider's poses in the frames in which its bounds contain the garment's centre."""
    standing = []
    for frame in frames:
        pose, middle = frame.colliders[collider], frame.garments[garment].points.mean(axis=0)
        corners = np.zeros((0, 3)) if pose is None else pose.corners()
        if pose and len(corners) and (corners.min(axis=0) < middle).all() and (middle < corners.max(axis=0)).all():
            standing.append(pose)
    return standing


def pull_of(gravity: np.ndarray) -> str:
    """Strength and direction of gravity [m/s^2], shape (3,), naming the axis if gravity follows one."""
    strength = float(np.linalg.norm(gravity))
    if not strength:
        return "0 m/s^2"
    direction = gravity / strength
    axis = int(np.abs(direction).argmax())
    if np.abs(np.delete(direction, axis)).max() < 1e-6:
        return f"{strength:.3g} m/s^2 towards {'-' if direction[axis] < 0 else '+'}{'XYZ'[axis]}"
    return f"{strength:.3g} m/s^2 towards ({', '.join(f'{part:.3g}' for part in direction)})"
