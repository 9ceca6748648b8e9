"""Joins chunks, which `refine --preroll` writes, into one layer, or into value clips where one file would be too large.

Each chunk begins a few frames early, and its record says where the cloth was in these. The chunk before holds the same
frames: over them the cloth goes from one to the other, by the rule of `joined`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, pairwise
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LayerError, UsageError, counted
from ..interrupts import signals_noted
from ..solver.mesh.subdivide import subdivide_times
from ..solver.mesh.weld import Weld
from ..usd.files import LAYER_SUFFIXES, check_targets, files_of
from ..usd.provenance import is_only_ours, recorded_shot, write_root
from ..usd.read.reader import Shot
from ..usd.stage import is_there, pxr_errors, quiet
from ..usd.times import within
from ..usd.write.atomic import prepare_target
from ..usd.write.chunk import ChunkLayer, Frame, Points, mean_edge, open_chunk, vertex_count
from ..usd.write.stitch import joined_record, targets_of, write_clips, write_layer
from ..usd.write.track import to_local
from .frames import Lead, Outcome
from .joined import Joint, Mover, Positions, SafeMover, join
from .options import RefineOptions
from .untagged import open_with_colliders

SEAM_BOUND = 0.05
"""Most that a seam may add to a frame's move, RMS over a garment, in mean fine edges; `docs/farm.md` has figures."""
_FINEST = 6
_OF_ONE_CHUNK = ("frames",)
"""Options in which chunks of one shot differ."""


@dataclass(frozen=True)
class Seam:
    """How far a garment moves between two chunks because they were solved apart.

    Attributes:
        after: Time code of the first frame after it.
        path: The fine mesh.
        rms: What it adds to a frame's move at most, RMS over the vertices, in mean fine edge lengths.
        largest: The same of the vertex that it moves most.
        frames: Over how many frames both are joined; 0 where cloth jumps.
        why: Why it jumps, or "".
    """

    after: float
    path: str
    rms: float
    largest: float
    frames: int
    why: str = ""

    def __str__(self) -> str:
        """Place and distance in one line."""
        how = f"a frame, over {counted(self.frames, 'frame')}" if self.frames else "at once"
        move = f"seam at {self.after:g}: <{self.path}> moves {self.rms:.3g} fine edges RMS, {self.largest:.3g} at most"
        return f"{move}, {how}" + (f" ({self.why})" if self.why else "")


def stitch(
    chunks: Sequence[str | Path],
    out: str | Path,
    *,
    frames: tuple[float, float] | None = None,
    seam_bound: float = SEAM_BOUND,
    clips: bool = False,
    root: str | Path | None = None,
    overwrite: bool = False,
) -> list[Seam]:
    """Join chunks of one shot into one layer.

    Where the shot is there, joined cloth is moved so that nothing newly crosses or is in bodies.

    Args:
        chunks: Layers that `refine_shot` wrote with ``preroll``, in any order; a folder stands for all layers in it.
        out: Layer to write.
        frames: First and last time code that the layer must have; None for all of the shot.
        seam_bound: Most that a seam may add to a frame's move, RMS over a garment, in mean fine edge lengths.
        clips: Leave the chunks where they are and make ``out`` a small layer that plays them as value clips. Beside it
            come ``<out>.topology.usdc``, with what does not move and the frames in which two chunks are joined, and
            ``<out>.manifest.usda``.
        root: A small root layer to write, with the layer over the shot.
        overwrite: Whether existing files may be replaced.

    Returns:
        The seams, in order.

    Raises:
        UsageError: A frame is missing or doubled, chunks are not of one shot, version and set of options, or ``out`` is
            one of them.
        LayerError: A chunk cannot be read, a seam moves too far, or the layer cannot be written or is invalid.
    """
    out = Path(out)
    with signals_noted(), pxr_errors("cannot read the chunks", LayerError), quiet():
        parts = _opened(chunks)
        shot = _check_alike(parts)
        _check_frames(parts, frames)
        inputs = {part.file for part in parts} | files_of(shot)
        targets = targets_of(out, clips=clips) | ({} if root is None else {"root": Path(root)})
        check_targets([(f"the {what}", path) for what, path in targets.items()], inputs)
        if root is not None:
            prepare_target(Path(root), overwrite=overwrite)
        seams, made = _join_each(list(pairwise(parts)), shot)
        _check_seams(parts, seams, seam_bound)
        record = joined_record(parts, shot, out, frames=frames)
        how = {"shot": shot, "overwrite": overwrite}
        if clips:
            begins, windows = _windows(parts, made)
            write_clips(parts, _frames(parts, made, only=windows), begins, out, record, **how)
        else:
            write_layer(parts, _frames(parts, made), out, record, **how)
        if root is not None:
            absolute = Path(str(parts[0].record["shot"])).is_absolute()
            write_root(Path(root), layer=out, shot=shot, absolute=absolute, overwrite=overwrite)
    return seams


