"""Writes the frames of chunks into one layer, or into value clips where one file would be too large."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdUtils, Vt

from ...errors import LayerError
from ...interrupts import leave_if_asked
from ...solver.mesh.topology import PolygonMesh
from ...solver.mesh.weld import weld
from ..check.validate import check_layer
from ..files import LAYER_SUFFIXES, check_suffix
from ..provenance import (
    CROSSED,
    FAILED,
    LACKING,
    UNSETTLED,
    UNSOLVED,
    asset_path,
    author_record,
    export_layer,
)
from ..stage import is_there, paths_in
from ..times import within
from ..view import StageView
from .atomic import prepare_target, temporary_path
from .chunk import CHUNK, ChunkLayer, Frame, samples_and_blocks, topology_of
from .normals import VertexNormals
from .stream import LayerStream
from .track import ATTRIBUTE as HINT
from .track import HEAT, PREFIX, HeatTrack, PointTrack

_MOVING = ("points", "normals", "extent", "velocities", *(PREFIX + name for name in HEAT))
"""Properties of a fine mesh whose samples are written anew."""


@dataclass(frozen=True)
class _Clip:
    """A layer that is played from a time code on."""

    file: Path
    layer: Sdf.Layer
    begin: float = -inf


def targets_of(out: Path, *, clips: bool) -> dict[str, Path]:
    """Output files by role: layer, topology, manifest."""
    beside = {"topology": out.with_suffix(".topology.usdc"), "manifest": out.with_suffix(".manifest.usda")}
    return {"layer": out} | (beside if clips else {})


def joined_record(
    parts: Sequence[ChunkLayer], shot: Path, out: Path, *, frames: tuple[float, float] | None
) -> dict[str, Any]:
    """The record of a joined layer: that of a run of all frames, and the chunks that it was joined from.

    Args:
        parts: The chunks, in order.
        shot: The shot.
        out: The layer.
        frames: First and last time code that it has; None for all of the shot.
    """
    first, folder = parts[0], out.resolve().parent
    absolute = Path(str(first.record["shot"])).is_absolute()
    every = first.chunk.every
    inputs = {first.layer.ComputeAbsolutePath(str(name)): value for name, value in dict(first.record["inputs"]).items()}
    left = len(every) - len(within(every, frames))
    garments = list(dict.fromkeys(path for part in parts for path in part.garments))
    options = {name: value for name, value in first.options.items() if name != "frames"}
    counts = {name: sum(int(part.record.get(name, 0)) for part in parts) for name in (UNSOLVED, UNSETTLED, CROSSED)}
    return {name: value for name, value in first.record.items() if name not in (CHUNK, *LACKING)} | {
        "options": options | ({"frames": list(frames)} if frames else {}),
        "shot": asset_path(shot, folder, absolute=absolute),
        "inputs": {asset_path(name, folder, absolute=absolute): value for name, value in inputs.items()},
        "garments": garments,
        "variants": list(first.record.get("variants", ())) or None,
        "left_out": dict.fromkeys(garments, f"{left} of the shot's {len(every)} frames") if left else None,
        "chunks": [f"{min(part.chunk.times):g}:{max(part.chunk.times):g}" for part in parts],
        FAILED: [str(time) for part in parts for time in part.record.get(FAILED, ())] or None,
        **{name: count or None for name, count in counts.items()},
    }


def write_layer(
    parts: Sequence[ChunkLayer],
    frames: Iterable[Frame],
    out: Path,
    record: Mapping[str, Any],
    *,
    shot: Path,
    overwrite: bool,
) -> None:
    """Write all frames into one layer, which is validated.

    Args:
        parts: The chunks, in order.
        frames: Their frames, joined.
        out: The layer.
        record: Its record.
        shot: The shot, which need not be there.
        overwrite: Whether an existing file may be replaced.

    Raises:
        UsageError: The file exists and may not be replaced.
        LayerError: The layer cannot be written or is invalid.
    """
    with LayerStream(out, overwrite=overwrite) as stream:
        stream.layer.TransferContent(_still(parts, out))
        _write_frames(stream, parts, frames)
        author_record(stream.layer, record)
        stream.flush()
        below = StageView.of_layer(Sdf.Layer.FindOrOpen(str(shot))) if is_there(shot) else None
        errors = [each for each in check_layer(stream.layer, below, samples=3) if each.severity == "error"]
        if errors:
            raise LayerError(f"the joined layer is invalid ({len(errors)} problems); first: {errors[0]}")
        stream.commit()


def _still(parts: Sequence[ChunkLayer], out: Path) -> Sdf.Layer:
    """A layer in memory with everything in the chunks that the solver does not move."""
    still = Sdf.Layer.CreateAnonymous(".usdc")
    temporary = temporary_path(out.with_suffix(".topology"))  # USD stitches no clips in memory.
    try:
        on_disk = Sdf.Layer.CreateNew(str(temporary))
        UsdUtils.StitchClipsTopology(on_disk, [part.layer.identifier for part in parts])
        still.TransferContent(on_disk)
        del on_disk
    finally:
        temporary.unlink(missing_ok=True)
    still.customLayerData = {}
    for part in parts:
        moving = {f"{path}.{name}" for path in part.garments for name in _MOVING}
        for path in paths_in(part.layer):
            leave_if_asked()
            if path.IsPropertyPath() and str(path) not in moving:
                _add_samples(still, part.layer, path)
    return still


def _add_samples(still: Sdf.Layer, layer: Sdf.Layer, path: Sdf.Path) -> None:
    """Add the samples of a property that the solver does not move, such as an animated primvar.

    Boxes of models hold those of all chunks: each chunk grew them by its own frames.
    """
    hint = path.name == HINT
    for time in layer.ListTimeSamplesForPath(path):
        ours, value = (each.QueryTimeSample(path, time) for each in (still, layer))
        still.SetTimeSample(path, time, _union(ours, value) if hint else value)
    ours, value = (each.GetAttributeAtPath(path).default if hint else None for each in (still, layer))
    if ours is not None and value is not None:
        still.GetAttributeAtPath(path).default = _union(ours, value)


def _union(ours: Any, value: Any) -> Any:
    """Union of extents, box by box, shape (2 B, 3), lowest and highest corners in turn; the second if shapes differ."""
    one, other = np.asarray(ours), np.asarray(value)
    if ours is None or one.shape != other.shape or one.ndim != 2:
        return value
    grown = one.copy()
    grown[0::2] = np.minimum(one[0::2], other[0::2])
    grown[1::2] = np.maximum(one[1::2], other[1::2])
    return Vt.Vec3fArray.FromNumpy(grown)


def _write_frames(stream: LayerStream, parts: Sequence[ChunkLayer], frames: Iterable[Frame]) -> None:
    """Write samples by the tracks of `LayerWriter`; a garment without samples has its default alone."""
    tracks: dict[str, tuple[PointTrack, HeatTrack]] = {}
    for frame in frames:
        leave_if_asked()
        for path, points in frame.points.items():
            if path not in tracks:
                tracks[path] = _tracks(stream, parts, path)
            point_track, heat_track = tracks[path]
            point_track.write(frame.time, points, None, cut=path in frame.cuts)
            heat_track.write(frame.time, frame.heat[path])
    for point_track, heat_track in tracks.values():
        point_track.finish()
        heat_track.finish()


def _tracks(stream: LayerStream, parts: Sequence[ChunkLayer], path: str) -> tuple[PointTrack, HeatTrack]:
    """Tracks of a fine mesh, with defaults, velocities and normals as the chunks have them."""
    sampled = {part.layer: samples_and_blocks(part.layer, f"{path}.points") for part in parts}
    layers = [layer for layer, (times, _) in sampled.items() if times]
    absent = sorted(time for _, blocks in sampled.values() for time in blocks)
    normals = _normals(layers[0], path)
    rate = (
        layers[0].timeCodesPerSecond if any(each.GetAttributeAtPath(f"{path}.velocities") for each in layers) else None
    )
    rest = np.asarray(layers[0].GetAttributeAtPath(f"{path}.points").default)
    target = Sdf.Path(path)
    moves = {"rate": rate, "own": partial(_velocities, layers, path), "absent": absent}
    points = PointTrack(stream, target, normals, rest=rest, still=False, **moves)
    return points, HeatTrack(stream, target, normals.vertex_count, still=False)


def _velocities(layers: Sequence[Sdf.Layer], path: str, time: float | None) -> np.ndarray | None:
    """Velocities of a fine mesh that one of the layers has at a time code."""
    found = [] if time is None else [layer.QueryTimeSample(f"{path}.velocities", time) for layer in layers]
    return next((np.asarray(each) for each in found if isinstance(each, Vt.Vec3fArray)), None)


def _normals(layer: Sdf.Layer, path: str) -> VertexNormals:
    """Normals of a fine mesh, on the side on which the layer has them."""
    time = samples_and_blocks(layer, f"{path}.normals")[0][0]
    points, there = (np.asarray(layer.QueryTimeSample(f"{path}.{name}", time)) for name in ("points", "normals"))
    mesh = PolygonMesh(*topology_of(layer, path), len(points))
    welded = weld(mesh, [points], 0.0).sides
    found = VertexNormals(mesh, welded=welded)
    agrees = float((found(points) * there).sum()) >= 0
    return found if agrees else VertexNormals(mesh, left_handed=True, welded=welded)


def write_clips(
    parts: Sequence[ChunkLayer],
    frames: Iterable[Frame],
    begins: Mapping[Path, float],
    out: Path,
    record: Mapping[str, Any],
    *,
    shot: Path,
    overwrite: bool,
) -> None:
    """Write a layer that plays the chunks, the manifest, and a layer with the topology and the joined frames.

    Args:
        parts: The chunks, in order; they stay where they are.
        frames: The frames in which two chunks are joined, with those beside them.
        begins: Time code from which these are shown before a chunk, by the chunk's file.
        out: The layer.
        record: Its record.
        shot: The shot, which need not be there.
        overwrite: Whether existing files may be replaced.

    Raises:
        UsageError: A file exists and may not be replaced.
        LayerError: A file cannot be written, or USD does not show what the chunks hold.
    """
    targets = targets_of(out, clips=True)
    for path in targets.values():
        check_suffix("the layer", path, LAYER_SUFFIXES)
        prepare_target(path, overwrite=overwrite)
    with LayerStream(targets["topology"], overwrite=overwrite) as stream:
        stream.layer.TransferContent(_still(parts, out))
        _write_frames(stream, parts, frames)
        stream.commit()
    joined = Sdf.Layer.FindOrOpen(str(targets["topology"]))
    clips = []
    for part in parts:
        if part.file in begins:
            clips.append(_Clip(targets["topology"], joined, begins[part.file]))
        clips.append(_Clip(part.file, part.layer))
    root, manifest = _clip_root(clips, out, record["garments"], manifest=targets["manifest"].name)
    root.subLayerPaths.append(f"./{targets['topology'].name}")
    author_record(root, record)
    export_layer(manifest, targets["manifest"])
    export_layer(root, out)
    _check_clips(clips, record["garments"], shot, out)


def _shown(clips: Sequence[_Clip], path: str) -> list[tuple[_Clip, list[float]]]:
    """The clips that show a garment, with the time codes of their samples that are shown: up to the next clip's."""
    sampled = []
    for clip in clips:
        times = [time for time in clip.layer.ListTimeSamplesForPath(f"{path}.points") if time >= clip.begin]
        if times:
            sampled.append((clip, times))
    found, end = [], inf
    for clip, times in reversed(sampled):
        shown = [time for time in times if time < end]
        if shown:
            found.append((clip, shown))
            end = shown[0]
    return found[::-1]


