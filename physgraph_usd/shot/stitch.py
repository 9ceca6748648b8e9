"""Joins chunks, the folders of finished frames written by `refine --preroll`, into a layer with the ordinary writer.

The finished frames of a stopped run, and chunks with missing frames, make a partial layer, to be looked at.

Each chunk begins a few frames early, in the pre-roll. The previous chunk holds the same frames: `joined` blends the two
solutions over the pre-roll.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LayerError, UsageError, counted, named_time
from ..solver.level import fine_meshes, refine_garments
from ..solver.scene import Result
from ..usd.read.reader import Shot
from .chunks import Both, Joint, between, frames_in_order, join
from .findings.table import FINDINGS
from .frames import CHUNK, Finished, frames_folder, record_in
from .job import check_jobs, check_places, made_from, open_for
from .options import RefineOptions
from .refine import running, write_all
from .report import RefineReport
from .run import Run, Stored, numbers_in
from .solve import ShotSolver

SEAM_BOUND = 0.05
"""Largest increase of a frame's move by a seam, RMS over a garment, in mean fine edges; figures in `docs/farm.md`."""
SPARE = 1 / 3
"""Fraction of the bound left unused by a proposed pre-roll: a longer pre-roll may end in folds that differ more."""
_OF_ONE_CHUNK = ("frames", "preroll")
"""Options allowed to differ between chunks of one shot."""


@dataclass(frozen=True)
class Seam:
    """Extra motion of a garment between two chunks because the chunks were solved separately.

    Attributes:
        after: Time code of the first frame after the seam.
        rms: Largest increase of a frame's move, RMS over the vertices, in mean fine edge lengths.
        largest: Largest increase of a single vertex's move, in mean fine edge lengths.
        frames: Number of joined frames; 0 if the cloth jumps.
        why: Reason for a jump, or "".
    """

    after: float
    path: str
    rms: float
    largest: float
    frames: int
    why: str = ""

    def __str__(self) -> str:
        """Position and distance in one line."""
        extent = f"a frame, over {counted(self.frames, 'frame')}" if self.frames else "at once"
        move = f"seam at {self.after:g}: <{self.path}> moves {self.rms:.3g} fine edges RMS, {self.largest:.3g} at most"
        return f"{move}, {extent}" + (f" ({self.why})" if self.why else "")


class Chunk(Finished):
    """The folder of a chunk, or of the finished frames of a stopped run.

    Attributes:
        run: The record of the run.
        numbers: Numbers of the stored frames, including failed frames, in order.
    """

    def __init__(self, folder: Path, run: Mapping[str, Any]) -> None:
        """List the stored frames."""
        super().__init__(folder)
        self.run, self.numbers = run, sorted(self.kept | self.failed)

    @property
    def is_whole(self) -> bool:
        """Whether every frame is stored."""
        return self.numbers == list(range(*self.run[CHUNK]))

    @property
    def times(self) -> list[float]:
        """Time codes of the stored frames."""
        return [time for k in self.numbers if (time := self.run["times"][k]) is not None]

    @property
    def shot(self) -> Path:
        """Path of the shot, from the record."""
        return (self.folder.resolve().parent / self.run["shot"]).resolve()

    def decisive(self) -> dict[str, Any]:
        """Everything required to be equal in all chunks, as a flat record."""
        options = {name: value for name, value in self.run["options"].items() if name not in _OF_ONE_CHUNK}
        plain = {name: self.run.get(name) for name in ("version", "code", "unsaved", "levels")}
        plain |= {"files of the shot": _hashes(self.run), "frames of the shot": self.run["times"]}
        return plain | {f"--{name.replace('_', '-')}": value for name, value in options.items()}

    def options(self, **more: Any) -> RefineOptions:
        """Options for joining: without weights and on the CPU, because the frames are already solved."""
        ignored = ("preroll", "weights", "device", *(("frames",) if CHUNK in self.run else ()))
        plain = {name: value for name, value in self.run["options"].items() if name not in ignored}
        plain |= {"frames": tuple(plain["frames"])} if plain.get("frames") else {}
        paths = "absolute" if Path(self.run["shot"]).is_absolute() else "relative"
        return RefineOptions(**plain, asset_paths=paths, **more)


