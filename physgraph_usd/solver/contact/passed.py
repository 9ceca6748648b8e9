"""Bodies that a cage passes right through between two frames.

Each frame is solved at its own time, where the cloth is pushed out of closed bodies and kept on its cage's side of open
ones. A body that is faster than it is thick may be on one side of the cage in a frame and on the other in the next; the
cloth follows its cage there, and this says so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..colliders.orient import pieces_of
from ..colliders.pose import Collider, MeshPose, ShapePose
from ..colliders.sweep import Sweep, through_shape
from ..scene import Frame, Garment
from ..strain import has_collapsed


class Passed:
    """Remembers the last frame of a shot. Meshes whose topology changes are not looked at."""

    def __init__(
        self, garments: Sequence[Garment], colliders: Sequence[Collider], *, device: str = "cpu", threads: int = 1
    ) -> None:
        """Take the scene; nothing is looked at before the second frame."""
        self._garments, self._colliders = tuple(garments), tuple(colliders)
        self._place = {"device": device, "threads": threads}
        self._last: Frame | None = None
        self._parts: dict[int, tuple[np.ndarray, Sweep, Sweep]] = {}

    def forget(self) -> None:
        """Compare the next frame with none."""
        self._last = None

    def look(self, frame: Frame) -> list[dict[str, int]]:
        """Compare a frame with the last one.

        Returns:
            For each garment, the number of its cage's points that came through, by the body's path: out at the other
            side of a closed piece that they were not in before, or to the other side of an open one.
        """
        last, self._last = self._last, frame
        if last is None:
            return [{} for _ in self._garments]
        found = []
        for index, garment in enumerate(self._garments):
            ways = last.garments[index].points, frame.garments[index].points
            if any(has_collapsed(garment, points) for points in ways):  # It is not there.
                found.append({})
                continue
            counts = {self._colliders[body].path: self._count(body, last, frame, ways) for body in garment.colliders}
            found.append({path: count for path, count in counts.items() if count})
        return found

    def _count(self, body: int, last: Frame, frame: Frame, ways: tuple[np.ndarray, np.ndarray]) -> int:
        before, after = last.colliders[body], frame.colliders[body]
        if isinstance(before, ShapePose) and isinstance(after, ShapePose) and before.kind == after.kind:
            # Points that are not finite make every comparison false.
            return int(through_shape(before, after, start=ways[0], end=ways[1]).sum())
        if not isinstance(before, MeshPose) or not isinstance(after, MeshPose):
            return 0
        if before.points.shape != after.points.shape or not np.array_equal(before.triangles, after.triangles):
            return 0
        if not _meet(np.stack([before.points, after.points]), np.stack(ways)):
            return 0
        closed, opened = self._pieces(body, after)
        start, end = ways
        through = [each.passages(before.points, after.points, start=start, end=end) for each in (closed, opened)]
        (closings, opposed), (openings, _) = through
        came_out = (closings > 0) & (closings % 2 == 0) & opposed
        return int((came_out | (openings % 2 == 1)).sum())

    def _pieces(self, body: int, pose: MeshPose) -> tuple[Sweep, Sweep]:
        """The closed and the open part, kept while the topology stays the same."""
        known = self._parts.get(body)
        if known is None or not np.array_equal(known[0], pose.triangles):
            pieces = pieces_of(pose.points, pose.triangles, side=self._colliders[body].side)
            sweeps = [Sweep(each, **self._place) for each in (pieces.closed, pieces.open)]
            known = self._parts[body] = (pose.triangles, sweeps[0], sweeps[1])
        return known[1], known[2]


def _meet(body: np.ndarray, cloth: np.ndarray) -> bool:
    """Whether the boxes of two point sets over both frames, each of shape (2, N, 3), meet."""
    if not body.size or not cloth.size:
        return False
    boxes = [(each.min(axis=(0, 1)), each.max(axis=(0, 1))) for each in (body, cloth)]
    # Points that are not finite make every comparison false.
    return bool((boxes[0][0] <= boxes[1][1]).all() and (boxes[1][0] <= boxes[0][1]).all())
