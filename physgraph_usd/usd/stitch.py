"""Joins chunks, which `refine --run-up` writes, into one layer, or into value clips where one file would be too large.

Each chunk begins a few frames early, and its record says where the cloth was in the last frame of that run-up. The
chunk before holds the same frame: the distance between the two is what the seam moves.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdUtils, Vt

from ..errors import LayerError, UsageError
from .atomic import prepare_target, publish, temporary_path
from .chunk import CHUNK, Chunk, read_chunk
from .files import LAYER_SUFFIXES, check_suffix, check_targets, files_of
from .hints import ATTRIBUTE as HINT
from .provenance import FAILED, UNSETTLED, asset_path, author_record, export_layer, read_record, recorded_shot
from .stage import is_there, pxr_errors
from .stream import LayerStream
from .times import within
from .validate import check_layer
from .view import StageView

SEAM_BOUND = 0.05
"""Largest difference at a seam, RMS over a garment, in mean fine edge lengths. `docs/farm.md` has what was measured."""
_OF_ONE_CHUNK = {"frames"}
"""Options in which chunks of one shot differ."""


@dataclass(frozen=True)
class Seam:
    """How far a garment moves between two chunks because they were solved apart.

    Attributes:
        before: Time code of the last frame before the seam, in which the two are compared.
        after: Time code of the first frame after it.
        path: The fine mesh.
        rms: Distance of its vertices, RMS, in mean fine edge lengths.
        largest: The largest distance, in the same unit.
    """

    before: float
    after: float
    path: str
    rms: float
    largest: float

    def __str__(self) -> str:
        """Place and distance in one line."""
        return f"seam at {self.after:g}: <{self.path}> moves {self.rms:.3g} fine edges RMS, {self.largest:.3g} at most"


@dataclass(frozen=True, eq=False)
class _Part:
    """A chunk's layer, opened."""

    file: Path
    layer: Sdf.Layer
    record: Mapping[str, Any]
    chunk: Chunk

    def span(self) -> str:
        """Its frames in words."""
        return _span(self.chunk.times)

    def garments(self) -> list[str]:
        """Paths of its fine meshes."""
        return [str(path) for path in self.record.get("garments", ())]


def stitch(
    chunks: Sequence[str | Path],
    out: str | Path,
    *,
    frames: tuple[float, float] | None = None,
    seam_bound: float = SEAM_BOUND,
    clips: bool = False,
    overwrite: bool = False,
) -> list[Seam]:
    """Join chunks of one shot into one layer.

    Args:
        chunks: Layers that `refine_shot` wrote with ``run_up``, in any order; a folder stands for all layers in it.
        out: Layer to write.
        frames: First and last time code that the layer must have; None for all of the shot.
        seam_bound: Largest difference at a seam, RMS over a garment, in mean fine edge lengths.
        clips: Leave the chunks where they are and make ``out`` a small layer that plays them as value clips. Beside it
            come ``<out>.topology.usdc`` with what does not move and ``<out>.manifest.usda``.
        overwrite: Whether existing files may be replaced.

    Returns:
        The seams, in order.

    Raises:
        UsageError: A frame is missing or doubled, chunks are not of one shot, version and set of options, or ``out`` is
            one of them.
        LayerError: A chunk cannot be read, a seam moves too far, or the layer cannot be written or is invalid.
    """
    out = Path(out)
    with pxr_errors("cannot read the chunks", LayerError):
        files = dict.fromkeys(file for named in chunks for file in _layers_in(Path(named)))
        parts = sorted(map(_open, files), key=lambda part: part.chunk.times)
        if not parts:
            raise UsageError(f"there are no chunks to stitch in {', '.join(map(str, chunks)) or 'no files'}")
        shot = _check_alike(parts)
        _check_frames(parts, frames)
        seams = [seam for pair in pairwise(parts) for seam in _seams(*pair)]
        _check_seams(parts, seams, seam_bound)
        inputs = {part.file for part in parts} | files_of(shot)
        check_targets([(f"the {what}", path) for what, path in _targets(out, clips=clips).items()], inputs)
        write = _write_clips if clips else _write_layer
        write(parts, shot, out, _record(parts, shot, out, frames=frames), overwrite=overwrite)
    return seams


