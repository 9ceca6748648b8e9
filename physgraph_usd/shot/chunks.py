"""Solves a shot's time codes, in this process or in several, and hands the states back in order.

Each process opens the shot for itself and begins a few frames before its chunk (the pre-roll), so that warm starts have
settled when the chunk begins; over these frames, which two processes solve, `joined` goes from one result to the
other. Results go through files, so memory does not grow with the frames and what is finished outlives an interruption;
frames that an earlier run finished are not solved again.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NoReturn, Protocol

import numpy as np

from ..errors import LayerError, SolveError
from ..interrupts import leave_if_asked
from .frames import Finished, Folders, FrameFolder, Lead, Outcome
from .processes import POLL_SECONDS, Call, memory_is_named

PREROLL = 6
"""Frames solved before a chunk, when frames depend on one another."""

Solver = Callable[[Sequence[float | None]], Iterator[Outcome]]
"""Solves time codes in order; must be picklable to run in several processes."""


class Work(Protocol):
    """A function at work in another process, as `Call` is."""

    lag: float

    @property
    def ready(self) -> bool:
        """Whether it has returned, failed or died."""
        ...

    def result(self) -> Any:
        """The function's result; raises what ended it."""
        ...

    def ask_to_end(self) -> None:
        """Ask it to end, and do not wait."""
        ...

    def end(self) -> None:
        """End it, if it is still at work."""
        ...


def chunks_of(missing: Sequence[int], workers: int) -> list[list[range]]:
    """The frames of each worker, nearly equally many, as ranges without gaps; at most one entry per worker.

    Args:
        missing: Numbers of the frames to solve, in order.
        workers: Number of processes.
    """
    bounds = np.linspace(0, len(missing), min(workers, max(len(missing), 1)) + 1).round().astype(int)
    return [_ranges(missing[a:b]) for a, b in pairwise(bounds) if b > a]


def _ranges(numbers: Sequence[int]) -> list[range]:
    starts = [k for k in range(len(numbers)) if k == 0 or numbers[k] != numbers[k - 1] + 1]
    return [range(numbers[a], numbers[b - 1] + 1) for a, b in pairwise([*starts, len(numbers)])]


def seams_of(
    chunks: Sequence[Sequence[range]], frames: Finished | Folders, *, preroll: int
) -> dict[int, tuple[int, float]]:
    """The frames that are solved on both sides of a seam.

    Args:
        chunks: The frames of each worker.
        frames: Where results are; frames of an earlier run in it have seams of their own.
        preroll: Frames solved before each range.

    Returns:
        By the frame's number: that of the first frame after the seam, and its `Lead.weight`.
    """
    starts = frames.seams()
    parts = [part for chunk in chunks for part in chunk if part.start]
    # Where the frame after a range is an earlier run's, what goes on there is not what the range began.
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
    start: Callable[..., Work] | None = None,
) -> Generator[Outcome, None, None]:
    """Solve time codes but those that are kept, in this process or in several, and yield all in order.

    Args:
        solver: Solves time codes in order.
        times: The time codes.
        frames: Where results go; frames in its ``kept`` are taken from there.
        workers: Number of processes; 1 solves in this one.
        only: Numbers of the time codes to solve; None for all.
        preroll: Frames solved before each chunk but the first of the shot; they are yielded as the ``lead`` of the same
            frames of the chunk before.
        start: Starts a function in a process of its own, with its arguments, in place of `Call`; then one chunk is not
            solved in this process either.

    Raises:
        SolveError: A process died.
        LayerError: A result cannot be written.
    """
    wanted = range(len(times)) if only is None else only
    chunks = chunks_of([k for k in wanted if k not in frames.kept], workers)
    seams = seams_of(chunks, frames, preroll=preroll)
    solved: Iterator[int] = iter(())
    calls: list[Work] = []
    if len(chunks) < 2 and start is None:
        solved = _solve(solver, list(times), [part for chunk in chunks for part in chunk], frames, preroll)
    else:
        calls = [(start or Call)(_work, solver, list(times), chunk, frames, preroll) for chunk in chunks]
    owners = {k: call for chunk, call in zip(chunks, calls, strict=False) for part in chunk for k in part}
    try:
        for index in wanted:
            time = times[index]
            outcome = _collect(frames, index, time, owner=owners.get(index), solved=solved)
            if index in seams:
                seam, weight = seams[index]
                lead = frames.read(index, time, seam=seam)
                if lead is None and seam not in frames.kept:
                    lead = _collect(frames, index, time, owner=owners.get(seam), solved=solved, seam=seam)
                outcome = outcome if lead is None else replace(outcome, lead=Lead(lead, seam, weight))
            yield outcome
    finally:
        for call in calls:
            call.ask_to_end()
        for call in calls:
            call.end()


def finished_frames(
    frames: Folders, times: Sequence[float | None], numbers: Sequence[int], *, preroll: int
) -> Generator[Outcome, None, None]:
    """Yield frames that chunks hold, in order; where two chunks have a frame, the later one's is the ``lead``.

    Args:
        frames: The frames of the chunks.
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
        if index in starts:  # It may equal the last frame of the pre-roll, which is not the one before it here.
            outcome = replace(outcome, reused=(False,) * len(outcome.reused))
        seam, weight = seams.get(index, (None, 0.0))
        lead = None if seam is None else frames.read(index, times[index], seam=seam)
        yield outcome if lead is None or seam is None else replace(outcome, lead=Lead(lead, seam, weight))


def _solve(
    solver: Solver, times: Sequence[float | None], chunk: Sequence[range], frames: FrameFolder, preroll: int
) -> Iterator[int]:
    """Solve ranges of frames, each after its pre-roll, and file them; yields the number of each when it is there."""
    for part in chunk:
        first = max(0, part.start - preroll)
        with memory_is_named():
            for index, outcome in enumerate(solver(times[first : part.stop]), start=first):
                frames.write(index, outcome, seam=part.start if index < part.start else None)
                yield index


def _work(*job: Any) -> None:
    """Solve a chunk in a worker process."""
    for _ in _solve(*job):
        pass


def _collect(
    frames: FrameFolder,
    index: int,
    time: float | None,
    *,
    owner: Work | None,
    solved: Iterator[int],
    seam: int | None = None,
) -> Outcome:
    """Read a frame's file once its owner, or without one ``solved``, has made it; ``seam`` as `FrameFolder.read`."""
    ended: float | None = None
    while True:
        leave_if_asked()
        over = owner is not None and owner.ready
        outcome = frames.read(index, time, seam=seam)
        if outcome is not None:
            return outcome
        if owner is None:
            if next(solved, None) is None:
                _lost(time)
            continue
        if over:
            owner.result()
            ended = ended or clock.monotonic()
            if clock.monotonic() - ended >= owner.lag:
                _lost(time)
        clock.sleep(POLL_SECONDS)


def _lost(time: float | None) -> NoReturn:
    raise SolveError(f"a worker ended without the result of time code {time}")
