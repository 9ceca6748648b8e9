"""Joins chunks, which `refine --preroll` writes, into one layer, or into value clips where one file would be too large.

Each chunk begins a few frames early, and its record says where the cloth was in these. The chunk before holds the same
frames: over them the cloth goes from one to the other.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdUtils, Vt

from ...errors import LayerError, UsageError
from ...solver.mesh.topology import PolygonMesh
from ..check.validate import check_layer
from ..files import LAYER_SUFFIXES, check_suffix, check_targets, files_of
from ..provenance import (
    CROSSED,
    FAILED,
    LACKING,
    UNSETTLED,
    UNSOLVED,
    asset_path,
    author_record,
    export_layer,
    read_record,
    recorded_shot,
    write_root,
)
from ..stage import check_there, is_there, pxr_errors, quiet
from ..times import within
from ..view import StageView
from .atomic import prepare_target, publish, temporary_path
from .chunk import CHUNK, Chunk, read_chunk
from .normals import VertexNormals
from .seams import Look, Points, Seam, between
from .stream import LayerStream
from .track import ATTRIBUTE as HINT
from .track import extent_of

SEAM_BOUND = 0.05
"""Most that a seam may add to a frame's move, RMS over a garment, in mean fine edges; `docs/farm.md` has figures."""
LookWith = Callable[[Path, Mapping[str, Any], Mapping[str, int]], Look | None]
"""Makes what looks at joined frames, of the shot, the options it was refined with, and vertex counts by fine mesh."""
_OF_ONE_CHUNK = {"frames"}
"""Options in which chunks of one shot differ."""


@dataclass(frozen=True, eq=False)
class _Part:
    """A chunk's layer, opened."""

    file: Path
    layer: Sdf.Layer
    record: Mapping[str, Any]
    chunk: Chunk

    def has(self, time: float) -> bool:
        """Whether a frame is one of its own and did not fail."""
        failed = {float(each) for each in self.record.get(FAILED, ())}
        return time in self.chunk.times and time not in failed

    def span(self) -> str:
        """Its frames in words."""
        return _span(self.chunk.times)

    def garments(self) -> list[str]:
        """Paths of its fine meshes."""
        return [str(path) for path in self.record.get("garments", ())]


@dataclass(frozen=True, eq=False)
class _Joint:
    """Two chunks that follow one another.

    Attributes:
        seams: How far each garment moves.
        points: By time code, the joined positions; those of a frame that both have and in which they differ.
    """

    before: _Part
    after: _Part
    seams: list[Seam]
    points: dict[float, dict[str, np.ndarray]] = field(default_factory=dict)


def stitch(
    chunks: Sequence[str | Path],
    out: str | Path,
    *,
    frames: tuple[float, float] | None = None,
    seam_bound: float = SEAM_BOUND,
    clips: bool = False,
    root: str | Path | None = None,
    overwrite: bool = False,
    look_with: LookWith | None = None,
) -> list[Seam]:
    """Join chunks of one shot into one layer.

    Args:
        chunks: Layers that `refine_shot` wrote with ``preroll``, in any order; a folder stands for all layers in it.
        out: Layer to write.
        frames: First and last time code that the layer must have; None for all of the shot.
        seam_bound: Most that a seam may add to a frame's move, RMS over a garment, in mean fine edge lengths.
        clips: Leave the chunks where they are and make ``out`` a small layer that plays them as value clips. Beside it
            come ``<out>.topology.usdc`` with what does not move, ``<out>.manifest.usda``, and ``<out>.seam<time>.usdc``
            with the frames in which two chunks are joined.
        root: A small root layer to write, with the layer over the shot.
        overwrite: Whether existing files may be replaced.
        look_with: Makes what looks at joined frames, which else are taken as they are.

    Returns:
        The seams, in order.

    Raises:
        UsageError: A frame is missing or doubled, chunks are not of one shot, version and set of options, or ``out`` is
            one of them.
        LayerError: A chunk cannot be read, a seam moves too far, or the layer cannot be written or is invalid.
    """
    out = Path(out)
    with pxr_errors("cannot read the chunks", LayerError), quiet():
        parts = _parts(chunks)
        shot = _check_alike(parts)
        _check_frames(parts, frames)
        inputs = {part.file for part in parts} | files_of(shot)
        targets = _targets(parts, out, clips=clips) | ({} if root is None else {"root": Path(root)})
        check_targets([(f"the {what}", path) for what, path in targets.items()], inputs)
        if root is not None:
            prepare_target(Path(root), overwrite=overwrite)
        joints = _joints(list(pairwise(parts)), shot, look_with)
        seams = [seam for joint in joints for seam in joint.seams]
        _check_seams(parts, seams, seam_bound)
        write = _write_clips if clips else _write_layer
        write(parts, joints, shot, out, _record(parts, shot, out, frames=frames), overwrite=overwrite)
        if root is not None:
            absolute = Path(str(parts[0].record["shot"])).is_absolute()
            write_root(Path(root), layer=out, shot=shot, absolute=absolute, overwrite=overwrite)
    return seams


