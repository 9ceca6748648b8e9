"""A part of a shot's frames as a layer of its own, a chunk, and what its record says so that `stitch` can join it.

A chunk opens the whole shot, so that what all frames decide is the same in every chunk, and writes some of its frames.
Those that it solves before them, the pre-roll, are no samples; where the cloth was in them stays in the record, for
`stitch` to go over from the chunk before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pxr import Sdf

from ...errors import StageError
from ..provenance import read_record
from ..times import within

CHUNK = "chunk"
"""The chunk's entry of a layer's record."""
_TIMES, _ALL, _PREROLL = "frames", "all_frames", "preroll"


@dataclass(frozen=True, eq=False)
class Chunk:
    """Which of a shot's frames a layer holds.

    Attributes:
        times: Time codes that it has, or failed to solve.
        every: Time codes of the whole shot, in order.
        preroll: Where the cloth was in the frames before them: by time code, local points by the path of the fine mesh,
            shape (V, 3), float32.
    """

    times: tuple[float, ...]
    every: tuple[float, ...]
    preroll: Mapping[float, Mapping[str, np.ndarray]] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """The entry for the layer's record."""
        return {
            _TIMES: list(self.times),
            _ALL: list(self.every),
            _PREROLL: {repr(time): dict(points) for time, points in self.preroll.items()} or None,
        }


def chunk_of(every: Sequence[float], frames: tuple[float, float] | None) -> Chunk:
    """The frames of a shot that lie in a range.

    Args:
        every: Time codes of the whole shot, in order.
        frames: First and last time code; None for all.

    Raises:
        StageError: None lies there.
    """
    times = within(every, frames)
    if not times and frames is not None:
        said = "no sample of the shot lies in frames {:g}:{:g}".format(*frames)
        ends = f"; its {len(every)} samples run from {every[0]:g} to {every[-1]:g}" if every else ""
        raise StageError(said + ends)
    return Chunk(times, tuple(every))


def read_chunk(layer: Sdf.Layer) -> Chunk | None:
    """What a layer's record says of it as a chunk; None where it is none."""
    told = (read_record(layer) or {}).get(CHUNK)
    if not isinstance(told, Mapping):
        return None
    try:
        preroll = {
            float(time): {str(path): np.asarray(value) for path, value in dict(points).items()}
            for time, points in dict(told.get(_PREROLL, {})).items()
        }
        times, every = (tuple(float(time) for time in told.get(name, ())) for name in (_TIMES, _ALL))
    except (TypeError, ValueError):  # Somebody else wrote it.
        return None
    return Chunk(times, every, preroll)
