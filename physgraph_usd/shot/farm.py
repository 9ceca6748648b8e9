"""Calls on the workers of a Dask scheduler, like `processes` on this machine.

A task solves a chunk and stores the frames in the folder beside the layer; every worker must see the folder under the
same path. If a worker dies, the scheduler restarts its task on a new worker and the same files are written again.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from typing import Any

from ..errors import PhysGraphError, UsageError
from ..interrupts import leave_if_asked
from ..version import __version__, code_digest
from .processes import Start

RETRIES = 2
"""Restarts of a task after an unforeseen error, such as a disk not yet mounted."""
CONNECT_SECONDS = 10.0
"""Longest wait for the scheduler, and for its first worker."""


@contextmanager
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