@dataclass(eq=False)
class _Joins:
    """Chunks of an open shot to join, and the measured seams; ``numbers`` are the frames of the layer, None for all."""

    parts: Sequence[Chunk]
    shot: Shot
    bound: float
    warn: Callable[..., object]
    numbers: Sequence[int] | None = None
    seams: list[Seam] = field(default_factory=list)

    def __post_init__(self) -> None:
        """List the stored frames; points not matching a mesh count as damaged."""
        garments, self.run = self.shot.scene.garments, self.parts[0].run
        self.meshes = fine_meshes(garments, refine_garments(garments, self.run["levels"]))
        for part in self.parts:
            part.counts = tuple(mesh.vertex_count for mesh in self.meshes)
        self.chunks = {k: part for part in self.parts for k in part.numbers}
        starts = {start: first for part in self.parts for start, first in part.seams.items()}
        wanted = {*(self.chunks if self.numbers is None else self.numbers)}
        self.starts = {start: first for start, first in starts.items() if {start - 1, start} <= wanted}
        self._anew = {number for number in wanted if number in starts or number - 1 not in wanted}

    def results(self, numbers: Iterable[int]) -> Generator[Result, None, None]:
        """Frames by number, joined, then a check of the seams (LayerError)."""
        solver = ShotSolver(self.shot.path, self.run["levels"], self.parts[0].options(), opened=self.shot)

        def joined(seam: int, solutions: Both) -> Sequence[Result]:
            joint = join(solutions, solver.mover)
            self.warn(*joint.warnings)
            self._measure(seam, solutions, joint)
            return joint.frames

        yield from frames_in_order(self._read, numbers, self.starts, join=joined)
        self._check()

    def _read(self, index: int, seam: int | None) -> Result:
        time = self.run["times"][index]
        if result := self.chunks[index if seam is None else seam].read(index, time, seam=seam):
            return result.as_changed() if index in self._anew and seam is None else result
        raise LayerError(f"the result of time code {time} is gone; refine it anew by --resume")

    def _measure(self, seam: int, solutions: Both, joint: Joint) -> None:
        """Measure a seam; unknown if the last frame failed in either chunk."""
        after = self.run["times"][seam]
        for index, garment in enumerate(self.shot.scene.garments):
            moves = _moves(solutions, joint, index, self.meshes[index].half_edges.edges)
            if moves is not None:
                rms, largest = map(float, np.max(moves, axis=0))
                frames = 0 if joint.why else len(solutions)
                self.seams.append(Seam(after, garment.path, rms, largest, frames, joint.why))

    def _check(self) -> None:
        """Refuse a seam with too large a move, or an unmeasured seam although frames depend on their predecessors."""
        worst = max(self.seams, key=lambda seam: seam.rms, default=None)
        if worst is not None and worst.rms > self.bound:
            allowed = (1 - SPARE) * self.bound
            longer = f"--preroll {ceil(worst.rms * (worst.frames + 1) / allowed)}" if allowed else "a longer --preroll"
            again = f"refine the chunk from {named_time(worst.after)} on with {longer}"
            remedy = f"{again}, or all with --temporal off, or allow more by --seam-bound"
            raise LayerError(f"{worst}; at most {self.bound:g} RMS is allowed: {remedy}")
        measured = {seam.after for seam in self.seams}
        independent = self.run["options"].get("temporal") == "off" or not np.isfinite(self.bound)
        for part in () if independent else self.parts:
            if part.numbers[0] - 1 in self.chunks and part.times[0] not in measured:
                unknown = f"nothing tells how far the seam at {named_time(part.times[0])} moves"
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
    partial: bool = False,
) -> tuple[RefineReport, list[Seam]]:
    """Join chunks of one shot into one layer. Joined cloth is moved without new intersections or vertices in bodies.

    Args:
        chunks: Folders written by `refine_shot` with ``preroll``, in any order; a folder of chunks stands for all
            inside. With ``partial`` also the folder of the finished frames of a stopped run, alone, or the layer that
            the run would have written.
        out: Layer to write.
        frames: First and last time code of the layer; None for the whole shot.
        seam_bound: Largest increase of a frame's move by a seam, RMS over a garment, in mean fine edge lengths.
        shot: Path of the shot, if moved since the chunks were made.
        root: A small root layer to write, with the layer over the shot.
        report_to: Path of the report, a JSON file or a folder.
        overwrite: Whether existing files may be replaced.
        partial: Write the finished frames and leave out the missing ones, with a warning that names them. Seams may
            then move by any distance.

    Returns:
        The report, as of one run of all frames, and the seams in order.

    Raises:
        UsageError: A frame is missing or doubled; chunks differ in shot, version or options, or the shot has changed
            since; or a file exists.
        StageError: The shot cannot be read.
        LayerError: A frame is damaged, a seam moves too far, or the layer cannot be written or is invalid.
    """
    out, parts = Path(out), chunks_in(chunks, partial=partial)
    _check_alike(parts, one_shot=shot is None)
    numbers, missing = _check_frames(parts, frames, partial=partial)
    if partial and any(part.folder.resolve() == frames_folder(out).resolve() for part in parts):
        raise UsageError(f"{out} is the layer of the run that was stopped; name another for a part of its frames")
    options = parts[0].options(overwrite=overwrite, root=root and Path(root), report=report_to and Path(report_to))
    source = Path(shot or parts[0].shot)
    check_jobs([(source, out, options)])
    check_places(out, options)
    with running(str(source), options, out=out) as (opened, report):
        check_same_shot(parts[0], made_from(opened, out, options))
        recorded = {name: value for name, value in parts[0].run["options"].items() if name not in _OF_ONE_CHUNK}
        recorded |= {"frames": list(frames)} if frames else {}
        recorded["preroll"] = max(part.run["options"].get("preroll", 0) for part in parts)
        report.options = dict(recorded)
        if missing:
            every, count = parts[0].run["times"], len(numbers) + len(missing)
            spans = _spans([every[number] for number in missing], every)
            report.warn(FINDINGS["partial"](count=len(numbers), frames=counted(count, "frame"), missing=spans))
        joins = _Joins(parts, opened, np.inf if partial else seam_bound, report.warn, numbers)
        record = {"options": recorded, "chunks": [_span(part.times) for part in parts]}
        _make_folder(out.resolve().parent)
        write_all(Run(opened, out, options, report, Stored(numbers, record, joins.results(numbers))), out)
    return report, joins.seams


