"""The time at which a frame's solve ends wherever it is: the loops of the solve ask, and stop where they stand.

A signal that asks the run to end is over time too; the caller then drops the frame.

Cloth is always at the end of a safe move, so a frame that ends early is valid, though not at rest.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from ..interrupts import is_asked

_ENDS: ContextVar[float] = ContextVar("ends", default=math.inf)


@contextmanager
def ends_after(seconds: float) -> Iterator[None]:
    """Let what is called in the context end after some time [s], or by an earlier deadline around it."""
    token = _ENDS.set(min(_ENDS.get(), time.perf_counter() + seconds))
    try:
        yield
    finally:
        _ENDS.reset(token)


def is_over() -> bool:
    """Whether the time is over, which outside of `ends_after` it never is, or a signal asks the run to end."""
    return is_asked() or time.perf_counter() >= _ENDS.get()