def check_seams(chunks: Sequence[str | Path], *, of: Path | None = None, seam_bound: float = SEAM_BOUND) -> list[Seam]:
    """Measure the seams of chunks that follow one another, and write nothing: others may still be missing.

    Args:
        chunks: As for `stitch`.
        of: One of them, to measure its own seams alone; what else is in its folder need not be of the shot.
        seam_bound: As for `stitch`.

    Returns:
        The seams, in order.

    Raises:
        UsageError: Chunks are not of one shot, version and set of options.
        LayerError: A chunk cannot be read, or a seam moves too far.
    """
    with pxr_errors("cannot read the chunks", LayerError), quiet():
        parts = _opened(chunks, strict=of is None)
        if of is not None:
            shot = recorded_shot(open_chunk(of).layer)
            parts = [part for part in parts if recorded_shot(part.layer) == shot]
        seams = []
        for pair in pairwise(parts):
            if _follow(*pair) and (of is None or of in [part.file for part in pair]):
                found, _ = _join_each([pair], _check_alike(pair))
                _check_seams(pair, found, seam_bound)
                seams += found
    return seams


def _follow(before: ChunkLayer, after: ChunkLayer) -> bool:
    """Whether no frame of the shot lies between two chunks."""
    every = after.chunk.every
    return before.chunk.times[-1:] == every[: every.index(after.chunk.times[0])][-1:]


def _opened(chunks: Sequence[str | Path], *, strict: bool = True) -> list[ChunkLayer]:
    """The chunks by their frames; other layers are refused, or left out."""
    files = dict.fromkeys(file for place in chunks for file in _layers_in(Path(place)))
    parts = []
    for file in files:
        try:
            parts.append(open_chunk(file))
        except LayerError:
            if strict:
                raise
    if not parts:
        raise UsageError(f"there are no chunks to stitch in {', '.join(map(str, chunks)) or 'no files'}")
    return sorted(parts, key=lambda part: part.chunk.times)


def _layers_in(place: Path) -> list[Path]:
    """The layers in a folder but those that are being written; a file alone."""
    if not place.is_dir():
        return [place]
    return [file for file in sorted(place.iterdir()) if file.suffix in LAYER_SUFFIXES and ".tmp." not in file.name]


def _check_alike(parts: Sequence[ChunkLayer]) -> Path:
    """Refuse chunks that were changed, or are of other shots, versions or options; returns the shot."""
    first = parts[0]
    for part in parts:
        if not is_only_ours(part.layer):
            raise LayerError(f"{part.file} was changed after refine wrote it; refine it anew")
        part.check_preroll()
    shots = [recorded_shot(part.layer) for part in parts]
    for part, shot in zip(parts[1:], shots[1:], strict=True):
        one, other = _decisive(first), _decisive(part)
        if names := sorted(name for name in {*one, *other} if one.get(name) != other.get(name)):
            raise UsageError(f"{part.file} and {first.file} were made with other {', '.join(names)}; refine one anew")
        if shot != shots[0]:
            raise UsageError(f"{part.file} is of {shot}, {first.file} of {shots[0]}; stitch chunks of one shot")
    if shots[0] is None:
        raise LayerError(f"the record of {first.file} names no shot")
    return Path(shots[0])


def _decisive(part: ChunkLayer) -> dict[str, Any]:
    """Everything that must be the same in all chunks, flat."""
    hashes = sorted((Path(name).name, str(value)) for name, value in dict(part.record["inputs"]).items())
    plain = {name: part.record.get(name) for name in ("version", "code", "mode")} | {
        "variant selections": list(part.record.get("variants", ())),
        "files of the shot": hashes,
        "frames of the shot": part.chunk.every,
    }
    options = {name: value for name, value in part.options.items() if name not in _OF_ONE_CHUNK}
    return plain | {f"--{name.replace('_', '-')}": value for name, value in options.items()}


def _check_frames(parts: Sequence[ChunkLayer], frames: tuple[float, float] | None) -> None:
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
        there = ", ".join(f"{part.file} ({_span(part.chunk.times)})" for part in parts)
        raise UsageError(f"frames {_spans(missing, wanted)} are in no chunk; those there: {there}")
    for part in parts:
        if not set(part.chunk.times) <= set(wanted):
            outside = f"{part.file} holds the frames {_span(part.chunk.times)}, of which some lie outside --frames"
            raise UsageError(f"{outside}; leave it out")


def _span(times: Sequence[float]) -> str:
    """First and last of some time codes as ``--frames`` takes them."""
    return f"{min(times):g}:{max(times):g}" if times else "none"


