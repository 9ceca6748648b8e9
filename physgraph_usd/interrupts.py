"""Signals that end a run: Ctrl-C and a polite termination become exceptions, when leaving frees nothing in use.

Python runs signal handlers between any two lines. An exception raised while other threads work on arrays of the
interrupted call would free these under them; so inside `undisturbed` a signal is only noted, and raised at its end.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

SIGNALLED = 128
"""A shell reports the end by a signal as this plus the signal's number."""
_MAIN = threading.main_thread().ident


class _Signals:
    """Signals noted in the main thread, where Python runs all handlers.

    Attributes:
        noted: Those that came, until the block that handles them ends.
        depth: How many `undisturbed` blocks the main thread is in.
        waiting: Whether the last one noted has yet to be raised.
    """

    def __init__(self) -> None:
        self.noted: list[int] = []
        self.depth, self.waiting = 0, False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Signal handler."""
        self.noted.append(number)
        if self.depth:
            self.waiting = True
        else:
            _leave(number)


_SIGNALS = _Signals()


def _leave(number: int) -> None:
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(SIGNALLED + number)


@contextmanager
def signals_raise() -> Iterator[None]:
    """Turn a polite termination into SystemExit, as Ctrl-C is a KeyboardInterrupt, so that ``with`` blocks clean up.

    An exception that a signal raises while a destructor runs is lost; `leave_if_asked` raises it again. Does nothing
    outside the main thread, or to a signal that the host program handles itself.
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
        if taken:
            _SIGNALS.noted.clear()
            _SIGNALS.waiting = False


def leave_if_asked() -> None:
    """Leave where a signal came and its exception was lost.

    Raises:
        KeyboardInterrupt: It was Ctrl-C.
        SystemExit: It was a termination, with the code by which a shell reports it.
    """
    if _SIGNALS.noted:
        _leave(_SIGNALS.noted[-1])


def exit_code_of(error: BaseException | None) -> int | None:
    """The code by which a shell reports the signal that raised an exception, or None where none did."""
    if isinstance(error, KeyboardInterrupt):
        return SIGNALLED + signal.SIGINT
    code = error.code if isinstance(error, SystemExit) else None
    return code if isinstance(code, int) and code > SIGNALLED else None


class Undisturbed:
    """A block that no signal leaves in the middle; one that came is raised at its end."""

    def __enter__(self) -> None:
        """Note signals from now on."""
        if threading.get_ident() == _MAIN:
            _SIGNALS.depth += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Raise what was noted."""
        if threading.get_ident() == _MAIN:
            _SIGNALS.depth -= 1
            if _SIGNALS.waiting and not _SIGNALS.depth:
                _SIGNALS.waiting = False
                leave_if_asked()


undisturbed = Undisturbed()
"""The block to use; it holds no state of its own."""