def check_seams(
    chunks: Sequence[str | Path],
    *,
    of: Path | None = None,
    seam_bound: float = SEAM_BOUND,
    shot: str | Path | None = None,
) -> list[Seam]:
    """Measure the seams of consecutive chunks, without writing; chunks may still be missing.

    Args:
        chunks: As for `stitch`.
        of: A chunk, to measure its seams only; unrelated or incomplete chunks in its folder are ignored.
        seam_bound: As for `stitch`.
        shot: As for `stitch`.

    Returns:
        The seams, in order.

    Raises:
        UsageError: Chunks are not of one shot, version and set of options.
        LayerError: A frame is damaged, or a seam moves too far.
    """
    parts = chunks_in(chunks)
    if of is not None:
        (chunk,) = chunks_in([of])
        parts = [part for part in parts if part.shot == chunk.shot and part.is_whole]
    pairs = [pair for pair in pairwise(parts) if pair[0].numbers[-1] + 1 == pair[1].numbers[0]]
    if of is not None:
        pairs = [pair for pair in pairs if of.resolve() in [part.folder.resolve() for part in pair]]
    parts = list(dict.fromkeys(part for pair in pairs for part in pair))
    if not parts:
        return []
    _check_alike(parts, one_shot=shot is None)
    with closing(open_for(str(shot or parts[0].shot), parts[0].options())) as opened:
        check_same_shot(parts[0], made_from(opened, parts[0].folder, parts[0].options()))
        joins = _Joins(parts, opened, seam_bound, lambda *_: None)
        before = [k for start, first in joins.starts.items() for k in range(first, start)]
        deque(joins.results(sorted(joins.chunks.keys() & {*before})), maxlen=0)
    return joins.seams