def _spans(times: Sequence[float], every: Sequence[float]) -> str:
    """Time codes as ranges without a gap among all of them."""
    runs: list[list[float]] = []
    for time in times:
        if runs and every.index(time) == every.index(runs[-1][-1]) + 1:
            runs[-1].append(time)
        else:
            runs.append([time])
    return ", ".join(map(_span, runs))


def _join_each(pairs: Sequence[tuple[ChunkLayer, ChunkLayer]], shot: Path) -> tuple[list[Seam], dict[float, Points]]:
    """Join each two chunks that follow one another; returns the seams, and the frames that no chunk has so."""
    seams: list[Seam] = []
    made: dict[float, Points] = {}
    with ExitStack() as stack:
        garments, mover = _mover(stack, shot, list(chain(*pairs)))
        for before, after in pairs:
            both = _solved_twice(before, after, garments)
            joint = join(both, mover)
            seams += _measured(both, joint, garments, after)
            for (own, _), frame in zip(both, joint.frames, strict=True):
                if frame.points is not own.points and frame.time is not None:
                    points = zip(garments, frame.points, strict=True)
                    made[frame.time] = {path: each for path, each in points if each is not None}
    return seams, made


def _solved_twice(before: ChunkLayer, after: ChunkLayer, garments: Sequence[str]) -> list[tuple[Outcome, Lead]]:
    """The frames without a gap, up to the seam, that a chunk and the pre-roll of the next one have."""
    every = after.chunk.every
    first = seam = every.index(after.chunk.times[0])
    while first > 0 and every[first - 1] in after.chunk.preroll and before.has(every[first - 1]):
        first -= 1
    both = []
    for number, time in enumerate(every[first:seam], start=1):
        sides = before.frame(time, repeated=True).points, after.chunk.preroll[time]
        points = [[side.get(path) for path in garments] for side in sides]
        for index, (own, other) in enumerate(zip(*points, strict=True)):
            if own is None or other is None or own.shape != other.shape:
                points[1][index] = None
        own, other = (Outcome(time, tuple(each), (False,) * len(garments), {}) for each in points)
        both.append((own, Lead(other, seam, number / (seam - first + 1))))
    return both


def _measured(
    both: Sequence[tuple[Outcome, Lead]], joint: Joint, garments: Sequence[str], after: ChunkLayer
) -> list[Seam]:
    """How far a seam moves each garment: in equal parts, and by how much cloth lags behind where it may not go on."""
    seams = []
    for index, path in enumerate(garments):
        jump, moves, lag = (0.0, 0.0), [], np.zeros(1)
        for (own, lead), frame in zip(both, joint.frames, strict=True):
            a, b, x = (each.points[index] for each in (own, lead.outcome, frame))
            if a is None or b is None or x is None:
                continue
            edge, apart, before = mean_edge(after.layer, path, a), b.astype(np.float64) - a, lag
            lag = x - (a + lead.weight * apart)
            jump = _size(apart, edge)
            part = apart / (len(both) + 1)
            moves.append(_size(part + lag - before, edge))
            if own is both[-1][0]:
                moves.append(_size(part - lag, edge))
        if moves:
            rms, largest = jump if joint.why else tuple(map(float, np.max(moves, axis=0)))
            seams.append(Seam(after.chunk.times[0], path, rms, largest, 0 if joint.why else len(both), joint.why))
    return seams


def _size(moves: np.ndarray, edge: float) -> tuple[float, float]:
    """Of moves of vertices, shape (V, 3), RMS and at most, in edges."""
    distances = np.linalg.norm(moves, axis=1) / edge
    return float(np.sqrt(np.mean(distances**2))), float(distances.max(initial=0.0))


def _check_seams(parts: Sequence[ChunkLayer], seams: Sequence[Seam], bound: float) -> None:
    """Refuse a seam that moves too far, or of which nothing is known though frames depend on one another."""
    worst = max(seams, key=lambda seam: seam.rms, default=None)
    if worst is not None and worst.rms > bound:
        count = ceil(worst.rms * (worst.frames + 1) / bound) if bound > 0 else 0
        longer = f"--preroll {count}" if count else "a longer --preroll"
        remedy = f"refine with {longer} or with --temporal off, or allow more by --seam-bound"
        raise LayerError(f"{worst}; at most {bound:g} RMS is allowed: {remedy}")
    known = {seam.after for seam in seams}
    for part in parts[1:] if parts[0].options.get("temporal") != "off" and np.isfinite(bound) else ():
        if part.chunk.times[0] not in known:
            unknown = f"nothing tells how far the seam at {part.chunk.times[0]:g} moves"
            remedy = "refine it with --preroll 1 or more, or give --seam-bound inf"
            raise LayerError(f"{unknown}: {part.file} has no pre-roll that ended in the frame before it; {remedy}")


