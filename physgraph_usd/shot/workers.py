"""Runs calls elsewhere: in processes of this machine, by `concurrent.futures`, or on the workers of a Dask scheduler.

A process that dies costs its own call alone. On a farm, a task solves a chunk and stores the frames in the folder
beside the layer; every worker must see the folder under the same path. If a worker dies, the scheduler restarts its
task on a new worker and the same files are written again.
"""

from __future__ import annotations

import contextlib
import importlib
import itertools
import math
import multiprocessing
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from functools import partial
from multiprocessing.context import BaseContext
from typing import Any

from ..errors import PhysGraphError, SolveError, UsageError, exceptions_named, named, named_time
from ..interrupts import exit_code_of, leave_if_asked, signals_noted
from ..version import __version__, code_digest

POLL_SECONDS = 0.02
PATIENCE_SECONDS = 10.0
"""Time for a process to clean up after it was asked to end [s]."""
_MEMORY = re.compile(r"out of memory|n.t allocate|to allocate|bad_alloc", re.IGNORECASE)

_THREADS = "OMP_NUM_THREADS"
_PRELOAD = ["physgraph_usd.shot.refine", "physgraph_usd.shot.run"]
"""Imported once for all processes, on Linux: torch, Warp and the solver take 3 s."""

Start = Callable[..., Future[Any]]
"""Starts a function with arguments in another process; all of them and the result must be picklable."""
RETRIES = 2
"""Restarts of a task after an unforeseen error, such as a disk not yet mounted."""
CONNECT_SECONDS = 10.0
"""Longest wait for the scheduler, and for its first worker."""


def cores() -> int:
    """Number of cores that this process may use, at most OMP_NUM_THREADS."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    most = os.environ.get(_THREADS, "")
    return min(count, int(most)) if most.isdecimal() and int(most) else count


def import_ahead() -> None:
    """Start the server process of `_context`, which imports the solver meanwhile; nothing except on Linux."""
    _context()


def _context() -> BaseContext:
    """Start method of processes: on Linux, fork of a server process that has imported the solver; else a new process.

    The libraries of macOS may crash in a forked process. Ctrl-C in a terminal reaches the server too, which would print
    a traceback of its imports; the server inherits the blocked signal.
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOAD)
    importlib.import_module("multiprocessing.resource_tracker").ensure_running()  # Would unblock the signal.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        importlib.import_module("multiprocessing.forkserver").ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


@contextlib.contextmanager
def separate_processes(workers: int, *, cards: Sequence[str] = ()) -> Iterator[Start]:
    """Start each call in a new process; calls still running at the end of the block are ended.

    A pool of processes breaks as a whole when one of them dies, so each call has a pool of one.

    Args:
        workers: Most calls at a time; later calls wait.
        cards: Cards that calls use in turn, as CUDA_VISIBLE_DEVICES names them; all see all cards without any.
    """
    context, over = _context(), threading.Event()
    turns, threads = itertools.cycle(cards or [None]), max(1, cores() // workers)
    pids: set[int] = set()

    def call(function: Callable[..., Any], *args: Any) -> Any:
        with ProcessPoolExecutor(1, context, initializer=_begin, initargs=(next(turns), threads)) as pool:
            pids.add(pool.submit(os.getpid).result())
            return None if over.is_set() else pool.submit(_answer, function, *args).result()

    with ThreadPoolExecutor(workers) as callers:
        try:
            yield partial(callers.submit, call)
        finally:
            over.set()
            callers.shutdown(wait=False, cancel_futures=True)
            running = [child for child in multiprocessing.active_children() if child.pid in pids]
            for child in running:
                child.terminate()
            for child in running:
                child.join(PATIENCE_SECONDS)
                child.kill()


def call_each(
    function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], *, workers: int, cards: Sequence[str] = ()
) -> Generator[Any, None, None]:
    """Call a function once per job, each call in a new process, and yield results in order.

    Args:
        function: The function; picklable.
        jobs: Arguments of each call.
        workers: Most calls at a time.
        cards: As in `separate_processes`.

    Returns:
        Per job the result, or the `PhysGraphError` raised.
    """
    with separate_processes(workers, cards=cards) as start:
        for future in [start(function, *job) for job in jobs]:
            try:
                yield result_of(future)
            except PhysGraphError as error:
                yield error