def check_seams(
    chunks: Sequence[str | Path],
    *,
    of: Path | None = None,
    seam_bound: float = SEAM_BOUND,
    look_with: LookWith | None = None,
) -> list[Seam]:
    """Look at the seams of chunks that follow one another, and write nothing: others may still be missing.

    Args:
        chunks: As for `stitch`.
        of: One of them, to look at its own seams alone; what else is in its folder need not be of the shot.
        seam_bound: As for `stitch`.
        look_with: As for `stitch`.

    Returns:
        The seams, in order.

    Raises:
        UsageError: Chunks are not of one shot, version and set of options.
        LayerError: A chunk cannot be read, or a seam moves too far.
    """
    with pxr_errors("cannot read the chunks", LayerError), quiet():
        parts = _parts(chunks, strict=of is None)
        if of is not None:
            parts = [part for part in parts if recorded_shot(part.layer) == recorded_shot(_open(of).layer)]
        pairs = [pair for pair in pairwise(parts) if _follow(*pair) and (of is None or of in [x.file for x in pair])]
        seams = []
        for pair in pairs:
            joints = _joints([pair], _check_alike(pair), look_with)
            own = [seam for joint in joints for seam in joint.seams]
            _check_seams(pair, own, seam_bound)
            seams += own
    return seams


def _follow(before: _Part, after: _Part) -> bool:
    """Whether no frame of the shot lies between two chunks."""
    every = after.chunk.every
    return before.chunk.times[-1:] == every[: every.index(after.chunk.times[0])][-1:]


def _parts(chunks: Sequence[str | Path], *, strict: bool = True) -> list[_Part]:
    """The chunks by their frames; what is none is refused, or left out."""
    files = dict.fromkeys(file for named in chunks for file in _layers_in(Path(named)))
    parts = []
    for file in files:
        try:
            parts.append(_open(file))
        except LayerError:
            if strict:
                raise
    if not parts:
        raise UsageError(f"there are no chunks to stitch in {', '.join(map(str, chunks)) or 'no files'}")
    return sorted(parts, key=lambda part: part.chunk.times)


def _targets(parts: Sequence[_Part], out: Path, *, clips: bool) -> dict[str, Path]:
    """Files that may be written, by what they are."""
    beside = {"topology": out.with_suffix(".topology.usdc"), "manifest": out.with_suffix(".manifest.usda")}
    seams = {f"seam at {part.chunk.times[0]:g}": _seam_file(out, part) for part in parts[1:]}
    return {"layer": out} | (beside | seams if clips else {})


def _seam_file(out: Path, after: _Part) -> Path:
    """The clip with the joined frames before a chunk."""
    return out.with_suffix(f".seam{after.chunk.times[0]:g}.usdc")


def _layers_in(place: Path) -> list[Path]:
    """The layers in a folder but those that are being written; a file is its own only one."""
    if not place.is_dir():
        return [place]
    return [file for file in sorted(place.iterdir()) if file.suffix in LAYER_SUFFIXES and ".tmp." not in file.name]


def _open(file: Path) -> _Part:
    """Open a chunk."""
    check_there(file)
    layer = Sdf.Layer.FindOrOpen(str(file))
    chunk, record = (read_chunk(layer), read_record(layer)) if layer else (None, None)
    if chunk is None or record is None:
        raise LayerError(f"{file} is no chunk of a shot; refine with --preroll writes one")
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
    names = ("version", "code", "mode")
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


