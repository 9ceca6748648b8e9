"""Solves a shot's time codes, in this process or in several, and returns the results in frame order.

Each process opens the shot itself and starts a few frames before its chunk (the pre-roll), to settle its warm starts by
the first frame of the chunk. Two processes solve the frames of a pre-roll; `joined` blends the two solutions. Results
are stored in files: memory does not grow with the frame count, finished frames survive an interruption, and a later run
does not solve finished frames again.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from itertools import pairwise
from typing import Any, NoReturn

import numpy as np

from ..errors import LayerError, SolveError
from ..interrupts import leave_if_asked
from .frames import Finished, Folders, FrameFolder, Lead, Outcome
from .joined import Mover, join
from .processes import POLL_SECONDS, Start, memory_is_named, result_of, wait_for

PREROLL = 6
"""Frames solved before a chunk if frames depend on their predecessors."""

LATE_SECONDS = 60.0
"""Longest time for a file to appear after its process has ended [s]: network file systems cache missing files."""
Solver = Callable[[Sequence[float | None]], Iterator[Outcome]]
"""Solves time codes in order; must be picklable to run in several processes."""
Seams = Mapping[int, tuple[int, float]]
"""By number of a frame solved on both sides of a seam: number of the first frame after the seam, and `Lead.weight`."""


def chunks_of(missing: Sequence[int], workers: int) -> list[list[range]]:
    """Split frames nearly evenly among workers, as ranges without gaps; at most one entry per worker.

    Args:
        missing: Numbers of the frames to solve, in order.
        workers: Number of processes.
    """
    bounds = np.linspace(0, len(missing), min(workers, max(len(missing), 1)) + 1).round().astype(int)
    return [_ranges(missing[a:b]) for a, b in pairwise(bounds) if b > a]


def _ranges(numbers: Sequence[int]) -> list[range]:
    starts = [k for k in range(len(numbers)) if k == 0 or numbers[k] != numbers[k - 1] + 1]
    return [range(numbers[a], numbers[b - 1] + 1) for a, b in pairwise([*starts, len(numbers)])]


def seams_of(chunks: Sequence[Sequence[range]], frames: Finished | Folders, *, preroll: int) -> Seams:
    """Find the frames solved on both sides of a seam.

    Args:
        chunks: The frames of each worker.
        frames: Stored results; frames of an earlier run have their own seams.
        preroll: Frames solved before each range.
    """
    starts = frames.seams()
    parts = [part for chunk in chunks for part in chunk if part.start]
    # If an earlier run solved the frame after a range, the motion continues from the earlier run, not from the range.
    starts |= {part.start for part in parts if part.stop not in frames.kept or part.stop in starts}
    found: dict[int, tuple[int, float]] = {}
    before = 0
    for start in sorted(starts):
        both = range(max(start - preroll, before), start)
        found |= {index: (start, (k + 1) / (len(both) + 1)) for k, index in enumerate(both)}
        before = start
    return found


def solve_in_chunks(
    solver: Solver,
    times: Sequence[float | None],
    frames: FrameFolder,
    *,
    workers: int,
    only: range | None = None,
    preroll: int = PREROLL,
    start: Start | None = None,
    mover: Mover | None = None,
) -> Generator[Outcome, None, None]:
    """Solve all time codes except the kept ones, in this process or in several, and yield all in order.

    Args:
        solver: Solves time codes in order.
        frames: Folder of the results; frames in ``frames.kept`` are read from the folder.
        workers: Number of chunks.
        only: Numbers of the time codes to solve; None for all.
        preroll: Frames solved before each chunk except the shot's first; yielded as the ``lead`` of the same frames of
            the previous chunk.
        start: Starts a chunk in another process; None solves in this process.
        mover: Moves cloth safely; other processes then join the frames before a seam once both sides are solved, and
            a ``lead`` holds the joined frame. Picklable.

    Raises:
        SolveError: A process died.
        LayerError: A result cannot be written.
    """
    wanted = range(len(times)) if only is None else only
    chunks = chunks_of([k for k in wanted if k not in frames.kept], workers)
    seams = seams_of(chunks, frames, preroll=preroll)
    solved: Iterator[int] = iter(())
    owners: dict[int, Future[None]] = {}
    if start is None:
        solved = _solve(solver, list(times), [part for chunk in chunks for part in chunk], frames, preroll)
    else:
        calls = [start(_work, (solver, list(times), chunk, frames, preroll), seams, mover) for chunk in chunks]
        owners = {k: call for chunk, call in zip(chunks, calls, strict=True) for part in chunk for k in part}
    for index in wanted:
        time = times[index]
        outcome = _collect(frames, index, time, owner=owners.get(index), solved=solved)
        if index in seams:
            seam, weight = seams[index]
            lead = frames.read(index, time, seam=seam)
            if lead is None and seam not in frames.kept:
                lead = _collect(frames, index, time, owner=owners.get(seam), solved=solved, seam=seam)
            if index in owners:
                wait_for(owners[index])  # It may join its last frames with the next chunk.
            made = frames.read(index, time, seam=seam, joined=True)
            outcome = outcome if lead is None else replace(outcome, lead=Lead(lead, seam, weight, made))
        yield outcome


def finished_frames(
    frames: Folders, times: Sequence[float | None], numbers: Sequence[int], *, preroll: int
) -> Generator[Outcome, None, None]:
    """Yield the frames of chunks in order; if two chunks hold a frame, the later chunk's result is the ``lead``.

    Args:
        times: Time codes of the shot.
        numbers: Numbers of the frames to yield.
        preroll: Frames solved before each chunk.
    """
    starts, seams = frames.seams(), seams_of([], frames, preroll=preroll)
    for index in numbers:
        leave_if_asked()
        outcome = frames.read(index, times[index])
        if outcome is None:
            raise LayerError(f"the result of time code {times[index]} is gone; refine it anew by --resume")
        if index in starts:  # "Reused" refers to the last pre-roll frame, not to the previous frame here.
            outcome = replace(outcome, reused=(False,) * len(outcome.reused))
        seam, weight = seams.get(index, (None, 0.0))
        lead = None if seam is None else frames.read(index, times[index], seam=seam)
        made = None if seam is None else frames.read(index, times[index], seam=seam, joined=True)
        yield outcome if lead is None or seam is None else replace(outcome, lead=Lead(lead, seam, weight, made))


def _solve(
    solver: Solver, times: Sequence[float | None], chunk: Sequence[range], frames: FrameFolder, preroll: int
) -> Iterator[int]:
    """Solve ranges of frames, each after its pre-roll, and store them; yields each frame's number once stored."""
    for part in chunk:
        first = max(0, part.start - preroll)
        with memory_is_named():
            for index, outcome in enumerate(solver(times[first : part.stop]), start=first):
                frames.write(index, outcome, seam=part.start if index < part.start else None)
                yield index


