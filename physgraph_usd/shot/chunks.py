"""Solves a shot's time codes, in this process or in several, and reads the stored results in frame order.

Each process opens the shot itself and starts a few frames before its chunk (the pre-roll), to settle its warm starts by
the first frame of the chunk. Results are stored in files: memory does not grow with the frame count, finished frames
survive an interruption, and a later run does not solve finished frames again. `stitch` reads the folders of other runs
in the same way.

Two processes solve the L frames of a pre-roll, and cloth with several possible folds settles differently after each
history. The positions move from one solution to the other in equal parts,

    x_k = (1 - s_k) a_k + s_k b_k,   s_k = k / (L + 1),   k = 1 .. L,

and the seam adds |b - a| / (L + 1) to a frame's move instead of |b - a| at once. The cloth moves from the nearer
solution towards the blend as far as no new intersection appears, and is pushed out of bodies. If the input itself
intersects, the safe move guarantees less: if the blend has more crossings, or more vertices in bodies, than both
solutions, nothing is joined and the cloth jumps.
"""

from __future__ import annotations

import time as clock
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import chain, pairwise
from math import inf
from typing import Any

import numpy as np

from ..errors import SolveError, named_time
from ..interrupts import leave_if_asked
from ..solver.scene import Result
from .findings.table import FINDINGS, Text
from .frames import FrameFolder
from .workers import POLL_SECONDS, Start, memory_is_named, result_of

PREROLL = 6
"""Frames solved before a chunk if frames depend on their predecessors."""

LATE_SECONDS = 60.0
"""Longest time for a file to appear after its process has ended [s]: network file systems cache missing files."""
Solver = Callable[[Sequence[float | None]], Iterator[Result]]
"""Solves time codes in order; must be picklable to run in several processes."""
Read = Callable[[int, int | None], Result]
"""Reads a frame by number, solved as usual (None) or in the pre-roll of the chunk that starts at a number."""
Both = Sequence[tuple[Result, Result]]
"""The frames before a seam, each with the solution of the process behind the seam."""
Positions = Sequence[np.ndarray | None]
"""Points of each garment, shape (V, 3), None for a garment without a sample."""
Mover = Callable[[float | None, Positions, Positions, Positions], tuple[Positions, str]]
"""Moves cloth safely at a time code from the nearer solution towards wanted positions; the farther solution is the
third argument. Also returns a description of new intersections, "" for none. One mover moves the frames of a seam in
order, without a history of earlier frames."""
Movers = Callable[[], Mover]
"""Returns a new mover, for the frames of one seam."""
Join = Callable[[int, Both], Iterable[Result]]
"""Joins the frames before the seam at a number."""


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


def frames_in_order(
    read: Read, numbers: Iterable[int], seams: Mapping[int, int], *, join: Join | None
) -> Generator[Result, None, None]:
    """Yield frames in order, those before each seam joined.

    Args:
        read: Reads a frame.
        numbers: Numbers of the frames.
        seams: By number of the first frame after a seam, number of the first frame of its pre-roll.
        join: Joins the frames before a seam; None leaves them as solved before the seam.
    """
    ends = {index: seam for seam, before in _joined_at(seams).items() for index in before}
    pairs: list[tuple[Result, Result]] = []
    for index in numbers:
        leave_if_asked()
        result = read(index, None)
        if index in seams:
            result = result.as_changed()
        if join is None or index not in ends:
            yield result
            continue
        pairs.append((result, read(index, ends[index])))
        if index + 1 == ends[index]:
            yield from join(ends[index], pairs)
            pairs = []


def _joined_at(seams: Mapping[int, int]) -> dict[int, range]:
    """Numbers of the frames joined at each seam: its pre-roll, as far as no earlier seam is in it."""
    starts = [0, *sorted(seams)]
    return {start: range(max(seams[start], before), start) for before, start in pairwise(starts)}


def solve_in_chunks(
    solver: Solver,
    times: Sequence[float | None],
    frames: FrameFolder,
    *,
    workers: int,
    movers: Movers | None,
    warn: Callable[..., object],
    only: Sequence[int] | None = None,
    preroll: int = PREROLL,
    start: Start | None = None,
) -> Generator[Result, None, None]:
    """Solve all time codes except the kept ones, in this process or in several, and yield all in order.

    Args:
        solver: Solves time codes in order.
        frames: Folder of the results; frames in ``frames.kept`` are read from the folder.
        workers: Number of chunks.
        movers: Give a mover of cloth, to join the frames before each seam; picklable. None leaves them unjoined.
        warn: Called with the warnings of a seam.
        only: Numbers of the time codes to solve; None for all.
        preroll: Frames solved before each chunk except the shot's first.
        start: Starts a chunk in another process; None solves in this process.

    Raises:
        SolveError: A process died.
        LayerError: A result cannot be written.
    """
    wanted = range(len(times)) if only is None else only
    chunks = chunks_of([k for k in wanted if k not in frames.kept], workers)
    parts = [part for chunk in chunks for part in chunk]
    # If an earlier run solved the frame after a range, the motion continues from the earlier run, not from the range.
    new = [part.start for part in parts if part.stop not in frames.kept or part.stop in frames.seams]
    seams = frames.seams | {first: max(0, first - preroll) for first in new}
    solved: Iterator[int] = iter(())
    calls: dict[int, Future[dict[int, Joint]]] = {}
    if start is None:
        solved = _solve(solver, list(times), parts, frames, preroll)
    else:
        called = [start(_work, (solver, list(times), chunk, frames, preroll), seams, movers) for chunk in chunks]
        calls = {k: call for chunk, call in zip(chunks, called, strict=True) for part in chunk for k in part}

    def read(index: int, seam: int | None) -> Result:
        stored = partial(frames.read, index, times[index], seam=seam)
        return _await(stored, times[index], call=calls.get(index if seam is None else seam), solved=solved)

    def joined(seam_movers: Movers, seam: int, pairs: Both) -> Sequence[Result]:
        finished = result_of(calls[seam - 1]).get(seam) if seam - 1 in calls else None
        joint = finished or join(pairs, seam_movers)
        warn(*joint.warnings)
        return joint.frames

    yield from frames_in_order(read, wanted, seams, join=partial(joined, movers) if movers else None)