def _targets(out: Path, *, clips: bool) -> dict[str, Path]:
    """Files to write, by what they are."""
    beside = {"topology": out.with_suffix(".topology.usdc"), "manifest": out.with_suffix(".manifest.usda")}
    return {"layer": out} | (beside if clips else {})


def _layers_in(place: Path) -> list[Path]:
    """The layers in a folder but those that are being written; a file is its own only one."""
    if not place.is_dir():
        return [place]
    return [file for file in sorted(place.iterdir()) if file.suffix in LAYER_SUFFIXES and ".tmp." not in file.name]


def _open(file: Path) -> _Part:
    """Open a chunk."""
    if not is_there(file):
        raise LayerError(f"{file} is not there")
    layer = Sdf.Layer.FindOrOpen(str(file))
    chunk, record = (read_chunk(layer), read_record(layer)) if layer else (None, None)
    if chunk is None or record is None:
        raise LayerError(f"{file} is no chunk of a shot; refine with --run-up writes one")
    return _Part(file, layer, record, chunk)


def _check_alike(parts: Sequence[_Part]) -> Path:
    """Refuse chunks of other shots, versions or options; returns the shot."""
    first = parts[0]
    shots = [recorded_shot(part.layer) for part in parts]
    for part, shot in zip(parts[1:], shots[1:], strict=True):
        names = _differences(_decisive(first), _decisive(part))
        if names:
            raise UsageError(f"{part.file} and {first.file} were made with other {', '.join(names)}; refine one anew")
        if shot != shots[0]:
            raise UsageError(f"{part.file} is of {shot}, {first.file} of {shots[0]}; stitch chunks of one shot")
    if shots[0] is None:
        raise LayerError(f"the record of {first.file} names no shot")
    return Path(shots[0])


def _decisive(part: _Part) -> dict[str, Any]:
    """What must be the same in all chunks, flat."""
    options = {name: value for name, value in dict(part.record["options"]).items() if name not in _OF_ONE_CHUNK}
    hashes = sorted((Path(name).name, str(value)) for name, value in dict(part.record["inputs"]).items())
    names = ("version", "mode")
    plain = {name: part.record.get(name) for name in names} | {
        "variant selections": list(part.record.get("variants", ())),
        "files of the shot": hashes,
        "frames of the shot": part.chunk.every,
    }
    return plain | {f"--{name.replace('_', '-')}": _comparable(value) for name, value in options.items()}


def _comparable(value: Any) -> Any:
    """An option's value, arrays as lists."""
    return list(value) if hasattr(value, "__len__") and not isinstance(value, str | dict) else value


def _differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    return sorted(name for name in {*one, *other} if one.get(name) != other.get(name))


def _check_frames(parts: Sequence[_Part], frames: tuple[float, float] | None) -> None:
    """Refuse frames that are missing, doubled, or not asked for."""
    owners: dict[float, list[Path]] = {}
    for part in parts:
        for time in part.chunk.times:
            owners.setdefault(time, []).append(part.file)
    doubled = [time for time, files in owners.items() if len(files) > 1]
    if doubled:
        files = sorted({str(file) for time in doubled for file in owners[time]})
        raise UsageError(f"frames {_span(doubled)} are in more than one chunk: {', '.join(files)}; leave one out")
    wanted = within(parts[0].chunk.every, frames)
    missing = [time for time in wanted if time not in owners]
    if missing:
        there = ", ".join(f"{part.file} ({part.span()})" for part in parts)
        raise UsageError(f"frames {_spans(missing, wanted)} are in no chunk; those there: {there}")
    outside = {part.file: part.span() for part in parts if not set(part.chunk.times) <= set(wanted)}
    for file, span in outside.items():
        raise UsageError(f"{file} holds the frames {span}, of which some lie outside --frames; leave it out")


