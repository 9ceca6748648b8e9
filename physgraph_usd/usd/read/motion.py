"""The acceleration of a garment's cage, from its samples around a time code."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence

import numpy as np

from ...errors import GarmentError
from ...solver.inertia import acceleration_of, felt
from ...solver.scene import out_of_bounds
from ..times import SAME_TIME

MOST = 3
"""Most frames whose accelerations are compared."""
STANDS = 1e-4
"""Motion in a frame below which a cage stands still [m]."""
ROUNDS = 4
"""Passes of smoothing over the cage: each mixes a vertex with the mean of its neighbours in equal parts."""
FRAMES = 2
"""Frames from a time code to the samples before and after."""
_KEPT = 2 * FRAMES + 4
"""Number of samples kept: a shot that is read in order reads each sample once."""


class CageMotion:
    """Acceleration of one cage at its time codes.

    It comes from the nearest samples at least two frames before and after, in which what alternates from frame to
    frame cancels out. Of the accelerations of three frames in a row each vertex takes the one nearest to the others:
    a single broken sample has no effect. At the shot's ends these are the nearest frames with samples on both sides.
    Then each vertex takes the mean over its surroundings: what single vertices of a cage do is no motion of the cloth.
    """

    def __init__(
        self,
        times: Sequence[float],
        read: Callable[[float], np.ndarray],
        *,
        edges: np.ndarray,
        frame: float,
        seconds: float,
    ) -> None:
        """Take the time codes of the garment's samples, also those that are not solved.

        Args:
            times: Time codes with a shape, in any order.
            read: Gives the cage's positions in world space at a time code [m], shape (V, 3).
            edges: Edges of the cage, shape (E, 2).
            frame: Length of a frame in time codes.
            seconds: Length of a time code [s].
        """
        self._times, self._read, self._edges = sorted(times), read, edges
        self._frame, self._seconds = frame, seconds
        self._known: dict[float, np.ndarray] = {}

    def felt(self, time: float | None, points: np.ndarray) -> np.ndarray | None:
        """Acceleration that the cloth feels at a time code [m/s^2], shape (V, 3); None for slow or still cages.

        Args:
            points: The cage's positions at that time code [m].
        """
        if time is None:
            return None
        self._keep(time, points)
        if self._stands(time, points):
            return None
        accelerations = [self._acceleration(*three) for three in self._around(time)]
        valid = [acceleration for acceleration in accelerations if acceleration is not None]
        return felt(self._mean(_agreed(valid))) if valid else None

    def _stands(self, time: float, points: np.ndarray) -> bool:
        """Whether the cage rests since the previous frame, although earlier samples moved."""
        before = self._beside(time, -self._frame)
        try:
            return before is not None and float(np.abs(points - self._at(before)).max(initial=0.0)) < STANDS
        except GarmentError:
            return False

    def _around(self, time: float) -> list[tuple[float, float, float]]:
        """Time codes before, at and after up to `MOST` frames: the frame at a time code and its neighbours."""
        apart = FRAMES * self._frame
        first, last = (self._beside(end, by) for end, by in ((self._times[0], apart), (self._times[-1], -apart)))
        if first is None or last is None or first > last:
            return []
        middle = min(max(time, first), last)
        chosen = {middle}
        for by in (-self._frame, self._frame, -2.0 * self._frame, 2.0 * self._frame):
            neighbour = self._beside(middle, by)
            if neighbour is not None and first <= neighbour <= last and len(chosen) < MOST:
                chosen.add(neighbour)
        triples = [(self._beside(code, -apart), code, self._beside(code, apart)) for code in sorted(chosen)]
        return [(a, b, c) for a, b, c in triples if a is not None and c is not None]

    def _beside(self, time: float, by: float) -> float | None:
        """The nearest sample at least ``by`` time codes after a time code, or before if negative; None without one."""
        wanted = time + by - np.sign(by) * SAME_TIME
        number = bisect_left(self._times, wanted) if by > 0 else bisect_right(self._times, wanted) - 1
        return self._times[number] if 0 <= number < len(self._times) else None

    def _acceleration(self, *three: float) -> np.ndarray | None:
        """Acceleration over three time codes; None if rounding makes two times equal, or a pose is unusable."""
        first, middle, last = (code * self._seconds for code in three)
        if not first < middle < last:
            return None
        try:
            poses = [self._at(code) for code in three]
        except GarmentError:  # A broken sample beside this one has its own error, at its own time code.
            return None
        return None if any(map(out_of_bounds, poses)) else acceleration_of(poses, (first, middle, last))

    def _mean(self, field: np.ndarray) -> np.ndarray:
        """A field with the mean over the neighbours mixed in, `ROUNDS` times, shape (V, 3)."""
        count, (start, end) = len(field), self._edges.T
        neighbours = np.bincount(self._edges.ravel(), minlength=count)[:, None]
        for _ in range(ROUNDS):
            gathered = [
                np.bincount(start, field[end, k], count) + np.bincount(end, field[start, k], count) for k in range(3)
            ]
            field = np.where(neighbours > 0, 0.5 * (field + np.stack(gathered, 1) / np.maximum(neighbours, 1)), field)
        return field

    def _at(self, time: float) -> np.ndarray:
        return self._known[time] if time in self._known else self._keep(time, self._read(time))

    def _keep(self, time: float, points: np.ndarray) -> np.ndarray:
        self._known.pop(time, None)
        self._known[time] = points
        while len(self._known) > _KEPT:
            del self._known[next(iter(self._known))]
        return points


def _agreed(accelerations: Sequence[np.ndarray]) -> np.ndarray:
    """The medoid of three accelerations at each vertex [m/s^2], shape (V, 3); of two accelerations the smaller."""
    rows = np.arange(len(accelerations[0]))
    stacked = np.stack(accelerations)  # N V 3
    candidates = stacked if len(accelerations) == MOST else np.zeros_like(stacked[:1])
    far = np.linalg.norm(stacked[:, None] - candidates[None], axis=3).sum(axis=1)  # N V
    return stacked[far.argmin(axis=0), rows]
