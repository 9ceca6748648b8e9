"""Finds frames to which cloth jumps from the previous sample: no velocity is computed across a jump."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise, zip_longest
from typing import Any

import numpy as np

from ..errors import GarmentError
from ..solver.frame.settings import Reset
from ..solver.scene import SAME_TIME
from ..usd.read.reader import Shot

JUMP = Reset().move
"""Least deviation of a step from its neighbouring steps to count as a jump, RMS over a garment's points, in mean cage
edges. The solver treats cloth as a new pose from the same distance."""
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

    def __call__(self, records: Sequence[Mapping[str, Any]]) -> list[bool]:
        """For each garment, whether the cloth jumps to the last telemetry record, or was solved anew there."""
        before, now = (list(record.get("garments", ())) for record in ({}, *records)[-2:])
        return [
            records[-1]["time"] in jumps
            or _STARTED_ANEW in str(entry.get("start", ""))
            or "broken_before" in entry
            or any("collapsed" in each or "not_solved" in each for each in (earlier, entry))
            for jumps, earlier, entry in zip_longest(self._jumps, before[: len(now)], now, fillvalue={})
        ]


def jumps(opened: Shot, index: int) -> frozenset[float]:
    """Time codes to which a garment's cage, by number, jumps in its own space.

    A step between two poses at the same time is a jump. Others are compared with the previous and next step, so even
    motion is no jump at any speed. If a shot has only two steps, the larger step is the jump.
    """
    ends, lasted, lengths, away = _steps(_samples(opened, index))
    found = {end for end, time in zip(ends, lasted, strict=True) if time <= SAME_TIME}
    if len(ends) < 2:
        return frozenset(found)
    least = JUMP * _mean_edge(opened, index)
    for step, end in enumerate(ends):
        beside = [other for other in (step - 1, step + 1) if 0 <= other < len(ends)]
        departs = lasted[step] * min(away[min(step, other)] for other in beside) > least
        if departs and (len(beside) > 1 or lengths[step] > lengths[beside[0]]):
            found.add(end)
    return frozenset(found)


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