def _joints(pairs: Sequence[tuple[_Part, _Part]], shot: Path, look_with: LookWith | None) -> list[_Joint]:
    """Join each two chunks that follow one another."""
    look: Look | None = None
    joints = []
    for before, after in pairs:
        both = _both(before, after)
        if look is None and look_with is not None and both:
            meshes = {
                path: points_count(part.layer, path) for pair in pairs for part in pair for path in part.garments()
            }
            look = look_with(shot, _options(before), meshes)
        joints.append(_joint(before, after, both, look))
    return joints


def _options(part: _Part) -> dict[str, Any]:
    """The options that a chunk was made with, plain."""
    return {name: _comparable(value) for name, value in dict(part.record["options"]).items()}


def _both(before: _Part, after: _Part) -> list[float]:
    """Time codes without a gap, up to the seam, that the pre-roll of a chunk and the chunk before it have."""
    every = after.chunk.every
    first = last = every.index(after.chunk.times[0])
    while first > 0 and every[first - 1] in after.chunk.preroll and before.has(every[first - 1]):
        first -= 1
    return list(every[first:last])


def _joint(before: _Part, after: _Part, both: Sequence[float], look: Look | None) -> _Joint:
    """Go over from one chunk to the next in the frames that both have; at once where that would newly cross."""
    points: dict[float, dict[str, np.ndarray]] = {}
    jumps: dict[str, tuple[float, float]] = {}
    moves: dict[str, list[tuple[float, float]]] = {}
    lag: dict[str, np.ndarray] = {}
    why = ""
    for number, time in enumerate(both, start=1):
        ours, theirs = _sides(before, after.chunk.preroll[time], time)
        weight = number / (len(both) + 1)
        made = {path: between(own, theirs[path], weight).astype(np.float32) for path, own in ours.items()}
        given: Points = made
        if not why and look is not None and any(not np.array_equal(own, theirs[path]) for path, own in ours.items()):
            given, why = look(time, *((ours, theirs) if weight < 0.5 else (theirs, ours)), made)
        for path, own in ours.items():
            edge, part = mean_edge(after.layer, path, own), (theirs[path].astype(np.float64) - own) / (len(both) + 1)
            late = given[path].astype(np.float64) - made[path]
            jumps[path] = _size(theirs[path].astype(np.float64) - own, edge)
            moves.setdefault(path, []).append(_size(part + late - lag.get(path, 0.0), edge))
            lag[path] = late
            if time == both[-1]:
                moves[path].append(_size(part - late, edge))
        if any(move[-1][0] for move in moves.values()):
            points[time] = dict(given)
    seams = []
    for path, jump in jumps.items():
        rms, largest = jump if why else tuple(map(float, np.max(moves[path], axis=0)))
        seams.append(Seam(after.chunk.times[0], path, rms, largest, 0 if why else len(both), why))
    return _Joint(before, after, seams, {} if why else points)


def _sides(before: _Part, preroll: Points, time: float) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Positions in a frame that two chunks have, of the garments that both have there."""
    found = {path: points_at(before.layer, path, time) for path in preroll}
    ours = {path: each for path, each in found.items() if each is not None and each.shape == preroll[path].shape}
    return ours, {path: preroll[path] for path in ours}


def _size(moves: np.ndarray, edge: float) -> tuple[float, float]:
    """Of moves of vertices, shape (V, 3), RMS and at most, in edges."""
    distances = np.linalg.norm(moves, axis=1) / edge
    return float(np.sqrt(np.mean(distances**2))), float(distances.max(initial=0.0))


def points_count(layer: Sdf.Layer, path: str) -> int:
    """Number of a fine mesh's vertices."""
    times = layer.ListTimeSamplesForPath(f"{path}.points")
    value = (
        layer.QueryTimeSample(f"{path}.points", times[0])
        if times
        else layer.GetAttributeAtPath(f"{path}.points").default
    )
    return len(value)


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
        longer = ceil(worst.rms * (worst.frames + 1) / bound) if bound > 0 else 0
        longer = f"--preroll {longer}" if longer else "a longer --preroll"
        remedy = f"refine with {longer} or with --temporal off, or allow more by --seam-bound"
        raise LayerError(f"{worst}; at most {bound:g} RMS is allowed: {remedy}")
    known = {seam.after for seam in seams}
    for part in parts[1:] if dict(parts[0].record["options"]).get("temporal") != "off" else ():
        if part.chunk.times[0] not in known and np.isfinite(bound):
            said = f"nothing tells how far the seam at {part.chunk.times[0]:g} moves"
            remedy = "refine it with --preroll 1 or more, or give --seam-bound inf"
            raise LayerError(f"{said}: {part.file} has no pre-roll that ended in the frame before it; {remedy}")


