"""Joins chunks, folders of finished frames that `refine --preroll` leaves, into one layer by the ordinary writer.

Each chunk begins a few frames early, in the pre-roll. The chunk before holds the same frames: over them the cloth goes
from one solution to the other, by the rule of `joined`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LayerError, UsageError, counted
from ..solver.level import refine_garments
from ..solver.mesh.topology import PolygonMesh
from ..usd.read.reader import Shot
from .chunks import finished_frames
from .finished import check_jobs, made_from
from .frames import CHUNK, Finished, Folders, record_in
from .joined import Both, Joint, SafeMover, joined
from .options import RefineOptions
from .refine import check_places, running, write_all
from .report import RefineReport
from .run import fine_meshes, numbers_in
from .solve import open_for

SEAM_BOUND = 0.05
"""Most that a seam may add to a frame's move, RMS over a garment, in mean fine edges; `docs/farm.md` has figures."""
_OF_ONE_CHUNK = ("frames",)
"""Options in which chunks of one shot differ."""


@dataclass(frozen=True)
class Seam:
    """How far a garment moves between two chunks because they were solved apart.

    Attributes:
        after: Time code of the first frame after it.
        path: The garment.
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


@dataclass(frozen=True, eq=False)
class _Chunk:
    """A chunk's folder.

    Attributes:
        folder: The folder.
        run: Its record.
    """

    folder: Path
    run: Mapping[str, Any]

    @cached_property
    def finished(self) -> Finished:
        """Its frames."""
        return Finished(self.folder)

    @cached_property
    def numbers(self) -> list[int]:
        """Numbers of the frames that are there, failed ones among them, in order."""
        return sorted(self.finished.kept | self.finished.failed)

    @property
    def is_whole(self) -> bool:
        """Whether every frame is there."""
        return self.numbers == list(range(*self.run[CHUNK]))

    @property
    def times(self) -> list[float]:
        """Time codes of the frames that are there."""
        return [time for k in self.numbers if (time := self.run["times"][k]) is not None]

    @property
    def shot(self) -> Path:
        """The shot, by the record."""
        return (self.folder.resolve().parent / self.run["shot"]).resolve()

    @property
    def preroll(self) -> int:
        """Most frames solved before its first one."""
        return 0 if self.run["options"].get("temporal") == "off" else int(self.run["options"]["preroll"])

    def decisive(self) -> dict[str, Any]:
        """Everything that must be the same in all chunks, flat."""
        options = {name: value for name, value in self.run["options"].items() if name not in _OF_ONE_CHUNK}
        plain = {name: self.run.get(name) for name in ("version", "code", "unsaved", "levels")}
        plain |= {"files of the shot": _hashes(self.run), "frames of the shot": self.run["times"]}
        return plain | {f"--{name.replace('_', '-')}": value for name, value in options.items()}

    def options(self, **more: Any) -> RefineOptions:
        """Options to join it with: the frames are solved, so without weights and on the CPU."""
        left = ("frames", "preroll", "weights", "device")
        plain = {name: value for name, value in self.run["options"].items() if name not in left}
        paths = "absolute" if Path(self.run["shot"]).is_absolute() else "relative"
        return RefineOptions(**plain, asset_paths=paths, **more)


@dataclass(eq=False)
class _Joins:
    """Chunks to join, and the seams that were met; `run.Joins`."""

    parts: Sequence[_Chunk]
    meshes: Sequence[PolygonMesh]
    paths: Sequence[str]
    bound: float
    numbers: range = range(0)
    record: Mapping[str, Any] = field(default_factory=dict)
    seams: list[Seam] = field(default_factory=list)

    @property
    def frames(self) -> Folders:
        """The frames of all chunks; points that do not fit a mesh are damaged."""
        counts = [mesh.vertex_count for mesh in self.meshes]
        return Folders(
            {k: found for part in self.parts for found in [Finished(part.folder, counts=counts)] for k in part.numbers}
        )

    @property
    def preroll(self) -> int:
        """Most frames solved before each chunk."""
        return self.parts[0].preroll

    def seen(self, both: Both, joint: Joint) -> None:
        """Measure a seam; one whose last frame failed on either side is unknown."""
        after = self.parts[0].run["times"][both[-1][1].seam]
        for index, (path, mesh) in enumerate(zip(self.paths, self.meshes, strict=True)):
            moves = _moves(both, joint, index, mesh.half_edges.edges)
            if moves is not None:
                rms, largest = map(float, np.max(moves, axis=0))
                self.seams.append(Seam(after, path, rms, largest, 0 if joint.why else len(both), joint.why))

    def check(self) -> None:
        """Refuse a seam that moves too far, or of which nothing is known though frames depend on one another."""
        worst = max(self.seams, key=lambda seam: seam.rms, default=None)
        if worst is not None and worst.rms > self.bound:
            count = ceil(worst.rms * (worst.frames + 1) / self.bound) if self.bound > 0 else 0
            longer = f"--preroll {count}" if count else "a longer --preroll"
            remedy = f"refine with {longer} or with --temporal off, or allow more by --seam-bound"
            raise LayerError(f"{worst}; at most {self.bound:g} RMS is allowed: {remedy}")
        known = {seam.after for seam in self.seams}
        alone = self.parts[0].run["options"].get("temporal") == "off" or not np.isfinite(self.bound)
        for part in () if alone else self.parts[1:]:
            if part.times[0] not in known:
                unknown = f"nothing tells how far the seam at {part.times[0]:g} moves"
                remedy = "refine it with --preroll 1 or more, or give --seam-bound inf"
                raise LayerError(
                    f"{unknown}: {part.folder} has no pre-roll that ended in the frame before it; {remedy}"
                )


def stitch(
    chunks: Sequence[str | Path],
    out: str | Path,
    *,
    frames: tuple[float, float] | None = None,
    seam_bound: float = SEAM_BOUND,
    shot: str | Path | None = None,
    root: str | Path | None = None,
    report_to: str | Path | None = None,
    overwrite: bool = False,
) -> tuple[RefineReport, list[Seam]]:
    """Join chunks of one shot into one layer. Joined cloth is moved so that nothing newly crosses or is in bodies.

    Args:
        chunks: Folders that `refine_shot` left with ``preroll``, in any order; a folder of them stands for all in it.
        out: Layer to write.
        frames: First and last time code that the layer must have; None for all of the shot.
        seam_bound: Most that a seam may add to a frame's move, RMS over a garment, in mean fine edge lengths.
        shot: The shot where it is not where the chunks say.
        root: A small root layer to write, with the layer over the shot.
        report_to: Where the report goes, a JSON file or a folder.
        overwrite: Whether existing files may be replaced.

    Returns:
        The report, as of one run of all frames, and the seams in order.

    Raises:
        UsageError: A frame is missing or doubled, chunks are not of one shot, version and set of options, or of another
            version of the shot, or a file exists.
        StageError: The shot cannot be read.
        LayerError: A frame is damaged, a seam moves too far, or the layer cannot be written or is invalid.
    """
    out, parts = Path(out), _opened(chunks)
    _check_alike(parts, one_shot=shot is None)
    numbers = _check_frames(parts, frames)
    files = {"root": root and Path(root), "report": report_to and Path(report_to)}
    options, source = parts[0].options(overwrite=overwrite, **files), Path(shot or parts[0].shot)
    check_jobs([(source, out, options)])
    check_places(out, options)
    with running(str(source), options, out=out) as (opened, report):
        _check_same_shot(parts[0], made_from(opened, out, options))
        recorded = {name: value for name, value in parts[0].run["options"].items() if name not in _OF_ONE_CHUNK}
        recorded |= {"frames": list(frames)} if frames else {}
        report.options = dict(recorded)
        spans = [_span(part.times) for part in parts]
        joins = _joins(parts, opened, seam_bound, numbers=numbers, record={"options": recorded, "chunks": spans})
        _make_folder(out.resolve().parent)
        write_all(opened, out, options, report, joins=joins)
    return report, joins.seams


def check_seams(
    chunks: Sequence[str | Path],
    *,
    of: Path | None = None,
    seam_bound: float = SEAM_BOUND,
    shot: str | Path | None = None,
) -> list[Seam]:
    """Measure the seams of chunks that follow one another, and write nothing: others may still be missing.

    Args:
        chunks: As for `stitch`.
        of: One of them, to measure its own seams alone; what else is in its folder need not be of the shot, or whole.
        seam_bound: As for `stitch`.
        shot: As for `stitch`.

    Returns:
        The seams, in order.

    Raises:
        UsageError: Chunks are not of one shot, version and set of options.
        LayerError: A frame is damaged, or a seam moves too far.
    """
    parts = _opened(chunks)
    if of is not None:
        (own,) = _opened([of])
        parts = [part for part in parts if part.shot == own.shot and part.is_whole]
    pairs = [
        (before, after)
        for before, after in pairwise(parts)
        if before.run[CHUNK][1] == after.run[CHUNK][0]
        and (of is None or of.resolve() in [part.folder.resolve() for part in (before, after)])
    ]
    found: list[Seam] = []
    for pair in pairs:
        _check_alike(pair, one_shot=shot is None)
        with _opened_shot(pair[0], shot) as opened:
            start = pair[1].run[CHUNK][0]
            numbers = [k for k in pair[0].numbers if k >= start - pair[0].preroll]
            joins = _joins(pair, opened, seam_bound)
            mover = SafeMover(opened, pair[0].options(), pair[0].run["levels"])
            leading = finished_frames(joins.frames, pair[0].run["times"], numbers, preroll=joins.preroll)
            for _ in joined(leading, mover, lambda _: None, seen=joins.seen):
                pass
            joins.check()
            found += joins.seams
    return found


def _make_folder(folder: Path) -> None:
    """Make a folder for a layer where it is missing (LayerError)."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LayerError(f"cannot make the folder {folder}: {error.strerror}") from error


