"""Solves a shot's time codes, in this process or in several, and hands the states back in order.

Each process opens the shot for itself and begins a few frames before its chunk (the run-up), so that warm starts have
settled when the chunk begins. Results go through files, so memory does not grow with the frames and what is finished
outlives an interruption; frames that an earlier run finished are not solved again.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Generator, Iterator, Sequence
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from .errors import SolveError
from .frames import FrameFolder, Outcome
from .processes import POLL_SECONDS, Call, memory_is_named

RUN_UP = 6
"""Frames solved before a chunk and thrown away, when frames depend on one another."""

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
        """What the function returned; raises what ended it."""
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
    shares = [missing[a:b] for a, b in pairwise(bounds) if b > a]
    return [_ranges(share) for share in shares]


def _ranges(numbers: Sequence[int]) -> list[range]:
    starts = [k for k in range(len(numbers)) if k == 0 or numbers[k] != numbers[k - 1] + 1]
    return [range(numbers[a], numbers[b - 1] + 1) for a, b in pairwise([*starts, len(numbers)])]


def solve_in_chunks(
    solver: Solver,
    times: Sequence[float | None],
    frames: FrameFolder,
    *,
    workers: int,
    run_up: int = RUN_UP,
    skip: int = 0,
    start: Callable[..., Work] | None = None,
) -> Generator[Outcome, None, None]:
    """Solve all time codes but those that are kept, in this process or in several, and yield all in order.

    Args:
        solver: Solves time codes in order.
        times: The time codes.
        frames: Where results go; frames in its ``kept`` are taken from there.
        workers: Number of processes; 1 solves in this one.
        run_up: Frames solved before each chunk but the first of the shot.
        skip: How many of the first time codes serve for a run-up alone; they are not yielded.
        start: What starts a function in a process of its own, with its arguments, in place of `Call`; then one chunk
            is not solved in this process either.

    Raises:
        SolveError: A process died.
        LayerError: A result cannot be written.
    """
    wanted = range(skip, len(times))
    shares = chunks_of([k for k in wanted if k not in frames.kept], workers)
    if len(shares) < 2 and start is None:
        solved = (pair for share in shares for pair in _solve(solver, times, share, frames=frames, run_up=run_up))
        for index in wanted:
            time = times[index]
            yield (frames.read(index, time) if index in frames.kept else next(solved, (0, None))[1]) or _lost(time)
        return
    calls = [(start or Call)(_work, solver, list(times), share, frames, run_up) for share in shares]
    owners = {k: call for share, call in zip(shares, calls, strict=True) for part in share for k in part}
    try:
        for index in wanted:
            yield _collect(frames, index, times[index], owner=owners.get(index))
    finally:
        for call in calls:
            call.end()


def _solve(
    solver: Solver, times: Sequence[float | None], share: Sequence[range], *, frames: FrameFolder, run_up: int
) -> Iterator[tuple[int, Outcome]]:
    """Solve ranges of frames, each after its run-up, and file them."""
    for part in share:
        first = max(0, part.start - run_up)
        with memory_is_named():
            for index, outcome in enumerate(solver(times[first : part.stop]), start=first):
                if index >= part.start:
                    frames.write(index, outcome)
                    yield index, outcome


def _work(
    solver: Solver, times: Sequence[float | None], share: Sequence[range], frames: FrameFolder, run_up: int
) -> None:
    """What a worker process does."""
    for _ in _solve(solver, times, share, frames=frames, run_up=run_up):
        pass


def _collect(frames: FrameFolder, index: int, time: float | None, *, owner: Work | None) -> Outcome:
    """Wait for one frame's file and read it."""
    ended: float | None = None
    while True:
        over = owner is None or owner.ready
        outcome = frames.read(index, time)
        if outcome is not None:
            return outcome
        if over:
            if owner is not None:
                owner.result()
            ended = ended or clock.monotonic()
            if owner is None or clock.monotonic() - ended >= owner.lag:
                _lost(time)
        clock.sleep(POLL_SECONDS)


def _lost(time: float | None) -> Outcome:
    raise SolveError(f"a worker ended without the result of time code {time}")
