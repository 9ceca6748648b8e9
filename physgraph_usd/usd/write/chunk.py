"""Chunks: parts of a shot's frames as layers of their own, which `stitch` joins.

A chunk opens the whole shot, so that what all frames decide is the same in every chunk, and writes some of its frames.
Those that it solves before them, the pre-roll, are no samples; where the cloth was in them stays in the record, for
`stitch` to go over from the chunk before.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf

from ...errors import AbsentError, LayerError
from ..provenance import FAILED, read_record
from ..stage import check_there
from ..times import within
from .track import HEAT, PREFIX, refuse_not_finite

CHUNK = "chunk"
"""The chunk's entry of a layer's record."""
_TIMES, _ALL, _PREROLL, _CUTS = "frames", "all_frames", "preroll", "cuts"

Points = Mapping[str, np.ndarray]
"""Local points by the path of the fine mesh, each of shape (V, 3), float32."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """Which of a shot's frames a layer holds.

    Attributes:
        times: Time codes that it has, or failed to solve.
        every: Time codes of the whole shot, in order.
        preroll: Where the cloth was in the frames before them, by time code.
        cuts: Time codes to which the cloth jumps from the sample before, by the path of the fine mesh.
    """

    times: tuple[float, ...]
    every: tuple[float, ...]
    preroll: Mapping[float, Points] = field(default_factory=dict)
    cuts: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def holds(self, others: Iterable[float]) -> tuple[float, ...]:
        """Those of other time codes of the shot that follow one of the chunk's, or come before the shot's first."""
        return tuple(time for time in others if self.every[max(bisect(self.every, time) - 1, 0)] in self.times)

    def record(self) -> dict[str, Any]:
        """The entry for the layer's record."""
        return {
            _TIMES: list(self.times),
            _ALL: list(self.every),
            _PREROLL: {repr(time): dict(points) for time, points in self.preroll.items()} or None,
            _CUTS: {path: list(times) for path, times in self.cuts.items() if times} or None,
        }


@dataclass(frozen=True, eq=False)
class Frame:
    """Samples of one time code.

    Attributes:
        time: The time code.
        points: Positions of the garments that have a sample there.
        heat: Their heat maps by name, each of shape (V,), by the path of the fine mesh.
        cuts: Paths of the fine meshes whose cloth jumps here from the sample before.
    """

    time: float
    points: Points
    heat: Mapping[str, Mapping[str, np.ndarray]]
    cuts: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class ChunkLayer:
    """A chunk's layer, opened.

    Attributes:
        file: Where it is.
        layer: It.
        record: Its record.
        chunk: Which frames it holds.
    """

    file: Path
    layer: Sdf.Layer
    record: Mapping[str, Any]
    chunk: Chunk

    @cached_property
    def garments(self) -> list[str]:
        """Paths of its fine meshes."""
        return [str(path) for path in self.record.get("garments", ())]

    @cached_property
    def options(self) -> dict[str, Any]:
        """Options that it was made with, arrays as lists."""
        return {
            name: list(value) if hasattr(value, "__len__") and not isinstance(value, str | dict) else value
            for name, value in dict(self.record["options"]).items()
        }

    def has(self, time: float) -> bool:
        """Whether a frame is one of its own and did not fail."""
        failed = {float(each) for each in self.record.get(FAILED, ())}
        return time in self.chunk.times and time not in failed

    def frame(self, time: float, *, repeated: bool = False) -> Frame:
        """The garments that have a sample at a time code.

        Args:
            time: The time code.
            repeated: Also those whose sample there was left out because it equals the ones beside it.
        """
        points, heat = {}, {}
        for path in self.garments:
            names = [f"{path}.points", *(f"{path}.{PREFIX}{name}" for name in HEAT)]
            if not repeated and not any(time in self._sampled[name] for name in names):
                continue
            found = points_at(self.layer, path, time)
            if found is not None:
                self._check(path, time, found)
                maps = ((name, _latest(self.layer, f"{path}.{PREFIX}{name}", time)) for name in HEAT)
                points[path], heat[path] = found, {name: values for name, values in maps if values is not None}
        return Frame(time, points, heat, frozenset(path for path, cuts in self.chunk.cuts.items() if time in cuts))

    def check_preroll(self) -> None:
        """Refuse (LayerError) a pre-roll that does not fit its meshes, or is not finite."""
        for time, found in self.chunk.preroll.items():
            for path in found.keys() & set(self.garments):
                self._check(path, time, found[path])

    def _check(self, path: str, time: float, points: np.ndarray) -> None:
        """Refuse (LayerError) points that do not fit the mesh, or are not finite, before a kernel sees them."""
        place = f"{self.file}: <{path}> at time code {time:g}: points"
        count = vertex_count(self.layer, path)
        if points.shape != (count, 3):
            raise LayerError(f"{place} have shape {points.shape}; the mesh has {count} vertices")
        refuse_not_finite(points, place)

    @cached_property
    def _sampled(self) -> dict[str, frozenset[float]]:
        """Time codes of the samples of points and heat maps, by property."""
        names = [f"{path}.{name}" for path in self.garments for name in ("points", *(PREFIX + each for each in HEAT))]
        return {name: frozenset(self.layer.ListTimeSamplesForPath(name)) for name in names}