@contextmanager
def _opened_shot(part: _Chunk, shot: str | Path | None) -> Iterator[Shot]:
    """A chunk's shot, open and checked to be what the chunk was refined from."""
    opened = open_for(str(shot or part.shot), part.options())
    try:
        _check_same_shot(part, made_from(opened, part.folder, part.options()))
        yield opened
    finally:
        opened.close()


def _joins(parts: Sequence[_Chunk], opened: Shot, bound: float, **more: Any) -> _Joins:
    """Chunks of an open shot, to be joined."""
    garments = opened.scene.garments
    meshes = fine_meshes(garments, refine_garments(garments, parts[0].run["levels"]))
    return _Joins(parts, meshes, [str(source.path) for source in opened.sources], bound, **more)


def _opened(chunks: Sequence[str | Path]) -> list[_Chunk]:
    """The chunks by their frames; what else lies in a folder of them is left out."""
    found: dict[Path, _Chunk] = {}
    for place in map(Path, chunks):
        run = record_in(place)
        inside = [] if run or not place.is_dir() else [each for each in sorted(place.iterdir()) if record_in(each)]
        if not inside and not _is_of_chunk(run):
            raise UsageError(f"{place} is no chunk of a shot, nor a folder of chunks; refine with --preroll makes one")
        for folder in inside or [place]:
            if _is_of_chunk(record := record_in(folder)):
                found[folder.resolve()] = _Chunk(folder, record)
    parts = [part for part in found.values() if part.numbers]
    if not parts:
        raise UsageError(f"there are no frames to stitch in {', '.join(map(str, chunks)) or 'no folders'}")
    return sorted(parts, key=lambda part: part.numbers)