def _make_folder(folder: Path) -> None:
    """Create a missing folder for a layer (LayerError)."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LayerError(f"cannot make the folder {folder}: {error.strerror}") from error


def chunks_in(paths: Sequence[str | Path], *, partial: bool = False) -> list[Chunk]:
    """The chunks sorted by frames; unrelated entries in a folder of chunks are ignored.

    Args:
        paths: Folders of chunks and chunks.
        partial: Whether a single place may be the folder of a stopped run's finished frames, or the run's layer.

    Raises:
        UsageError: A path is no such folder, or no frame is finished.
    """
    chunks: dict[Path, Chunk] = {}
    for path in map(Path, paths):
        if partial and (folder := stopped_run(path)) is not None:
            chunks[folder.resolve()] = Chunk(folder, record_in(folder))
            continue
        run = record_in(path)
        inside = [] if run or not path.is_dir() else [child for child in sorted(path.iterdir()) if record_in(child)]
        if not inside and not _is_of_chunk(run):
            alternative = "; --partial takes the finished frames of a stopped run" if stopped_run(path) else ""
            remedy = f"refine with --preroll makes one{alternative}"
            raise UsageError(f"{path} is no chunk of a shot, nor a folder of chunks; {remedy}")
        for folder in inside or [path]:
            if _is_of_chunk(record := record_in(folder)):
                chunks[folder.resolve()] = Chunk(folder, record)
    parts = [part for part in chunks.values() if part.numbers]
    if not parts:
        raise UsageError(f"there are no frames to stitch in {', '.join(map(str, paths)) or 'no folders'}")
    stopped = [part for part in parts if CHUNK not in part.run]
    if stopped and len(parts) > 1:
        raise UsageError(f"{stopped[0].folder} is of a stopped run, which is no chunk; give it alone")
    return sorted(parts, key=lambda part: part.numbers)


def stopped_run(path: Path) -> Path | None:
    """The folder of the finished frames of a stopped run, given the folder or the run's layer; None if it is neither.

    A run that goes on has such a folder too.
    """
    folder = path if path.is_dir() else frames_folder(path)
    run = record_in(folder)
    return folder if CHUNK not in run and _is_of_chunk({CHUNK: [], **run}) else None


def _is_of_chunk(run: Mapping[str, Any]) -> bool:
    """Whether a record is of a chunk, as written by `run`."""
    kinds = {CHUNK: list, "times": list, "levels": list, "options": dict, "inputs": dict, "shot": str}
    return all(isinstance(run.get(name), kind) for name, kind in kinds.items())


def _check_alike(parts: Sequence[Chunk], *, one_shot: bool) -> None:
    """Refuse chunks of different shots, versions or options."""
    first = parts[0]
    for part in parts[1:]:
        first_record, part_record = first.decisive(), part.decisive()
        if names := sorted(
            name for name in {*first_record, *part_record} if first_record.get(name) != part_record.get(name)
        ):
            raise UsageError(
                f"{part.folder} and {first.folder} were made with other {', '.join(names)}; refine one anew"
            )
        if one_shot and part.shot != first.shot:
            raise UsageError(
                f"{part.folder} is of {part.shot}, {first.folder} of {first.shot}; stitch chunks of one shot"
            )


def check_same_shot(part: Chunk, record: Mapping[str, Any]) -> None:
    """Refuse a shot changed since the chunk was refined, and a chunk of a different version of this package."""
    if _hashes(record) != _hashes(part.run):
        raise UsageError(f"the shot has changed since {part.folder} was refined from it; refine the chunks anew")
    if names := [name for name in ("version", "code") if record[name] != part.run.get(name)]:
        remedy = "stitch with the physgraph-usd that refined it, or refine the chunks anew"
        raise UsageError(f"{part.folder} was made with other {' and '.join(names)}; {remedy}")


def _hashes(run: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and digests of the shot's files, without folders."""
    return sorted((Path(name).name, str(value)) for name, value in run["inputs"].items())