def _work(job: tuple[Any, ...], seams: Seams, mover: Mover | None) -> None:
    """Solve a chunk in a worker process, and join its frames before a seam if the next chunk's are there."""
    for _ in _solve(*job):
        pass
    _, times, chunk, frames, _ = job
    own = {index for part in chunk for index in part}
    for start in sorted({start for start, _ in seams.values()}) if mover else ():
        numbers = [index for index, (seam, _) in seams.items() if seam == start]
        if mover and own.issuperset(numbers):
            _join(frames, {index: times[index] for index in numbers}, seams, mover)


def _join(frames: FrameFolder, times: Mapping[int, float | None], seams: Seams, mover: Mover) -> None:
    """Join and store the frames before a seam, by number, unless the next chunk's are missing or the cloth jumps."""
    both = list[tuple[Outcome, Lead]]()
    for index, time in times.items():
        seam, weight = seams[index]
        own, lead = frames.read(index, time), frames.read(index, time, seam=seam)
        if own is None or lead is None:
            return
        both.append((own, Lead(lead, seam, weight)))
    joint = join(both, mover)
    for index, outcome in zip(times, joint.frames, strict=True) if not joint.why else ():
        frames.write(index, outcome, seam=seams[index][0], joined=True)


def _collect(
    frames: FrameFolder,
    index: int,
    time: float | None,
    *,
    owner: Future[None] | None,
    solved: Iterator[int],
    seam: int | None = None,
) -> Outcome:
    """Read a frame once its owner, or ``solved`` without an owner, has stored it; ``seam`` as in `FrameFolder.read`."""
    latest: float | None = None
    while True:
        leave_if_asked()
        over = owner is not None and owner.done()
        outcome = frames.read(index, time, seam=seam)
        if outcome is not None:
            return outcome
        if owner is None:
            if next(solved, None) is None:
                _lost(time)
            continue
        if over:
            result_of(owner, time=time)
            latest = latest or clock.monotonic() + LATE_SECONDS
            if clock.monotonic() > latest:
                _lost(time)
        clock.sleep(POLL_SECONDS)


def _lost(time: float | None) -> NoReturn:
    raise SolveError(f"a worker ended without the result of time code {time}")