def _is_of_chunk(run: Mapping[str, Any]) -> bool:
    """Whether a record is of a chunk, as `run` writes it."""
    kinds = {CHUNK: list, "times": list, "levels": list, "options": dict, "inputs": dict, "shot": str}
    return all(isinstance(run.get(name), kind) for name, kind in kinds.items())


def _check_alike(parts: Sequence[_Chunk], *, one_shot: bool) -> None:
    """Refuse chunks of other shots, versions or options."""
    first = parts[0]
    for part in parts[1:]:
        one, other = first.decisive(), part.decisive()
        if names := sorted(name for name in {*one, *other} if one.get(name) != other.get(name)):
            raise UsageError(
                f"{part.folder} and {first.folder} were made with other {', '.join(names)}; refine one anew"
            )
        if one_shot and part.shot != first.shot:
            raise UsageError(
                f"{part.folder} is of {part.shot}, {first.folder} of {first.shot}; stitch chunks of one shot"
            )


def _check_same_shot(part: _Chunk, made: Mapping[str, Any]) -> None:
    """Refuse a shot that is not what a chunk was refined from, and a chunk of another version of this package."""
    if _hashes(made) != _hashes(part.run):
        raise UsageError(f"the shot has changed since {part.folder} was refined from it; refine the chunks anew")
    if names := [name for name in ("version", "code") if made[name] != part.run.get(name)]:
        remedy = "stitch with the physgraph-usd that refined it, or refine the chunks anew"
        raise UsageError(f"{part.folder} was made with other {' and '.join(names)}; {remedy}")