def _clip_root(
    clips: Sequence[_Clip], out: Path, garments: Sequence[str], *, manifest: str
) -> tuple[Sdf.Layer, Sdf.Layer]:
    """The layer in memory that plays chunks as value clips, without sublayers yet, and its manifest.

    Each garment has its own clips, those in which it has samples: where a clip holds nothing of an attribute, USD takes
    a default in place of the samples around it.
    """
    root, declared = Sdf.Layer.CreateAnonymous(".usda"), Sdf.Layer.CreateAnonymous(".usda")
    first = clips[0].layer.pseudoRoot
    for key in first.ListInfoKeys():
        if key not in ("customLayerData", "subLayers", "subLayerOffsets"):
            root.pseudoRoot.SetInfo(key, first.GetInfo(key))
    stage, folder = Usd.Stage.Open(root), out.resolve().parent
    for path in garments:
        shown = _shown(clips, path)
        if not shown:
            continue
        layers = [clip.layer for clip, _ in shown]
        UsdUtils.StitchLayers(declared, Usd.ClipsAPI.GenerateClipManifestFromLayers(layers, path))
        played = Usd.ClipsAPI(stage.OverridePrim(path))
        played.SetClipPrimPath(path)
        played.SetClipAssetPaths([Sdf.AssetPath(asset_path(clip.file, folder)) for clip, _ in shown])
        played.SetClipManifestAssetPath(Sdf.AssetPath(f"./{manifest}"))
        played.SetClipActive(Vt.Vec2dArray([(times[0], index) for index, (_, times) in enumerate(shown)]))
        played.SetClipTimes(Vt.Vec2dArray([(time, time) for time in (shown[0][1][0], shown[-1][1][-1])]))
    return root, declared


def _check_clips(clips: Sequence[_Clip], garments: Sequence[str], shot: Path, out: Path) -> None:
    """Refuse clips of which USD does not show the first and last frame as their layers hold them: it fails silently."""
    root = Sdf.Layer.CreateAnonymous(".usda")
    root.timeCodesPerSecond = clips[0].layer.timeCodesPerSecond
    for identifier in (str(out.resolve()), *([str(shot)] if is_there(shot) else [])):
        root.subLayerPaths.append(identifier)
    stage = Usd.Stage.Open(root)
    for path in garments:
        name = f"{path}.points"
        for clip, times in _shown(clips, path):
            for time in (times[0], times[-1]):
                held = clip.layer.QueryTimeSample(name, time)
                if stage.GetAttributeAtPath(name).Get(time) != (None if isinstance(held, Sdf.ValueBlock) else held):
                    raise LayerError(f"{out} does not show <{path}> at time code {time:g} as {clip.file} holds it")
