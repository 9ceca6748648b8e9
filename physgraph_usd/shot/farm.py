"""Calls on the workers of a Dask scheduler, as `processes` makes them on this machine.

A task solves a chunk and files its frames in the folder beside the layer, which every worker sees under the same path.
A worker that dies, dies alone: the scheduler gives its task to another one, which writes the same files again.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from ..errors import PhysGraphError, SolveError, UsageError
from ..interrupts import leave_if_asked
from ..version import __version__, code_digest

RETRIES = 2
"""How often a task is begun again after an error that nobody foresaw, such as a disk that was not there."""
CONNECT_SECONDS = 10.0
"""How long to wait for the scheduler, and for its first worker."""

Start = Callable[..., "FarmCall"]
"""Starts a function on a worker, with its arguments; they must be picklable."""


class FarmCall:
    """A function at work on a worker of a Dask scheduler.

    Attributes:
        lag: How long after its end the files that it wrote may be hidden from this machine [s]: a network's file system
            remembers what was not there.
    """

    lag = 60.0

    def __init__(self, future: Any) -> None:
        """Follow a task that was submitted."""
        self._future = future

    @property
    def ready(self) -> bool:
        """Whether it has returned or failed."""
        return self._future.done()

    def result(self) -> Any:
        """The function's result; waits for it.

        Raises:
            PhysGraphError: What it raised.
            SolveError: Its workers died, the scheduler is gone, or something failed that nobody foresaw.
        """
        dask = _distributed()
        try:
            unforeseen = self._future.exception()
            value, error = self._future.result() if unforeseen is None else (None, None)
        except (dask.client.FutureCancelledError, OSError) as lost:
            raise SolveError(f"the farm gave no result: {lost}") from lost
        if isinstance(unforeseen, dask.KilledWorker):
            raise SolveError(f"{unforeseen}; perhaps for lack of memory: use more chunks or a lower --level")
        if unforeseen is not None:
            raise PhysGraphError(f"unexpected {type(unforeseen).__name__} on a worker: {unforeseen}") from unforeseen
        if error is not None:
            raise error
        return value

    def ask_to_end(self) -> None:
        """End it where it has not begun; a frame that a worker is solving is finished first."""
        self._future.cancel()

    def end(self) -> None:
        """Cancel it, as `ask_to_end` does: nothing here waits for a worker."""
        self.ask_to_end()


@contextmanager
def connected(address: str) -> Iterator[Start]:
    """Connect to a scheduler, for as long as the block lasts.

    Args:
        address: As ``dask scheduler`` prints it, such as ``tcp://farm:8786``.

    Raises:
        UsageError: Dask is not installed, or nothing answers there.
    """
    with _client(address) as client:

        def start(function: Callable[..., Any], *args: Any) -> FarmCall:
            return FarmCall(client.submit(_call, _code(), function, args, pure=False, retries=RETRIES))

        yield start


def shots_at_once(address: str, chunks: int) -> int:
    """How many shots of so many chunks keep all workers of a scheduler busy.

    Raises:
        UsageError: As `connected` does.
    """
    with _client(address) as client:
        return math.ceil(len(client.nthreads()) / chunks)


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """A connection to a scheduler that has workers."""
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
    """Dask's package, which is an extra."""
    try:
        return import_module("distributed")
    except ModuleNotFoundError as error:
        raise UsageError("--scheduler needs Dask: pip install 'physgraph-usd[farm]'") from error


def _code() -> str:
    """The version of the package here, and its code."""
    return f"{__version__} (code {code_digest()[:12]})"


def _call(code: str, function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[Any, PhysGraphError | None]:
    """Call a function on a worker; what is wrong with the shot would be wrong on any other, and is not tried again."""
    worker = _distributed().get_worker()
    if worker.state.nthreads != 1:
        message = f"the worker {worker.name} has {worker.state.nthreads} threads; start each with --nthreads 1"
        return None, UsageError(message)
    if code != _code():
        message = f"the worker {worker.name} has physgraph-usd {_code()}, this machine {code}; install the same on both"
        return None, UsageError(message)
    try:
        return function(*args), None
    except PhysGraphError as error:
        return None, error