def _hashes(run: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and digests of the files of the shot, wherever they lie."""
    return sorted((Path(name).name, str(value)) for name, value in run["inputs"].items())


def _check_frames(parts: Sequence[_Chunk], frames: tuple[float, float] | None) -> range:
    """Refuse frames that are missing, doubled, or not asked for; returns the numbers of those asked for."""
    every = parts[0].run["times"]
    owners: dict[int, list[_Chunk]] = {}
    for part in parts:
        for number in part.numbers:
            owners.setdefault(number, []).append(part)
    doubled = [number for number, folders in owners.items() if len(folders) > 1]
    if doubled:
        folders = sorted({str(part.folder) for number in doubled for part in owners[number]})
        times = _span([every[number] for number in doubled])
        raise UsageError(f"frames {times} are in more than one chunk: {', '.join(folders)}; leave one out")
    wanted = numbers_in([time for time in every if time is not None], frames)
    missing = [every[number] for number in wanted if number not in owners]
    if missing:
        there = ", ".join(f"{part.folder} ({_span(part.times)})" for part in parts)
        remedy = "refine them, or go on by --resume"
        raise UsageError(f"frames {_spans(missing, every)} are in no chunk; those there: {there}; {remedy}")
    for part in parts:
        if not set(part.numbers) <= set(wanted):
            outside = f"{part.folder} holds the frames {_span(part.times)}, of which some lie outside --frames"
            raise UsageError(f"{outside}; leave it out")
    return wanted


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


def _moves(both: Both, joint: Joint, index: int, edges: np.ndarray) -> list[tuple[float, float]] | None:
    """By how much a seam moves a garment, RMS and at most, in mean edges; None where nothing tells.

    In equal parts, and by how much cloth lags behind where it may not go on; at once where it jumps.
    """
    moves, lag = [], np.zeros(1)
    jump: tuple[float, float] | None = None
    for (own, lead), frame in zip(both, joint.frames, strict=True):
        points = [each.points[index] if each.points else None for each in (own, lead.outcome, frame)]
        jump, (a, b, x) = None, points
        if a is None or b is None or x is None:
            continue
        a, b = a.astype(np.float64), b.astype(np.float64)
        edge = float(np.linalg.norm(a[edges[:, 0]] - a[edges[:, 1]], axis=1).mean())
        before, lag = lag, x - (a + lead.weight * (b - a))
        part, jump = (b - a) / (len(both) + 1), _size(b - a, edge)
        moves.append(_size(part + lag - before, edge))
        if own is both[-1][0]:
            moves.append(_size(part - lag, edge))
    if jump is None:
        return None
    return [jump] if joint.why else moves


def _size(moves: np.ndarray, edge: float) -> tuple[float, float]:
    """Of moves of vertices, shape (V, 3), RMS and at most, in edges."""
    distances = np.linalg.norm(moves, axis=1) / edge
    return float(np.sqrt(np.mean(distances**2))), float(distances.max(initial=0.0))