def _frames(
    parts: Sequence[ChunkLayer], made: Mapping[float, Points], *, only: Collection[float] | None = None
) -> Iterator[Frame]:
    """Frames of the chunks in order, some of them made anew; all frames, or only some."""
    every = parts[0].chunk.every
    # A run of equal samples may end before the frames made anew; its last one is not in the chunk.
    ends = {every[max(every.index(time) - 1, 0)] for time in made}
    for part in parts:
        for time in part.chunk.times:
            if part.has(time) and (only is None or time in only):
                frame = part.frame(time, repeated=time in made or time in ends)
                yield replace(frame, points={**frame.points, **made.get(time, {})})


def _windows(parts: Sequence[ChunkLayer], made: Mapping[float, Points]) -> tuple[dict[Path, float], set[float]]:
    """Time codes from which joined frames are shown, by the chunk after them, and those of all frames that this takes.

    They are the frames made anew, two before and one after them, by which velocities are known.
    """
    begins, windows, every = {}, set(), parts[0].chunk.every
    for before, after in pairwise(parts):
        if anew := [time for time in before.chunk.times if time in made]:
            first, seam = every.index(anew[0]), every.index(after.chunk.times[0])
            begins[after.file] = every[max(first - 1, 0)]
            windows |= set(every[max(first - 2, 0) : seam + 1])
    return begins, windows


def _mover(stack: ExitStack, shot: Path, parts: Sequence[ChunkLayer]) -> tuple[list[str], Mover]:
    """Paths of the fine meshes, and their mover, in local positions; without the shot, cloth goes where it is wanted.

    Args:
        stack: Closes the shot at its end.
        shot: The shot, opened where chunks have a pre-roll.
        parts: The chunks.
    """
    counts = {path: vertex_count(part.layer, path) for part in parts for path in part.garments}
    if not is_there(shot) or not any(part.chunk.preroll for part in parts):
        return list(counts), _rounded
    plain = {name: value for name, value in parts[0].options.items() if name not in ("frames", "preroll", "weights")}
    options = RefineOptions(**plain)
    how = {name: getattr(options, name) for name in ("garments", "colliders", "level", "overrides", "rest_frame")}
    opened = stack.enter_context(closing(open_with_colliders(str(shot), **how)))
    paths = [str(source.path) + ("_refined" if options.mode == "sibling" else "") for source in opened.sources]
    levels = [_level_of(opened, index, counts.get(path)) for index, path in enumerate(paths)]
    welds = [source.weld.subdivided(level)[1] for source, level in zip(opened.sources, levels, strict=True)]
    mover = partial(_move_local, opened, welds, SafeMover(opened, options, levels))
    return list(dict.fromkeys([*paths, *counts])), mover


def _level_of(opened: Shot, index: int, count: int | None) -> int:
    """How often a garment was subdivided to have a number of vertices; 0 where it is in no chunk."""
    if count is None:
        return 0
    cage = opened.sources[index].weld.apart
    for level in range(_FINEST + 1):
        if [cage, *(step.mesh for step in subdivide_times(cage, level))][-1].vertex_count == count:
            return level
    changed = "is not what the chunks were refined from: it has changed since; refine them anew"
    raise LayerError(f"<{opened.sources[index].path}> of {opened.path} {changed}")


def _rounded(_time: object, _near: object, _far: object, wanted: Positions) -> tuple[list[np.ndarray | None], str]:
    """Wanted positions as a layer holds them; a `Mover`."""
    return [None if each is None else each.astype(np.float32) for each in wanted], ""


def _move_local(
    opened: Shot,
    welds: Sequence[Weld],
    mover: SafeMover,
    time: float | None,
    near: Positions,
    far: Positions,
    wanted: Positions,
) -> tuple[list[np.ndarray | None], str]:
    """Move as `Mover` does, in local positions of the shot's garments; others go where they are wanted."""
    found, _ = _rounded(time, near, far, wanted)
    garments = range(len(opened.sources))
    matrices = [None if found[index] is None else opened.to_metres(index, time) for index in garments]
    worlds = [list(map(_world, side, matrices, welds)) for side in (near, far, found)]
    moved, worse = mover(time, *worlds)
    for index, start, end, matrix in zip(garments, worlds[2], moved, matrices, strict=True):
        if start is not None and end is not None and matrix is not None and not np.array_equal(start, end):
            found[index] = to_local(welds[index].split(end), matrix, str(opened.sources[index].path), time)
    return found, worse


def _world(local: np.ndarray | None, to_metres: np.ndarray | None, weld: Weld) -> np.ndarray | None:
    if local is None or to_metres is None:
        return None
    return weld.joined(local.astype(np.float64) @ to_metres[:3, :3].T + to_metres[:3, 3])
