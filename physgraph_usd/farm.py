"""Calls on the workers of a Dask scheduler, as `processes` makes them on this machine.

A task solves a chunk and files its frames in the folder beside the layer, which every worker sees under the same path. A
worker that dies, dies alone: the scheduler gives its task to another one, which writes the same files again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from . import __version__
from .errors import PhysGraphError, SolveError, UsageError

if TYPE_CHECKING:
    from distributed import Client, Future

RETRIES = 2
"""How often a task is begun again after an error that nobody foresaw, such as a disk that was not there."""
CONNECT_SECONDS = 10.0
"""How long to wait for the scheduler, and for its first worker."""

Start = Callable[..., "FarmCall"]
"""Starts a function on a worker, with its arguments; they must be picklable."""


class FarmCall:
    """A function at work on a worker of a Dask scheduler."""

    def __init__(self, future: Future) -> None:
        """Follow a task that was submitted."""
        self._future = future

    @property
    def ready(self) -> bool:
        """Whether it has returned or failed."""
        return self._future.done()

    def result(self) -> Any:
        """What the function returned; waits for it.

        Raises:
            PhysGraphError: What it raised.
            SolveError: Its workers died, the scheduler is gone, or something failed that nobody foresaw.
        """
        import distributed

        try:
            value, error = self._future.result()
        except distributed.KilledWorker as died:
            raise SolveError(f"{died}; perhaps for lack of memory: use more chunks or a lower --level") from died
        except (distributed.client.FutureCancelledError, distributed.comm.CommClosedError, OSError) as lost:
            raise SolveError(f"the farm gave no result: {lost}") from lost
        if error is not None:
            raise error
        return value

    def end(self) -> None:
        """End it where it has not begun; a frame that a worker is solving is finished first."""
        self._future.cancel()


@contextmanager
def connected(address: str) -> Iterator[Start]:
    """Connect to a scheduler, for as long as the block lasts.

    Args:
        address: As ``dask scheduler`` prints it, such as ``tcp://farm:8786``.

    Raises:
        UsageError: Dask is not installed, or nothing answers there.
    """
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise UsageError("--scheduler needs Dask: pip install 'physgraph-usd[farm]'") from error
    try:
        client = Client(address, timeout=CONNECT_SECONDS)
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        _wait_for_workers(client, address)

        def start(function: Callable[..., Any], *args: Any) -> FarmCall:
            return FarmCall(client.submit(_call, __version__, function, args, pure=False, retries=RETRIES))

        yield start


def worker_count(address: str) -> int:
    """How many workers a scheduler has.

    Raises:
        UsageError: As `connected` does.
    """
    with connected(address) as start:
        return int(start.__closure__ is not None)


def _wait_for_workers(client: Client, address: str) -> None:
    limit = time.monotonic() + CONNECT_SECONDS
    while not client.scheduler_info()["workers"]:
        if time.monotonic() > limit:
            raise UsageError(f"the Dask scheduler at {address} has no workers; start some: dask worker {address}")
        time.sleep(0.1)


def _call(version: str, function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[Any, PhysGraphError | None]:
    """Call a function on a worker; what is wrong with the shot would be wrong on any other, and is not tried again."""
    from distributed import get_worker

    worker = get_worker()
    if worker.state.nthreads != 1:
        said = f"the worker {worker.name} has {worker.state.nthreads} threads; start each with --nthreads 1"
        return None, UsageError(said)
    if version != __version__:
        said = f"the worker {worker.name} has physgraph-usd {__version__}, this machine {version}; install one version"
        return None, UsageError(said)
    try:
        return function(*args), None
    except PhysGraphError as error:
        return None, error