def _span(times: Sequence[float]) -> str:
    """First and last of some time codes as ``--frames`` takes them."""
    return f"{min(times):g}:{max(times):g}" if times else "none"


def _spans(times: Sequence[float], every: Sequence[float]) -> str:
    """Time codes as ranges without a gap among all of them."""
    number = {time: index for index, time in enumerate(every)}
    runs: list[list[float]] = []
    for time in times:
        if runs and number[time] == number[runs[-1][-1]] + 1:
            runs[-1].append(time)
        else:
            runs.append([time])
    return ", ".join(map(_span, runs))


def _seams(before: _Part, after: _Part) -> Iterator[Seam]:
    """How far the run-up of a chunk ends from the chunk before it, for each garment that has a sample there."""
    time = after.chunk.before
    if time is None or not before.chunk.times or time != before.chunk.times[-1]:
        return
    for path, run_up in after.chunk.points.items():
        there = points_at(before.layer, path, time)
        if there is None or there.shape != run_up.shape:
            continue
        distances = np.linalg.norm(there.astype(np.float64) - run_up, axis=1) / mean_edge(after.layer, path, there)
        rms, largest = float(np.sqrt(np.mean(distances**2))), float(distances.max(initial=0.0))
        yield Seam(time, after.chunk.times[0], path, rms, largest)


def points_at(layer: Sdf.Layer, path: str, time: float) -> np.ndarray | None:
    """Points of a layer at one of its frames; between equal samples only the first and the last are written."""
    name = f"{path}.points"
    found, low, _ = layer.GetBracketingTimeSamplesForPath(name, time)
    value = layer.QueryTimeSample(name, low) if found else None
    return None if value is None or isinstance(value, Sdf.ValueBlock) else np.asarray(value)


def mean_edge(layer: Sdf.Layer, path: str, points: np.ndarray) -> float:
    """Mean length of the edges of a fine mesh's faces, in its own units."""
    counts, indices = (
        np.asarray(layer.GetAttributeAtPath(f"{path}.{name}").default)
        for name in ("faceVertexCounts", "faceVertexIndices")
    )
    ends = np.cumsum(counts)
    following = np.arange(1, len(indices) + 1)
    following[ends - 1] = ends - counts
    return float(np.linalg.norm(points[indices[following]].astype(np.float64) - points[indices], axis=1).mean())


def _check_seams(parts: Sequence[_Part], seams: Sequence[Seam], bound: float) -> None:
    """Refuse a seam that moves too far, or of which nothing is known though frames depend on one another."""
    worst = max(seams, key=lambda seam: seam.rms, default=None)
    if worst is not None and worst.rms > bound:
        remedy = "refine with a longer --run-up or with --temporal off, or allow more by --seam-bound"
        raise LayerError(f"{worst}; at most {bound:g} RMS is allowed: {remedy}")
    known = {seam.after for seam in seams}
    for part in parts[1:] if dict(parts[0].record["options"]).get("temporal") != "off" else ():
        if part.chunk.times[0] not in known and np.isfinite(bound):
            said = f"nothing tells how far the seam at {part.chunk.times[0]:g} moves"
            remedy = "refine it with --run-up 1 or more, or give --seam-bound inf"
            raise LayerError(f"{said}: {part.file} has no run-up that ended in the frame before it; {remedy}")


def _record(parts: Sequence[_Part], shot: Path, out: Path, *, frames: tuple[float, float] | None) -> dict[str, Any]:
    """The record of the joined layer: that of a run of all frames, and the chunks that it was joined from."""
    first = parts[0]
    record = {name: value for name, value in first.record.items() if name not in (CHUNK, FAILED, UNSETTLED)}
    absolute = Path(str(record["shot"])).is_absolute()
    folder = out.resolve().parent
    options = {name: _comparable(value) for name, value in dict(record["options"]).items() if name != "frames"}
    named = {first.layer.ComputeAbsolutePath(str(name)): value for name, value in dict(record["inputs"]).items()}
    left = [time for time in first.chunk.every if time not in within(first.chunk.every, frames)]
    garments = list(dict.fromkeys(path for part in parts for path in part.garments()))
    said = f"{len(left)} of the shot's {len(first.chunk.every)} frames"
    return record | {
        "options": options | ({"frames": list(frames)} if frames else {}),
        "shot": asset_path(shot, folder, absolute=absolute),
        "inputs": {asset_path(name, folder, absolute=absolute): value for name, value in named.items()},
        "garments": garments,
        "variants": list(record.get("variants", ())) or None,
        "left_out": dict.fromkeys(garments, said) if left else None,
        "chunks": [part.span() for part in parts],
        FAILED: [str(time) for part in parts for time in part.record.get(FAILED, ())] or None,
        UNSETTLED: sum(int(part.record.get(UNSETTLED, 0)) for part in parts) or None,
    }