def _check_frames(
    parts: Sequence[Chunk], frames: tuple[float, float] | None, *, partial: bool
) -> tuple[Sequence[int], Sequence[int]]:
    """Refuse doubled frames and, unless ``partial``, missing or unrequested frames.

    Returns:
        Numbers of the requested frames, and of those of them that are missing.
    """
    every = parts[0].run["times"]
    owners: dict[int, list[Chunk]] = {}
    for part in parts:
        for number in part.numbers:
            owners.setdefault(number, []).append(part)
    doubled = [number for number, folders in owners.items() if len(folders) > 1]
    if doubled:
        folders = sorted({str(part.folder) for number in doubled for part in owners[number]})
        times = _span([every[number] for number in doubled])
        raise UsageError(f"frames {times} are in more than one chunk: {', '.join(folders)}; leave one out")
    wanted = numbers_in([time for time in every if time is not None], frames)
    missing = [number for number in wanted if number not in owners]
    if missing and (not partial or len(missing) == len(wanted)):
        spans = ", ".join(f"{part.folder} ({_spans(part.times, every)})" for part in parts)
        remedy = "refine them, or go on by --resume" + ("" if partial else ", or leave them out by --partial")
        names = _spans([every[number] for number in missing], every)
        raise UsageError(f"frames {names} are in no chunk; those there: {spans}; {remedy}")
    for part in () if partial else parts:
        if not set(part.numbers) <= set(wanted):
            outside = f"{part.folder} holds the frames {_span(part.times)}, of which some lie outside --frames"
            raise UsageError(f"{outside}; leave it out")
    return [number for number in wanted if number in owners], missing


def _span(times: Sequence[float]) -> str:
    """First and last of some time codes, as in ``--frames``."""
    return f"{named_time(min(times))}:{named_time(max(times))}" if times else "none"


def _spans(times: Sequence[float], every: Sequence[float]) -> str:
    """Time codes as contiguous ranges within all time codes."""
    runs: list[list[float]] = []
    for time in times:
        if runs and every.index(time) == every.index(runs[-1][-1]) + 1:
            runs[-1].append(time)
        else:
            runs.append([time])
    return ", ".join(map(_span, runs))


def _moves(solutions: Both, joint: Joint, index: int, edges: np.ndarray) -> list[tuple[float, float]] | None:
    """Extra moves of a garment at a seam, RMS and largest, in mean edges; None if unknown.

    Joined frames move by equal parts of the difference plus the lag of blocked cloth; a jump moves by the whole
    difference.
    """
    moves, lag = [], np.zeros(1)
    jump: tuple[float, float] | None = None
    for k, ((earlier, after), frame) in enumerate(zip(solutions, joint.frames, strict=True), start=1):
        points = [result.garments[index].points if result.garments else None for result in (earlier, after, frame)]
        jump, (a, b, x) = None, points
        if a is None or b is None or x is None:
            continue
        a, b = a.astype(np.float64), b.astype(np.float64)
        edge = float(np.linalg.norm(a[edges[:, 0]] - a[edges[:, 1]], axis=1).mean())
        before, lag = lag, x - between(a, b, k / (len(solutions) + 1))
        part, jump = (b - a) / (len(solutions) + 1), _size(b - a, edge)
        moves.append(_size(part + lag - before, edge))
        if earlier is solutions[-1][0]:
            moves.append(_size(part - lag, edge))
    if jump is None:
        return None
    return [jump] if joint.why else moves


def _size(moves: np.ndarray, edge: float) -> tuple[float, float]:
    """RMS and largest length of vertex displacements, shape (V, 3), in edges."""
    distances = np.linalg.norm(moves, axis=1) / edge
    return float(np.sqrt(np.mean(distances**2))), float(distances.max(initial=0.0))
