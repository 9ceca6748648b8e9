"""The time at which a frame's solve ends wherever it is: the loops of the solve ask, and stop where they stand.

A signal that asks the run to end is over time too; the caller then drops the frame.

Cloth is always at the end of a safe move, so a frame that ends early is valid, though not at rest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from ..interrupts import is_asked

Clock = Callable[[], float]
"""A clock [s], from any start."""
_DEADLINES: ContextVar[tuple[tuple[Clock, float], ...]] = ContextVar("deadlines", default=())


def clock_of(device: str) -> Clock:
    """The clock of the time limits of frames solved on a device.

    On the CPU: processor time of the process, all threads together. Other programs then change neither the frames that
    reach a limit nor their cloth. In a host program the host's own threads count too.

    On a CUDA card: wall time. The process waits for the card there, and the driver decides whether a wait is processor
    time: a busy wait is, a blocked one is not. A blocked process would never reach a limit of processor time. Other
    programs on the card may then change which frames reach a limit.
    """
    return time.process_time if device == "cpu" else time.perf_counter


@contextmanager
def ends_after(seconds: float, clock: Clock = time.perf_counter) -> Iterator[None]:
    """Let what is called in the context end after some time [s] of a clock, or by an earlier deadline around it."""
    token = _DEADLINES.set((*_DEADLINES.get(), (clock, clock() + seconds)))
    try:
        yield
    finally:
        _DEADLINES.reset(token)


def is_over() -> bool:
    """Whether the time is over, which outside of `ends_after` it never is, or a signal asks the run to end."""
    return is_asked() or any(clock() >= end for clock, end in _DEADLINES.get())