def _write_layer(parts: Sequence[_Part], shot: Path, out: Path, record: Mapping[str, Any], *, overwrite: bool) -> None:
    """Join chunks into one file; each leaves memory when it is in."""
    with LayerStream(out, overwrite=overwrite) as stream:
        stream.layer.TransferContent(parts[0].layer)
        for part in parts:
            UsdUtils.StitchLayers(stream.layer, part.layer)
            _union_hints(stream.layer, part.layer)
            author_record(stream.layer, record)
            stream.flush()
        for path in record["garments"]:
            _author_velocities(stream, path, {t for part in parts for t in _ends(part.layer, f"{path}.velocities")})
        stream.flush()
        below = StageView.of_layer(Sdf.Layer.FindOrOpen(str(shot))) if is_there(shot) else None
        errors = [each for each in check_layer(stream.layer, below, samples=3) if each.severity == "error"]
        if errors:
            raise LayerError(f"the joined layer is invalid ({len(errors)} problems); first: {errors[0]}")
        stream.commit()


def _union_hints(layer: Sdf.Layer, other: Sdf.Layer) -> None:
    """Let the boxes of models in a layer hold those of another one too: each chunk grew them by its own frames."""
    paths: list[Sdf.Path] = []
    other.Traverse(Sdf.Path.absoluteRootPath, lambda path: paths.append(Sdf.Path(path)))
    for path in paths:
        if not path.IsPropertyPath() or path.name != HINT:
            continue
        for time in other.ListTimeSamplesForPath(path):
            layer.SetTimeSample(path, time, other.QueryTimeSample(path, time))
        ours, theirs = (np.asarray(each.GetAttributeAtPath(path).default) for each in (layer, other))
        if ours.shape == theirs.shape and ours.ndim == 2:
            grown = ours.copy()
            grown[0::2] = np.minimum(ours[0::2], theirs[0::2])
            grown[1::2] = np.maximum(ours[1::2], theirs[1::2])
            layer.GetAttributeAtPath(path).default = Vt.Vec3fArray.FromNumpy(grown)


def _author_velocities(stream: LayerStream, garment: str, times: Collection[float]) -> None:
    """Author velocities at the ends of chunks anew: a chunk knows nothing of the samples outside it.

    As in `track`, v(t_k) = (p(t_k+1) - p(t_k-1)) / (t_k+1 - t_k-1).
    """
    layer, points, velocities = stream.layer, Sdf.Path(f"{garment}.points"), Sdf.Path(f"{garment}.velocities")
    written = layer.ListTimeSamplesForPath(velocities)
    for time in sorted(times) if len(written) > 1 else ():
        k = written.index(time)
        a, b = written[max(k - 1, 0)], written[min(k + 1, len(written) - 1)]
        low, high = (np.asarray(layer.QueryTimeSample(points, at), np.float64) for at in (a, b))
        moved = (high - low) / ((b - a) / layer.timeCodesPerSecond)
        stream.set(velocities, Vt.Vec3fArray.FromNumpy(moved.astype(np.float32)), time=time)


