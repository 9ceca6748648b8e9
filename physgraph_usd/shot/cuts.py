"""Finds frames to which cloth jumps: from the previous sample, without velocity there, or round a loop."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import Any

import numpy as np

from ..errors import GarmentError
from ..solver.frame.settings import Reset
from ..solver.scene import SAME_TIME, Frame, Result, mean_edge
from ..usd.read.reader import Shot

JUMP = Reset().move
"""Least deviation of a step from its neighbouring steps to count as a jump, RMS over a garment's points, in mean cage
edges. The solver treats cloth as a new pose from the same distance."""
OPEN, SEEN_AT = 0.1, 99.0
"""Least distance between the ends of a loop, in edges of the refined cloth: a tenth of one is visible, as in `settled`.
And the percentile of the points' distances that counts: a few points at a hem make no jump."""
_CLOSED = 1e-5
"""Largest distance between equal points, relative to their extent: single precision, far from the origin."""
_LEAST = 4
"""Least time codes of a loop: two steps that differ, and its end."""
_STARTED_ANEW = "cold: "
"""Prefix, in a frame's telemetry, of the reason for not continuing from the previous frame."""


class Cuts:
    """Jumps of all garments with velocities."""

    def __init__(self, opened: Shot, *, velocities: bool) -> None:
        """Find the cages' jumps; ``velocities``: whether garments without authored velocities count too."""
        self._jumps = [
            jumps(opened, index) if velocities or source.velocities else frozenset[float]()
            for index, source in enumerate(opened.sources)
        ]

    def __call__(self, records: Sequence[Mapping[str, Any]]) -> set[int]:
        """Numbers of the garments whose cloth jumps to the last telemetry record, or was solved anew there."""
        entries = [record["garments"] for record in records[-2:] if record.get("garments")]
        return {
            index
            for index, entry in enumerate(records[-1]["garments"])
            if records[-1]["time"] in self._jumps[index]
            or _STARTED_ANEW in str(entry.get("start", ""))
            or "broken_before" in entry
            or any("collapsed" in garments[index] or "not_solved" in garments[index] for garments in entries)
        }


def jumps(opened: Shot, index: int) -> frozenset[float]:
    """Time codes to which a garment's cage, by number, jumps in its own space.

    A step between two poses at the same time is a jump. Others are compared with the previous and next step, so even
    motion is no jump at any speed. If a shot has only two steps, the larger step is the jump.
    """
    ends, lasted, lengths, away = _steps(_samples(opened, index))
    jump_ends = {end for end, time in zip(ends, lasted, strict=True) if time <= SAME_TIME}
    if len(ends) < 2:
        return frozenset(jump_ends)
    least = JUMP * _mean_edge(opened, index)
    for step, end in enumerate(ends):
        beside = [neighbour for neighbour in (step - 1, step + 1) if 0 <= neighbour < len(ends)]
        departs = lasted[step] * min(away[min(step, neighbour)] for neighbour in beside) > least
        if departs and (len(beside) > 1 or lengths[step] > lengths[beside[0]]):
            jump_ends.add(end)
    return frozenset(jump_ends)


def _samples(opened: Shot, index: int) -> Iterator[tuple[float, np.ndarray]]:
    """Time codes and positions of a cage in its own space, without frames that cannot be read."""
    source = opened.sources[index]
    for time in sorted({*source.times, *source.left_out}):
        with suppress(GarmentError):
            yield time, opened.local(index, time)


def _steps(samples: Iterable[tuple[float, np.ndarray]]) -> tuple[list[float], list[float], list[float], list[float]]:
    """End times of the steps between samples, durations, speeds, and differences between consecutive speeds.

    Speeds are RMS over the points, per time code; there is one difference fewer.
    """
    ends, lasted, lengths, away = [], [], [], []
    last: np.ndarray | None = None
    for (start, before), (end, x) in pairwise(samples):
        speed = (x - before) / (end - start)
        ends.append(end)
        lasted.append(end - start)
        lengths.append(_rms(speed))
        away += [] if last is None else [_rms(speed - last)]
        last = speed
    return ends, lasted, lengths, away


def _mean_edge(opened: Shot, index: int) -> float:
    """Mean edge of a cage in its own units at the first readable sample."""
    edges = opened.scene.garments[index].mesh.half_edges.edges
    _, first = next(_samples(opened, index))
    return float(np.linalg.norm(first[edges[:, 0]] - first[edges[:, 1]], axis=1).mean())


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


class Loop:
    """The ends of a run, of interest where the shot is a loop.

    In a loop, the last cages and bodies are the first ones, and the first step of the cages goes on from the last one.
    A motion that only returns, as of an arm that is lowered again, begins with the opposite of its last step.
    """

    def __init__(self, opened: Shot, levels: Sequence[int]) -> None:
        """Start without a result; ``levels``: the number of subdivisions of each garment."""
        self._shot, self._levels = opened, levels
        self._times: list[float | None] = []
        self._ends: list[Result] = []

    def add(self, result: Result) -> None:
        """Take the result of the next time code."""
        self._times.append(result.time)
        self._ends = [*self._ends[:1], result]

    def gaps(self) -> dict[str, float]:
        """Distance between first and last result [m] of each garment in a loop, by path, if visible."""
        if len(self._times) < _LEAST or not all(result.garments for result in self._ends):
            return {}
        frames = [self._shot.frame(result.time) for result in self._ends]
        closing = {}
        for index, garment in enumerate(self._shot.scene.garments):
            gap = _apart(*(result.garments[index].points for result in self._ends))
            if gap > OPEN * mean_edge(garment) / 2 ** self._levels[index] and self._is_loop(index, frames):
                closing[garment.path] = gap
        return closing

    def _is_loop(self, index: int, frames: Sequence[Frame]) -> bool:
        """Whether a garment, by number, and its bodies are the same in the first and last frame and move on alike."""
        numbers = self._shot.scene.garments[index].colliders
        poses = [[frame.colliders[number] for number in numbers] for frame in frames]
        ends = [[pose.points for pose in pair if pose is not None] for pair in poses]
        ends = [[frame.garments[index].points, *bodies] for frame, bodies in zip(frames, ends, strict=True)]
        if len(ends[0]) != len(ends[1]) or not all(map(_is_closed, *ends)):
            return False
        second, last_but_one = (self._shot.cage(index, self._times[number]) for number in (1, -2))
        return float(np.vdot(second - ends[0][0], ends[1][0] - last_but_one)) > 0.0


def _is_closed(first: np.ndarray, last: np.ndarray) -> bool:
    """Whether two poses are the same, up to rounding."""
    if first.shape != last.shape:
        return False
    within = _CLOSED * float(np.ptp(first, axis=0).max(initial=0.0))
    return bool(np.allclose(first, last, rtol=0.0, atol=within, equal_nan=True))


def _apart(first: np.ndarray | None, last: np.ndarray | None) -> float:
    """Distance between two results [m], at `SEEN_AT`; 0 where a garment has none."""
    if first is None or last is None:
        return 0.0
    return float(np.percentile(np.linalg.norm(last - first, axis=1), SEEN_AT))