def open_chunk(file: Path) -> ChunkLayer:
    """Open a chunk.

    Raises:
        StageError: The file is not there.
        LayerError: It is no chunk.
    """
    check_there(file)
    layer = Sdf.Layer.FindOrOpen(str(file))
    chunk, record = (read_chunk(layer), read_record(layer)) if layer else (None, None)
    if chunk is None or record is None:
        raise LayerError(f"{file} is no chunk of a shot; refine with --preroll writes one")
    return ChunkLayer(file, layer, record, chunk)


def chunk_of(every: Sequence[float], frames: tuple[float, float] | None) -> Chunk:
    """The frames of a shot that lie in a range.

    Args:
        every: Time codes of the whole shot, in order.
        frames: First and last time code; None for all.

    Raises:
        AbsentError: None lies there.
    """
    times = within(every, frames)
    if not times and frames is not None:
        message = "no sample of the shot lies in frames {:g}:{:g}".format(*frames)
        ends = f"; its {len(every)} samples run from {every[0]:g} to {every[-1]:g}" if every else ""
        raise AbsentError(message + ends)
    return Chunk(times, tuple(every))


def read_chunk(layer: Sdf.Layer) -> Chunk | None:
    """A layer's record of itself as a chunk; None where it is none."""
    entry = (read_record(layer) or {}).get(CHUNK)
    if not isinstance(entry, Mapping):
        return None
    try:
        preroll = {
            float(time): {str(path): np.asarray(value) for path, value in dict(points).items()}
            for time, points in dict(entry.get(_PREROLL, {})).items()
        }
        times, every = (tuple(float(time) for time in entry.get(name, ())) for name in (_TIMES, _ALL))
        cuts = {str(path): tuple(map(float, found)) for path, found in dict(entry.get(_CUTS, {})).items()}
    except (TypeError, ValueError):  # Somebody else wrote it.
        return None
    return Chunk(times, every, preroll, cuts)


def points_at(layer: Sdf.Layer, path: str, time: float) -> np.ndarray | None:
    """Points of a fine mesh in a frame, shape (V, 3); None where it has none.

    A layer without velocities has only the first and the last of a run of equal samples.
    """
    name = f"{path}.points"
    found, low, high = layer.GetBracketingTimeSamplesForPath(name, time)
    if not found or (low != time and (low == high or layer.GetAttributeAtPath(f"{path}.velocities"))):
        return None
    value, after = (layer.QueryTimeSample(name, each) for each in (low, high))
    if isinstance(value, Sdf.ValueBlock) or (low != time and value != after):
        return None
    return np.asarray(value)


def samples_and_blocks(layer: Sdf.Layer, name: str) -> tuple[list[float], list[float]]:
    """Time codes at which a layer has values of an attribute, and those at which it has blocks."""
    every = layer.ListTimeSamplesForPath(name)
    blocks = [time for time in every if isinstance(layer.QueryTimeSample(name, time), Sdf.ValueBlock)]
    return [time for time in every if time not in blocks], blocks


def _latest(layer: Sdf.Layer, name: str, time: float) -> np.ndarray | None:
    """An attribute's sample at a time code, or the last before it."""
    found, low, _ = layer.GetBracketingTimeSamplesForPath(name, time)
    return np.asarray(layer.QueryTimeSample(name, low)) if found else None


def mean_edge(layer: Sdf.Layer, path: str, points: np.ndarray) -> float:
    """Mean length of the edges of a fine mesh's faces, in its own units."""
    counts, indices = topology_of(layer, path)
    ends = np.cumsum(counts)
    following = np.arange(1, len(indices) + 1)
    following[ends - 1] = ends - counts
    return float(np.linalg.norm(points[indices[following]].astype(np.float64) - points[indices], axis=1).mean())


def topology_of(layer: Sdf.Layer, path: str) -> tuple[np.ndarray, np.ndarray]:
    """Corners per face, shape (F,), and vertices of the corners, shape (C,), of a fine mesh."""
    names = ("faceVertexCounts", "faceVertexIndices")
    counts, indices = (np.asarray(layer.GetAttributeAtPath(f"{path}.{name}").default) for name in names)
    return counts, indices


def vertex_count(layer: Sdf.Layer, path: str) -> int:
    """Number of a fine mesh's vertices."""
    name = f"{path}.points"
    times, _ = samples_and_blocks(layer, name)
    return len(layer.QueryTimeSample(name, times[0]) if times else layer.GetAttributeAtPath(name).default)
