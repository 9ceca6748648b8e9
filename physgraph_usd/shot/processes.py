"""Runs calls in separate processes; a dead process becomes an error naming the cause."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import re
import signal
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from ..errors import PhysGraphError, SolveError
from ..interrupts import leave_if_asked, signals_noted

LOG = logging.getLogger("physgraph_usd")
POLL_SECONDS = 0.02
PATIENCE_SECONDS = 10.0
"""Time for a process to clean up after being asked to end, and for a stopped process before a warning [s]."""
_MEMORY = re.compile(r"out of memory|n.t allocate|to allocate|bad_alloc", re.IGNORECASE)


class Call:
    """A function running in a separate process; function, arguments and result must be picklable.

    Attributes:
        lag: Longest time for the call's files to appear after the call has ended [s].
    """

    lag = 0.0

    def __init__(self, function: Callable[..., Any], *args: Any) -> None:
        """Start the process."""
        context = multiprocessing.get_context("spawn")
        self._here, there = context.Pipe(duplex=False)
        self._process = context.Process(target=_answer, args=(there, function, args), daemon=True)
        self._process.start()
        there.close()
        self._answer: tuple[Any, PhysGraphError | None] | None = None
        self._stopped_since: float | None = None
        self._has_warned = False

    @property
    def ready(self) -> bool:
        """Whether the call has returned, failed or died; warns if the process is stopped."""
        if self._answer is not None or self._here.poll():
            return True
        self._warn_if_stopped()
        return False

    def _warn_if_stopped(self) -> None:
        """Warn once about a process stopped too long for a pause of the whole run."""
        pid = self._process.pid
        if self._has_warned or not self._is_stopped():
            self._stopped_since = None
            return
        now = time.monotonic()
        self._stopped_since = self._stopped_since or now
        if now - self._stopped_since >= PATIENCE_SECONDS:
            LOG.warning("the worker process %d is stopped and the run waits; kill -CONT %d lets it go on", *2 * (pid,))
            self._has_warned = True

    def _is_stopped(self) -> bool:
        if not hasattr(os, "waitid") or self._process.pid is None:
            return False
        try:  # WNOWAIT leaves the process's end to multiprocessing.
            return os.waitid(os.P_PID, self._process.pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT) is not None
        except ChildProcessError:  # The process has ended.
            return False

    def result(self) -> Any:
        """Wait for the function's result.

        Raises:
            PhysGraphError: Raised by the function; an unforeseen error is converted, with the traceback on stderr.
            SolveError: The process died.
        """
        if self._answer is None:
            try:
                answer: tuple[Any, PhysGraphError | None] = self._here.recv()
            except EOFError:
                self._process.join()
                answer = None, SolveError(_obituary(self._process.exitcode or 0))
            self._answer = answer
        value, error = self._answer
        if error is not None:
            raise error
        return value

    def ask_to_end(self) -> None:
        """Ask the process to clean up and end; do not wait."""
        self._process.terminate()
        if self._is_stopped() and self._process.pid is not None:
            os.kill(self._process.pid, signal.SIGCONT)

    def end(self) -> None:
        """End the process, with time to clean up."""
        self.ask_to_end()
        self._process.join(PATIENCE_SECONDS)
        self._process.kill()
        self._here.close()


def call_each(
    function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], *, workers: int
) -> Generator[Any, None, None]:
    """Call a function once per job, each call in a new process, and yield results in order.

    Args:
        function: The function; picklable.
        jobs: Arguments of each call.
        workers: Most calls at a time.

    Returns:
        Per job the result, or the `PhysGraphError` raised.
    """
    calls: list[Call] = []
    try:
        for index in range(len(jobs)):
            while not (index < len(calls) and calls[index].ready):
                leave_if_asked()
                if len(calls) < len(jobs) and sum(not call.ready for call in calls) < workers:
                    calls.append(Call(function, *jobs[len(calls)]))
                else:
                    time.sleep(POLL_SECONDS)
            try:
                yield calls[index].result()
            except PhysGraphError as error:
                yield error
    finally:
        for call in calls:
            call.ask_to_end()
        for call in calls:
            call.end()


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


def _answer(there: Connection, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
    """Call the function and send the result; Ctrl-C is ignored here and handled by the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_outlast_parent, daemon=True).start()
    with signals_noted(), _Sent(there), memory_is_named():
        there.send((function(*args), None))


class _Sent:
    """Sends errors raised inside the block; unforeseen errors as a `PhysGraphError`, with the traceback on stderr."""

    def __init__(self, there: Connection) -> None:
        self._there = there

    def __enter__(self) -> None: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not isinstance(error, Exception):
            return False
        if not isinstance(error, PhysGraphError):
            traceback.print_exception(error)
            error = PhysGraphError(f"unexpected {type(error).__name__}: {error}")
        self._there.send((None, error))
        return True


def _outlast_parent() -> None:
    """End this process when the parent process is gone, even if killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)  # lets a layer being written clear up
        time.sleep(PATIENCE_SECONDS)
        os._exit(1)


def _obituary(code: int) -> str:
    """How a process died, by its exit code."""
    how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    why = ", perhaps for lack of memory; use fewer --workers or a lower --level" if how == "SIGKILL" else ""
    return f"a worker process died ({how}){why}"