def _record(parts: Sequence[_Part], shot: Path, out: Path, *, frames: tuple[float, float] | None) -> dict[str, Any]:
    """The record of the joined layer: that of a run of all frames, and the chunks that it was joined from."""
    first = parts[0]
    record = {name: value for name, value in first.record.items() if name not in (CHUNK, *LACKING)}
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
        **{
            name: sum(int(part.record.get(name, 0)) for part in parts) or None
            for name in (UNSOLVED, UNSETTLED, CROSSED)
        },
    }


def _write_layer(
    parts: Sequence[_Part],
    joints: Sequence[_Joint],
    shot: Path,
    out: Path,
    record: Mapping[str, Any],
    *,
    overwrite: bool,
) -> None:
    """Join chunks into one file; each leaves memory when it is in."""
    with LayerStream(out, overwrite=overwrite) as stream:
        stream.layer.TransferContent(parts[0].layer)
        for part in parts:
            UsdUtils.StitchLayers(stream.layer, part.layer)
            _union_hints(stream.layer, part.layer)
            author_record(stream.layer, record)
            stream.flush()
        for layer in map(_joined_layer, joints):
            for name in _animated(layer):
                for time in layer.ListTimeSamplesForPath(name):
                    stream.set(Sdf.Path(name), layer.QueryTimeSample(name, time), time=time)
        for path in record["garments"]:
            ends = {t for part in parts for t in _ends(part.layer, f"{path}.velocities")}
            near = {t for joint in joints for t in (*joint.points, *_beside(joint))}
            _author_velocities(
                stream, path, ends | near.intersection(stream.layer.ListTimeSamplesForPath(f"{path}.velocities"))
            )
        stream.flush()
        below = StageView.of_layer(Sdf.Layer.FindOrOpen(str(shot))) if is_there(shot) else None
        errors = [each for each in check_layer(stream.layer, below, samples=3) if each.severity == "error"]
        if errors:
            raise LayerError(f"the joined layer is invalid ({len(errors)} problems); first: {errors[0]}")
        stream.commit()


def _beside(joint: _Joint) -> list[float]:
    """The frame before the first that is joined, and the first after the seam."""
    every = joint.after.chunk.every
    first = every.index(min(joint.points, default=joint.after.chunk.times[0]))
    return [*every[max(first - 1, 0) : first], joint.after.chunk.times[0]]


def _joined_layer(joint: _Joint) -> Sdf.Layer:
    """The samples of the frames in which two chunks are joined, and before them the end of a run of equal ones.

    What is no position stays as the chunk before has it.
    """
    out, before = Sdf.Layer.CreateAnonymous(".usdc"), joint.before.layer
    out.timeCodesPerSecond = before.timeCodesPerSecond
    paths = dict.fromkeys(path for points in joint.points.values() for path in points)
    for path in paths:
        normals = _normals(before, path)
        joined = {time: points[path] for time, points in joint.points.items() if path in points}
        held = _held(before, path, _beside(joint)[0])
        if held is not None:
            joined |= {_beside(joint)[0]: held}
        Sdf.CreatePrimInLayer(out, path)
        for name in _animated(before):
            if Sdf.Path(name).GetPrimPath() == Sdf.Path(path):
                spec = before.GetAttributeAtPath(name)
                Sdf.AttributeSpec(out.GetPrimAtPath(path), Sdf.Path(name).name, spec.typeName, spec.variability)
        for time, points in joined.items():
            values = {"points": points, "normals": normals(points), "extent": extent_of(points)}
            for spec in out.GetPrimAtPath(path).attributes:
                own = values.get(spec.name)
                given = _value_at(before, str(spec.path), time) if own is None else Vt.Vec3fArray.FromNumpy(own)
                if given is not None:
                    out.SetTimeSample(spec.path, time, given)
        _velocities_between(out, joint, path)
    return out