def _solve(
    solver: Solver, times: Sequence[float | None], chunk: Sequence[range], frames: FrameFolder, preroll: int
) -> Iterator[int]:
    """Solve ranges of frames, each after its pre-roll, and store them; yields each frame's number once stored."""
    for part in chunk:
        first = max(0, part.start - preroll)
        with memory_is_named():
            for index, result in enumerate(solver(times[first : part.stop]), start=first):
                frames.write(index, result, seam=part.start if index < part.start else None)
                yield index


def _work(job: tuple[Any, ...], seams: Mapping[int, int], movers: Movers | None) -> dict[int, Joint]:
    """Solve a chunk in a worker process, and join its frames before each seam if the next chunk's are there."""
    deque(_solve(*job), maxlen=0)
    joints: dict[int, Joint] = {}
    if movers is None:
        return joints
    _, times, chunk, frames, _ = job
    numbers, chunk_movers = {index for part in chunk for index in part}, movers

    def read(index: int, seam: int | None) -> Any:
        return frames.read(index, times[index], seam=seam)

    def joined(seam: int, pairs: Both) -> Sequence[Result]:
        joints[seam] = join(pairs, chunk_movers)
        return joints[seam].frames

    before = [
        frames
        for seam, frames in _joined_at(seams).items()
        if numbers.issuperset(frames) and all(read(k, seam) for k in frames)
    ]
    deque(frames_in_order(read, chain(*before), seams, join=joined), maxlen=0)
    return joints


def _await(
    stored: Callable[[], Result | None], time: float | None, *, call: Future[Any] | None, solved: Iterator[int]
) -> Result:
    """A result once ``call``, or ``solved`` in this process, has stored it."""
    latest = inf
    while (result := stored()) is None:
        leave_if_asked()
        if clock.monotonic() > latest or (call is None and next(solved, None) is None):
            raise SolveError(f"a worker ended without the result of time code {time}")
        if call is not None and call.done():
            result_of(call, time=time)
            latest = min(latest, clock.monotonic() + LATE_SECONDS)
        if call is not None:
            clock.sleep(POLL_SECONDS)
    return result


@dataclass(frozen=True, eq=False)
class Joint:
    """The frames of one seam.

    Attributes:
        frames: The joined frames; the frames before the seam unchanged if the cloth jumps.
        why: Reason for a jump, or "".
    """

    frames: Sequence[Result]
    why: str

    @property
    def warnings(self) -> list[Text]:
        """A warning if the cloth jumps."""
        last = named_time(self.frames[-1].time)
        return [FINDINGS["seam_jump"](last=last, why=self.why)] if self.why else []


def join(solutions: Both, movers: Movers) -> Joint:
    """Join the frames of one seam.

    Args:
        solutions: The frames before the seam, each with the solution of the process behind the seam.
        movers: Asked for a mover if any frame differs.
    """
    frames, mover = list[Result](), cache(movers)
    for k, (earlier, after) in enumerate(solutions, start=1):
        garments, weight = zip(earlier.garments, after.garments, strict=False), k / (len(solutions) + 1)
        pairs = [(a.points, b.points) for a, b in garments]
        if all(a is None or b is None or np.array_equal(a, b) for a, b in pairs):
            frames.append(earlier)
            continue
        wanted = [a if a is None or b is None else between(a, b, weight) for a, b in pairs]
        near, far = [a for a, _ in pairs], [b for _, b in pairs]
        points, reason = mover()(earlier.time, *((near, far) if weight < 0.5 else (far, near)), wanted)
        leave_if_asked()  # A signal may have cut the move short.
        if reason:
            return Joint([earlier for earlier, _ in solutions], reason)
        moved = zip(earlier.garments, points, strict=True)
        frames.append(replace(earlier, garments=tuple(replace(g, points=x, reused=False) for g, x in moved)))
    return Joint(frames, "")


def between(before: np.ndarray, after: np.ndarray, weight: float) -> np.ndarray:
    """Points between two solutions, float64; equal points are unchanged to the bit."""
    start = before.astype(np.float64)
    return start + weight * (after.astype(np.float64) - start)


def worse(paths: Sequence[str], contacts: Sequence[Mapping[str, Any]], *sides: Sequence[Mapping[str, Any]]) -> str:
    """The first garment with more crossings than in all compared solutions, in words, or "".

    Args:
        paths: Paths of the garments.
        contacts: Contact telemetry of each garment.
        sides: The same of each compared solution.
    """
    for path, contact, *contacts_beside in zip(paths, contacts, *sides, strict=True):
        before = [counts(side) for side in contacts_beside]
        for name, count in counts(contact).items():
            if count > max((side_counts.get(name, 0) for side_counts in before), default=0):
                return f"joined, <{path}> would have {count:,} {name}"
    return ""


def counts(contact: Mapping[str, Any]) -> dict[str, int]:
    """Numbers of crossing edges and of vertices in bodies, from contact telemetry."""
    bodies = {f"vertices inside <{path}>": body["after"]["inside"] for path, body in contact.get("bodies", {}).items()}
    return {"edges through cloth": contact.get("cloth", {}).get("after", {}).get("crossings", 0)} | bodies