def _write_clips(parts: Sequence[_Part], shot: Path, out: Path, record: Mapping[str, Any], *, overwrite: bool) -> None:
    """Write what does not move, the manifest, and a layer that plays the chunks over both."""
    targets = _targets(out, clips=True)
    for path in targets.values():
        check_suffix("the layer", path, LAYER_SUFFIXES)
        prepare_target(path, overwrite=overwrite)
    with _on_disk(targets["topology"]) as topology:
        UsdUtils.StitchClipsTopology(topology, [part.layer.identifier for part in parts])
        for part in parts:
            _union_hints(topology, part.layer)
        topology.customLayerData = {}
    root, manifest = _clip_root(parts, out, record["garments"], manifest=targets["manifest"].name)
    root.subLayerPaths.append(f"./{targets['topology'].name}")
    author_record(root, record)
    export_layer(manifest, targets["manifest"])
    export_layer(root, out)
    _check_clips(parts, shot, out)


@contextmanager
def _on_disk(target: Path) -> Iterator[Sdf.Layer]:
    """A new layer in a temporary file, since USD stitches no clips in memory; at the end it gets its final name."""
    temporary = temporary_path(target, suffix=target.suffix)
    try:
        layer = Sdf.Layer.CreateNew(str(temporary))
        yield layer
        layer.Save()
        del layer
        publish(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def _clip_root(
    parts: Sequence[_Part], out: Path, garments: Sequence[str], *, manifest: str
) -> tuple[Sdf.Layer, Sdf.Layer]:
    """The layer in memory that plays chunks as value clips, without sublayers yet, and its manifest.

    Each garment has its own clips, those of the chunks in which it has samples: where a clip holds nothing of an
    attribute, USD takes a default in place of the samples around it.
    """
    root, declared = Sdf.Layer.CreateAnonymous(".usda"), Sdf.Layer.CreateAnonymous(".usda")
    first = parts[0].layer.pseudoRoot
    for key in first.ListInfoKeys():
        if key not in ("customLayerData", "subLayers", "subLayerOffsets"):
            root.pseudoRoot.SetInfo(key, first.GetInfo(key))
    stage, folder = Usd.Stage.Open(root), out.resolve().parent
    for path in garments:
        held = [(part, ends) for part in parts if (ends := _ends(part.layer, f"{path}.points"))]
        if not held:
            continue
        layers = [part.layer for part, _ in held]
        UsdUtils.StitchLayers(declared, Usd.ClipsAPI.GenerateClipManifestFromLayers(layers, path))
        clips = Usd.ClipsAPI(stage.OverridePrim(path))
        clips.SetClipPrimPath(path)
        clips.SetClipAssetPaths([Sdf.AssetPath(asset_path(part.file, folder)) for part, _ in held])
        clips.SetClipManifestAssetPath(Sdf.AssetPath(f"./{manifest}"))
        clips.SetClipActive(Vt.Vec2dArray([(ends[0], index) for index, (_, ends) in enumerate(held)]))
        clips.SetClipTimes(Vt.Vec2dArray([(time, time) for time in (held[0][1][0], held[-1][1][1])]))
    return root, declared


def _check_clips(parts: Sequence[_Part], shot: Path, out: Path) -> None:
    """Refuse clips that do not show what the chunks hold, in the first and last frame of each: USD fails silently."""
    below = [str(shot)] if is_there(shot) else []
    root = Sdf.Layer.CreateAnonymous(".usda")
    root.timeCodesPerSecond = parts[0].layer.timeCodesPerSecond
    for identifier in (str(out.resolve()), *below):
        root.subLayerPaths.append(identifier)
    stage = Usd.Stage.Open(root)
    for part in parts:
        for path in part.garments():
            for time in _ends(part.layer, f"{path}.points"):
                shown = stage.GetAttributeAtPath(f"{path}.points").Get(time)
                held = part.layer.QueryTimeSample(f"{path}.points", time)
                if shown is None or not np.array_equal(np.asarray(shown), np.asarray(held)):
                    raise LayerError(f"{out} does not show <{path}> at time code {time:g} as {part.file} holds it")


def _ends(layer: Sdf.Layer, name: str) -> list[float]:
    """Times of an attribute's first and last sample in a layer."""
    times = layer.ListTimeSamplesForPath(name)
    return [times[0], times[-1]] if times else []