def _velocities_between(out: Sdf.Layer, joint: _Joint, path: str) -> None:
    """Velocities of joined frames, from the samples beside each, as `track` has them."""
    name = f"{path}.velocities"
    if not out.GetAttributeAtPath(name):
        return
    shown: dict[float, Sdf.Layer] = {}
    for layer in (joint.before.layer, joint.after.layer, out):
        shown |= dict.fromkeys(layer.ListTimeSamplesForPath(f"{path}.points"), layer)
    times = sorted(shown)
    for time in out.ListTimeSamplesForPath(name):
        k = times.index(time)
        a, b = times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)]
        low, high = (np.asarray(shown[at].QueryTimeSample(f"{path}.points", at), np.float64) for at in (a, b))
        moved = (high - low) / ((b - a) / out.timeCodesPerSecond)
        out.SetTimeSample(name, time, Vt.Vec3fArray.FromNumpy(moved.astype(np.float32)))


def _normals(layer: Sdf.Layer, path: str) -> VertexNormals:
    """What computes a fine mesh's normals, on the side on which the layer has them."""
    names = ("faceVertexCounts", "faceVertexIndices")
    counts, indices = (np.asarray(layer.GetAttributeAtPath(f"{path}.{name}").default) for name in names)
    mesh = PolygonMesh(counts, indices, points_count(layer, path))
    time = layer.ListTimeSamplesForPath(f"{path}.normals")[0]
    points, there = (np.asarray(layer.QueryTimeSample(f"{path}.{name}", time)) for name in ("points", "normals"))
    found = VertexNormals(mesh)
    return found if float((found(points) * there).sum()) >= 0 else VertexNormals(mesh, left_handed=True)


def _animated(layer: Sdf.Layer) -> list[str]:
    """Paths of the attributes with samples."""
    found: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, lambda path: found.append(Sdf.Path(path)))
    return [str(path) for path in found if path.IsPropertyPath() and layer.GetNumTimeSamplesForPath(path)]


def _value_at(layer: Sdf.Layer, name: str, time: float) -> Any:
    """A layer's sample at a time code, or the last before it."""
    found, low, _ = layer.GetBracketingTimeSamplesForPath(name, time)
    return layer.QueryTimeSample(name, low) if found else None


def _held(layer: Sdf.Layer, path: str, time: float) -> np.ndarray | None:
    """The points before joined frames, where these end a run of equal samples or change a velocity; else None."""
    name = f"{path}.points"
    found, low, high = layer.GetBracketingTimeSamplesForPath(name, time)
    if not found or (low == high and (low != time or not layer.GetAttributeAtPath(f"{path}.velocities"))):
        return None
    a, b = (np.asarray(layer.QueryTimeSample(name, each)) for each in (low, high))
    return a if np.array_equal(a, b) else None


def _union_hints(layer: Sdf.Layer, other: Sdf.Layer) -> None:
    """Let the boxes of models in a layer hold those of another one too: each chunk grew them by its own frames."""
    paths: list[Sdf.Path] = []
    other.Traverse(Sdf.Path.absoluteRootPath, lambda path: paths.append(Sdf.Path(path)))
    for path in paths:
        if not path.IsPropertyPath() or path.name != HINT:
            continue
        for time in other.ListTimeSamplesForPath(path):
            layer.SetTimeSample(path, time, _union(*(each.QueryTimeSample(path, time) for each in (layer, other))))
        ours, theirs = (each.GetAttributeAtPath(path).default for each in (layer, other))
        if ours is not None and theirs is not None:
            layer.GetAttributeAtPath(path).default = _union(ours, theirs)


def _union(ours: Any, theirs: Any) -> Any:
    """Boxes, one corner after the other, that hold two sets of them; the second where they are not of one shape."""
    one, other = np.asarray(ours), np.asarray(theirs)
    if ours is None or one.shape != other.shape or one.ndim != 2:
        return theirs
    grown = one.copy()
    grown[0::2] = np.minimum(one[0::2], other[0::2])
    grown[1::2] = np.maximum(one[1::2], other[1::2])
    return Vt.Vec3fArray.FromNumpy(grown)


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


