"""Ctrl-C and polite terminations: the signal handler notes them, and the run asks between frames and rounds.

Python runs signal handlers between any two lines. An exception raised there is lost in a destructor and in foreign
code that catches it, and frees arrays that other threads work on. So the handler raises nothing: `leave_if_asked`
raises, at places where leaving is safe, and `is_asked` ends the loops of a frame. While modules are imported, which
takes seconds, nothing can be asked; the handler ends the process there.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Never

SIGNALLED = 128
"""A shell reports the end by a signal as this plus the signal's number."""


class _Signals:
    """State of the signal handler.

    Attributes:
        noted: Number of the last signal, or None.
        importing: Number of `importing` blocks around the current line.
        at_end: Functions to call before the handler ends the process, each with the exit code.
    """

    def __init__(self) -> None:
        self.noted: int | None = None
        self.importing = 0
        self.at_end: list[Callable[[int], object]] = []

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Note a signal; while modules are imported, end the process."""
        self.noted = number
        if self.importing:
            _end(SIGNALLED + number)


_SIGNALS = _Signals()


def _end(code: int) -> Never:
    for function in reversed(_SIGNALS.at_end):
        function(code)
    with suppress(OSError, ValueError, RuntimeError):  # Closed, full, or amid a write.
        if code == SIGNALLED + signal.SIGINT:
            sys.stderr.write("interrupted\n")
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
    os._exit(code)


def _leave(number: int) -> Never:
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(SIGNALLED + number)


@contextmanager
def signals_noted() -> Iterator[None]:
    """Note Ctrl-C and a polite termination inside the block; one that was not asked for is raised at its end.

    Does nothing outside the main thread, nor with a signal that the host program handles itself.

    Raises:
        KeyboardInterrupt: Ctrl-C came.
        SystemExit: A termination came; with the code by which a shell reports it.
    """
    taken = {signal.SIGTERM: signal.SIG_DFL, signal.SIGINT: signal.default_int_handler}
    ours = threading.current_thread() is threading.main_thread()
    taken = {number: before for number, before in taken.items() if ours and signal.getsignal(number) is before}
    for number in taken:
        signal.signal(number, _SIGNALS.handle)
    try:
        yield
    finally:
        for number, before in taken.items():
            signal.signal(number, before)
        noted = _SIGNALS.noted if taken else None
        if noted is not None:
            _SIGNALS.noted = None
            _leave(noted)


def is_asked() -> bool:
    """Whether a signal asked the run to end."""
    return _SIGNALS.noted is not None


def leave_if_asked() -> None:
    """Leave where a signal asked for it; the main thread leaves, others end with it.

    Raises:
        KeyboardInterrupt: Ctrl-C came.
        SystemExit: A termination came; with the code by which a shell reports it.
    """
    if _SIGNALS.noted is not None and threading.current_thread() is threading.main_thread():
        _leave(_SIGNALS.noted)


@contextmanager
def importing() -> Iterator[None]:
    """Let a noted signal end the process inside the block: imports take too long to wait for, and break when left.

    The garbage collector waits meanwhile. If the program froze its objects before, as the command does, it freezes the
    imported ones too: torch has a million objects, which live as long as the process.
    """
    leave_if_asked()
    _SIGNALS.importing += 1
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        _SIGNALS.importing -= 1
        if gc.get_freeze_count():
            gc.freeze()
        if collects:
            gc.enable()


@contextmanager
def at_end(function: Callable[[int], object]) -> Iterator[None]:
    """Call a function with the exit code where a signal ends the process inside the block, in place of leaving it."""
    _SIGNALS.at_end.append(function)
    try:
        yield
    finally:
        _SIGNALS.at_end.pop()


def exit_code_of(error: BaseException | None) -> int | None:
    """The code by which a shell reports the signal that raised an exception, or None where none did."""
    if isinstance(error, KeyboardInterrupt):
        return SIGNALLED + signal.SIGINT
    code = error.code if isinstance(error, SystemExit) else None
    return code if isinstance(code, int) and code > SIGNALLED else None
