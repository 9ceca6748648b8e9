"""A thread that changes a session's values and solves its frame, while the page answers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from ..errors import PhysGraphError
from .session import Shown, TuneSession

REST_SECONDS = 0.1
"""How long nothing must be asked before the frame is solved as ``refine`` does."""

Change = Callable[[TuneSession], None]
"""A change asked of a session."""


class Watcher(Protocol):
    """Receiver of results; called from the loop's thread."""

    def busy(self, what: str) -> None:
        """Work has begun."""
        ...

    def seen(self, points: Mapping[str, np.ndarray]) -> None:
        """Positions of some garments before they are settled [m], world space, by path."""
        ...

    def show(self, shown: Shown) -> None:
        """A frame is solved."""
        ...

    def fail(self, error: PhysGraphError) -> None:
        """A change cannot be made, or the frame cannot be solved."""
        ...


class SolveLoop:
    """The owner of a session: changes that come while a frame is solved are made together, and solved once.

    When nothing has been asked for `REST_SECONDS`, the frame is solved as ``refine`` does; a change ends that.
    """

    def __init__(self, session: TuneSession, watcher: Watcher, *, rest_seconds: float = REST_SECONDS) -> None:
        """Start the thread, which solves the session's frame at once.

        Args:
            session: The session; from here on it is the thread's.
            watcher: Receives the results.
            rest_seconds: Time without a change before a frame is settled.
        """
        self._session, self._watcher, self._rest = session, watcher, rest_seconds
        self._asked: list[Change] = [lambda _: None]
        self._changed, self._closing = threading.Condition(), False
        self._thread = threading.Thread(target=self._work, name="tune", daemon=True)
        self._thread.start()

    @property
    def runs(self) -> bool:
        """Whether the thread has not ended."""
        return self._thread.is_alive()

    def ask(self, change: Change) -> None:
        """Have a change made and its frame solved; returns at once."""
        with self._changed:
            self._asked.append(change)
            self._changed.notify()

    def close(self) -> None:
        """End the thread after the present step."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _work(self) -> None:
        resting = False
        while True:
            with self._changed:
                self._changed.wait_for(self._is_wanted, None if resting else self._rest)
                if self._closing:
                    return
                asked, self._asked = self._asked, []
            try:
                resting = self._solve(asked) if asked else self._settle()
            except PhysGraphError as error:
                resting = True
                self._watcher.fail(error)

    def _solve(self, asked: list[Change]) -> bool:
        """Make changes and solve the frame roughly; returns whether it is settled."""
        for change in asked:
            try:
                change(self._session)
            except PhysGraphError as error:
                self._watcher.fail(error)
        self._watcher.busy("solving")
        rounds = list[None]()

        def seen(points: Mapping[str, np.ndarray]) -> None:
            rounds.append(None)
            self._watcher.seen(points)

        # Cancelled after a round at the earliest: cloth moves even while changes keep coming.
        shown = self._session.solve(seen, lambda: bool(rounds) and self._is_wanted())
        self._watcher.show(shown)
        return shown.settled

    def _settle(self) -> bool:
        """Settle the frame; returns whether no change cancelled that."""
        self._watcher.busy("settling")
        shown = self._session.settle(self._watcher.seen, self._is_wanted)
        self._watcher.show(shown)
        return shown.settled

    def _is_wanted(self) -> bool:
        """Whether something is to be done at once; read without the lock between steps."""
        return bool(self._asked) or self._closing