def _write_clips(
    parts: Sequence[_Part],
    joints: Sequence[_Joint],
    shot: Path,
    out: Path,
    record: Mapping[str, Any],
    *,
    overwrite: bool,
) -> None:
    """Write what does not move, the manifest, and a layer that plays the chunks over both."""
    joined = {joint.after.file: _joined_layer(joint) for joint in joints if joint.points}
    unwanted = {f"seam at {part.chunk.times[0]:g}" for part in parts if part.file not in joined}
    targets = {what: path for what, path in _targets(parts, out, clips=True).items() if what not in unwanted}
    for path in targets.values():
        check_suffix("the layer", path, LAYER_SUFFIXES)
        prepare_target(path, overwrite=overwrite)
    with _on_disk(targets["topology"]) as topology:
        UsdUtils.StitchClipsTopology(topology, [part.layer.identifier for part in parts])
        for part in parts:
            _union_hints(topology, part.layer)
        topology.customLayerData = {}
    played = [
        each
        for part in parts
        for each in (
            *([(joined[part.file], _seam_file(out, part))] if part.file in joined else []),
            (part.layer, part.file),
        )
    ]
    for layer, file in played:
        if layer.anonymous:
            export_layer(layer, file)
    root, manifest = _clip_root(played, out, record["garments"], manifest=targets["manifest"].name)
    root.subLayerPaths.append(f"./{targets['topology'].name}")
    author_record(root, record)
    export_layer(manifest, targets["manifest"])
    export_layer(root, out)
    _check_clips(played, record["garments"], shot, out)


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
    played: Sequence[tuple[Sdf.Layer, Path]], out: Path, garments: Sequence[str], *, manifest: str
) -> tuple[Sdf.Layer, Sdf.Layer]:
    """The layer in memory that plays chunks as value clips, without sublayers yet, and its manifest.

    Each garment has its own clips, those of the layers, in their order, in which it has samples: where a clip holds
    nothing of an attribute, USD takes a default in place of the samples around it.
    """
    root, declared = Sdf.Layer.CreateAnonymous(".usda"), Sdf.Layer.CreateAnonymous(".usda")
    first = played[0][0].pseudoRoot
    for key in first.ListInfoKeys():
        if key not in ("customLayerData", "subLayers", "subLayerOffsets"):
            root.pseudoRoot.SetInfo(key, first.GetInfo(key))
    stage, folder = Usd.Stage.Open(root), out.resolve().parent
    for path in garments:
        held = [(layer, file, ends) for layer, file in played if (ends := _ends(layer, f"{path}.points"))]
        # Joined frames that begin with a chunk take its place.
        starts = [ends[0] for _, _, ends in held]
        held = [each for each, after in zip(held, [*starts[1:], float("inf")], strict=False) if each[2][0] < after]
        if not held:
            continue
        layers = [layer for layer, _, _ in held]
        UsdUtils.StitchLayers(declared, Usd.ClipsAPI.GenerateClipManifestFromLayers(layers, path))
        clips = Usd.ClipsAPI(stage.OverridePrim(path))
        clips.SetClipPrimPath(path)
        clips.SetClipAssetPaths([Sdf.AssetPath(asset_path(file, folder)) for _, file, _ in held])
        clips.SetClipManifestAssetPath(Sdf.AssetPath(f"./{manifest}"))
        clips.SetClipActive(Vt.Vec2dArray([(ends[0], index) for index, (_, _, ends) in enumerate(held)]))
        clips.SetClipTimes(Vt.Vec2dArray([(time, time) for time in (held[0][2][0], held[-1][2][1])]))
    return root, declared


def _check_clips(played: Sequence[tuple[Sdf.Layer, Path]], garments: Sequence[str], shot: Path, out: Path) -> None:
    """Refuse clips that do not show what the layers hold, in the first and last frame of each: USD fails silently."""
    below = [str(shot)] if is_there(shot) else []
    root = Sdf.Layer.CreateAnonymous(".usda")
    root.timeCodesPerSecond = played[0][0].timeCodesPerSecond
    for identifier in (str(out.resolve()), *below):
        root.subLayerPaths.append(identifier)
    stage = Usd.Stage.Open(root)
    for path in garments:
        name = f"{path}.points"
        owners: dict[float, tuple[Sdf.Layer, Path]] = {}
        for layer, file in sorted(played, key=lambda each: each[0].anonymous):
            owners |= dict.fromkeys(_ends(layer, name), (layer, file))
        for time, (layer, file) in owners.items():
            shown, held = stage.GetAttributeAtPath(name).Get(time), layer.QueryTimeSample(name, time)
            if shown is None or not np.array_equal(np.asarray(shown), np.asarray(held)):
                raise LayerError(f"{out} does not show <{path}> at time code {time:g} as {file} holds it")


def _ends(layer: Sdf.Layer, name: str) -> list[float]:
    """Times of an attribute's first and last sample in a layer."""
    times = layer.ListTimeSamplesForPath(name)
    return [times[0], times[-1]] if times else []
