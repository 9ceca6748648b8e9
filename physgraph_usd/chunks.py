"""Splits a shot's time codes over processes, and hands the states back in order.

Each process opens the shot for itself and begins a few frames before its chunk (the run-up), so that warm starts have
settled when the chunk begins. Results travel as files in a temporary folder, so memory does not grow with the frames.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import tempfile
import threading
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from .errors import SolveError

RUN_UP = 6
"""Frames solved before a chunk and thrown away, when frames depend on one another."""
POLL_SECONDS = 0.02


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of one time code.

    Attributes:
        time: The time code; None for a shot without samples.
        points: Fine world positions [m] of each garment, None where it has no sample; () when the solve failed.
        reused: For each garment, True when it kept the previous frame's points.
        record: Telemetry, or {"error": message}, ready for JSON.
        heat: Heat maps of each garment by name, None where it has no sample; () when none was asked for.
    """

    time: float | None
    points: tuple[np.ndarray | None, ...]
    reused: tuple[bool, ...]
    record: dict[str, object]
    heat: tuple[dict[str, np.ndarray] | None, ...] = ()


Solver = Callable[[Sequence[float | None]], Iterator[Outcome]]
"""Solves time codes in order; must be picklable to run in several processes."""


def chunks_of(times: Sequence[float | None], workers: int) -> list[tuple[int, int]]:
    """Contiguous index ranges of nearly equal length, at most one per worker."""
    bounds = np.linspace(0, len(times), min(workers, max(len(times), 1)) + 1).round().astype(int)
    return [(int(a), int(b)) for a, b in pairwise(bounds) if b > a]


def solve_in_chunks(
    solver: Solver, times: Sequence[float | None], *, workers: int, run_up: int = RUN_UP
) -> Iterator[Outcome]:
    """Solve all time codes, in this process or in several, and yield them in order.

    Args:
        solver: Solves time codes in order.
        times: The time codes.
        workers: Number of processes; 1 solves in this one.
        run_up: Frames solved before each later chunk.

    Raises:
        SolveError: A process died.
    """
    parts = chunks_of(times, workers)
    if len(parts) < 2:
        yield from solver(times)
        return
    folder = Path(tempfile.mkdtemp(prefix="physgraph-"))
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(len(parts), mp_context=context, initializer=end_with_parent, initargs=(folder,))
    try:
        futures = [
            pool.submit(_solve_chunk, solver, list(times[max(0, a - run_up) : b]), a - max(0, a - run_up), folder, a)
            for a, b in parts
        ]
        for (a, b), future in zip(parts, futures, strict=True):
            for index in range(a, b):
                yield _collect(folder / f"{index}.npz", times[index], future)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        shutil.rmtree(folder, ignore_errors=True)


def end_with_parent(folder: Path | None = None) -> None:
    """End this worker process and remove its folder when the process that started it is gone, even if it was killed."""
    threading.Thread(target=_outlast_parent, args=(folder,), daemon=True).start()


def _outlast_parent(folder: Path | None) -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        os._exit(1)


def _solve_chunk(solver: Solver, times: list[float | None], skip: int, folder: Path, first: int) -> None:
    """Solve a chunk in a process of its own and leave one file a frame."""
    for position, outcome in enumerate(solver(times)):
        if not folder.exists():
            return
        if position < skip:
            continue
        index = first + position - skip
        partial = folder / f"{index}.part.npz"
        arrays: dict[str, Any] = {f"points{k}": p for k, p in enumerate(outcome.points) if p is not None}
        maps = [(k, name, values) for k, heat in enumerate(outcome.heat) for name, values in (heat or {}).items()]
        arrays |= {f"heat{k}.{name}": values for k, name, values in maps} | {"heated": np.array(len(outcome.heat))}
        arrays |= {"record": json.dumps(outcome.record), "reused": np.array(outcome.reused, dtype=bool)}
        np.savez(partial, **arrays)
        partial.rename(folder / f"{index}.npz")


def _collect(file: Path, time: float | None, future: Future[None]) -> Outcome:
    """Wait for one frame's file, read it and remove it."""
    while not file.exists():
        if future.done():
            _raise_if_dead(future)
            if not file.exists():
                raise SolveError(f"a worker ended without the result of time code {time}")
        clock.sleep(POLL_SECONDS)
    with np.load(file) as data:
        record = json.loads(str(data["record"]))
        reused = tuple(bool(value) for value in data["reused"])
        names = [f"points{k}" for k in range(len(reused))]
        points = tuple(data[name] if name in data.files else None for name in names)
        heat = tuple(_heat_of(data, k) if points[k] is not None else None for k in range(int(data["heated"])))
    file.unlink()
    return Outcome(time, points, reused, record, heat)


def _heat_of(data: Mapping[str, np.ndarray], index: int) -> dict[str, np.ndarray]:
    """The heat maps of one garment in a frame's file."""
    prefix = f"heat{index}."
    return {name.removeprefix(prefix): data[name] for name in data if name.startswith(prefix)}


def _raise_if_dead(future: Future[None]) -> None:
    try:
        future.result()
    except BrokenProcessPool as error:
        raise SolveError("a worker process died, perhaps for lack of memory; use fewer --workers") from error