def result_of(future: Future[Any], *, time: float | None = None) -> Any:
    """Wait for a call's result.

    Args:
        future: The call.
        time: Time code of the call's work at its end, for the message.

    Raises:
        PhysGraphError: Raised or returned by the function; other exceptions are converted by `named`.
        SolveError: The process died, or a farm dropped the call.
    """
    while not future.done():
        leave_if_asked()
        wait([future], POLL_SECONDS)
    at = "" if time is None else f" at time code {named_time(time)}"
    if future.cancelled():
        raise SolveError(f"a call was cancelled{at}: the farm's scheduler is gone, or dropped the call")
    error = future.exception()
    answer = future.result() if error is None else error
    if isinstance(answer, PhysGraphError):
        raise answer
    if error is None:
        return answer
    if isinstance(error, BrokenExecutor) and error.__cause__ is None:
        remedy = "if memory ran out, use fewer --workers or a lower --level"
        raise SolveError(f"a worker process died{at}; {remedy}")
    raise named(error, time=time) from error


@contextlib.contextmanager
def memory_is_named() -> Iterator[None]:
    """Convert libraries' out-of-memory errors to a `SolveError`.

    Raises:
        SolveError: Memory ran out.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not _MEMORY.search(str(error)):
            raise
        if "cuda" in str(error).lower():
            raise SolveError("out of memory on the CUDA device; a lower --level or --device cpu may do") from error
        raise SolveError("out of memory; a lower --level or fewer --workers needs less") from error


def _begin(card: str | None, threads: int) -> None:
    """Prepare a worker process: threads, the card if any, no Ctrl-C, which is the parent's; end with the parent."""
    os.environ[_THREADS] = str(threads)
    if card is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = card
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _answer(function: Callable[..., Any], *args: Any) -> Any:
    """Call a function in a worker process; a signal ends the process once the function has cleaned up."""
    try:
        with signals_noted(), exceptions_named(), memory_is_named():
            answer = function(*args)
    except SystemExit as error:
        os._exit(exit_code_of(error) or 1)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # The parent would wait for the rest of a torn answer.
    return answer


def _end_with_parent() -> None:
    """End this process when the parent process is gone, even if killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)  # Lets a layer being written clear up.
        time.sleep(PATIENCE_SECONDS)
        os._exit(1)


@contextlib.contextmanager
def connected(address: str) -> Iterator[Start]:
    """Connect to a scheduler for the duration of the block.

    Args:
        address: Address printed by ``dask scheduler``, such as ``tcp://farm:8786``.

    Raises:
        UsageError: Dask is not installed, or no scheduler answers at the address.
    """
    with _client(address) as client:
        executor = client.get_executor(pure=False, retries=RETRIES)
        try:
            yield partial(executor.submit, _call, _code())
        finally:
            executor.shutdown(wait=False)


def shots_at_once(address: str, chunks: int) -> int:
    """Number of shots, each of ``chunks`` chunks, needed to keep all workers of a scheduler busy.

    Raises:
        UsageError: As in `connected`.
    """
    with _client(address) as client:
        return math.ceil(len(client.nthreads()) / chunks)


@contextlib.contextmanager
def _client(address: str) -> Iterator[Any]:
    """A connection to a scheduler with at least one worker."""
    try:
        client = _distributed().Client(address, timeout=CONNECT_SECONDS)
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        limit = time.monotonic() + CONNECT_SECONDS
        while not client.nthreads():
            leave_if_asked()
            if time.monotonic() > limit:
                raise UsageError(f"the Dask scheduler at {address} has no workers; start some: dask worker {address}")
            time.sleep(0.1)
        yield client


def _distributed() -> Any:
    """The Dask package, an optional extra."""
    try:
        return importlib.import_module("distributed")
    except ModuleNotFoundError as error:
        raise UsageError("--scheduler needs Dask: pip install distributed") from error


def _code() -> str:
    """Version and code digest of the local package."""
    return f"{__version__} (code {code_digest()[:12]})"


def _call(code: str, function: Callable[..., Any], *args: Any) -> Any:
    """Call a function on a worker. Errors of the shot are returned, not raised: a retry would fail the same way."""
    worker = _distributed().get_worker()
    if worker.state.nthreads != 1:
        return UsageError(f"the worker {worker.name} has {worker.state.nthreads} threads; start each with --nthreads 1")
    if code != _code():
        versions = f"the worker {worker.name} has physgraph-usd {_code()}, this machine {code}"
        return UsageError(f"{versions}; install the same on both")
    try:
        return function(*args)
    except PhysGraphError as error:
        return error
