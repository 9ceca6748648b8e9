"""Calls on the workers of a Dask scheduler, like `processes` on this machine.

A task solves a chunk and stores the frames in the folder beside the layer; every worker must see the folder under the
same path. If a worker dies, the scheduler restarts its task on a new worker and the same files are written again.
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
"""Restarts of a task after an unforeseen error, such as a disk not yet mounted."""
CONNECT_SECONDS = 10.0
"""Longest wait for the scheduler, and for its first worker."""

Start = Callable[..., "FarmCall"]
"""Starts a function on a worker; function and arguments must be picklable."""


class FarmCall:
    """A running function call on a worker of a Dask scheduler.

    Attributes:
        lag: Longest time for the call's files to appear on this machine after the call has ended [s]: network file
            systems cache missing files.
    """

    lag = 60.0

    def __init__(self, future: Any) -> None:
        """Follow a submitted task."""
        self._future = future

    @property
    def ready(self) -> bool:
        """Whether the call has returned or failed."""
        return self._future.done()

    def result(self) -> Any:
        """Wait for the function's result.

        Raises:
            PhysGraphError: Raised by the function.
            SolveError: The workers died, the scheduler is gone, or an unforeseen error occurred.
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
        """Cancel the call if not yet begun; a worker finishes its current frame first."""
        self._future.cancel()

    def end(self) -> None:
        """Cancel the call like `ask_to_end`, without waiting for the worker."""
        self.ask_to_end()


@contextmanager
def connected(address: str) -> Iterator[Start]:
    """Connect to a scheduler for the duration of the block.

    Args:
        address: Address printed by ``dask scheduler``, such as ``tcp://farm:8786``.

    Raises:
        UsageError: Dask is not installed, or no scheduler answers at the address.
    """
    with _client(address) as client:

        def start(function: Callable[..., Any], *args: Any) -> FarmCall:
            return FarmCall(client.submit(_call, _code(), function, args, pure=False, retries=RETRIES))

        yield start


def shots_at_once(address: str, chunks: int) -> int:
    """Number of shots, each of ``chunks`` chunks, needed to keep all workers of a scheduler busy.

    Raises:
        UsageError: As in `connected`.
    """
    with _client(address) as client:
        return math.ceil(len(client.nthreads()) / chunks)


@contextmanager
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
        return import_module("distributed")
    except ModuleNotFoundError as error:
        raise UsageError("--scheduler needs Dask: pip install 'physgraph-usd[farm]'") from error


def _code() -> str:
    """Version and code digest of the local package."""
    return f"{__version__} (code {code_digest()[:12]})"


def _call(code: str, function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[Any, PhysGraphError | None]:
    """Call a function on a worker. Errors of the shot are returned, not raised: a retry would fail the same way."""
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
