"""The thread that changes and solves a session, and plays its range."""

from __future__ import annotations

import threading
import time as clock
from collections.abc import Callable, Mapping

import numpy as np

from ..errors import PhysGraphError
from .session import Shown, TuneSession

REST_SECONDS = 0.1
"""How long nothing must be asked before the frame is solved as ``refine`` does."""

SOLVING = "solving"

Change = Callable[[TuneSession], None]
"""A change asked of a session."""


class Watcher:
    """Receiver of results, which does nothing with them; called from the loop's thread."""

    def busy(self, what: str) -> None:
        """Work has begun."""

    def seen(self, points: Mapping[str, np.ndarray]) -> None:
        """Positions of some garments before they are settled [m], world space, by path."""

    def show(self, shown: Shown) -> None:
        """A frame is solved, or played."""

    def solved(self) -> None:
        """A frame of the range, or A, is solved."""

    def fail(self, error: PhysGraphError) -> None:
        """A change cannot be made, or the frame cannot be solved."""


class SolveLoop:
    """The owner of a session: changes that come while a frame is solved are made together, and solved once.

    When nothing has been asked for `REST_SECONDS`, the frame is solved as ``refine`` does; then A and the range are.
    A change ends that.

    Attributes:
        span: First and last time code that are solved in the background and played; None solves none.
        playing: Whether the range is played: each of its frames is shown once it is solved; set by a change.
    """

    def __init__(self, session: TuneSession, watcher: Watcher, *, rest_seconds: float = REST_SECONDS) -> None:
        """Prepare the thread.

        Args:
            session: The session; from `start` on it belongs to the thread.
            watcher: Receiver of the results.
            rest_seconds: Time without a change before a frame is settled.
        """
        self._session, self._watcher, self._rest = session, watcher, rest_seconds
        self.span: tuple[float, float] | None = None
        self.playing = False
        self._asked: list[Change] = [lambda _: None]
        self._changed, self._closing = threading.Condition(), False
        self._due = 0.0  # When the next frame may be played.
        self._thread = threading.Thread(target=self._work, name="tune", daemon=True)

    def start(self) -> None:
        """Start the thread, which solves the session's frame at once."""
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
        patience: float | None = self._rest
        while True:
            with self._changed:
                self._changed.wait_for(self.is_wanted, patience)
                if self._closing:
                    return
                asked, self._asked = self._asked, []
            try:
                self._change(asked)
                patience = self._play() if self.playing else self._solve() if asked else self._go_on()
            except PhysGraphError as error:
                patience, self.playing = None, False
                self._watcher.fail(error)

    def _change(self, asked: list[Change]) -> None:
        """Make changes; an invalid change has no effect."""
        for change in asked:
            try:
                change(self._session)
            except PhysGraphError as error:
                self._watcher.fail(error)

    def _solve(self) -> float:
        """Solve the frame roughly; returns the time to wait for a change [s]."""
        self._watcher.busy(SOLVING)
        rounds = list[None]()

        def seen(points: Mapping[str, np.ndarray]) -> None:
            rounds.append(None)
            self._watcher.seen(points)

        # Cancelled after a round at the earliest: cloth moves even while changes keep coming.
        shown = self._session.solve(seen, lambda: bool(rounds) and self.is_wanted())
        self._watcher.show(shown)
        return 0.0 if shown.settled else self._rest

    def _go_on(self) -> float | None:
        """Settle the frame, or solve A or the range; returns the time to wait for a change [s]."""
        shown = self._session.solve()
        if not shown.settled:
            self._watcher.busy("settling")
            self._watcher.show(self._session.settle(self._watcher.seen, self.is_wanted))
            return 0.0
        if not self._session.go_on(self.span, self.is_wanted):
            return None
        self._watcher.solved()
        return 0.0

    def _play(self) -> float:
        """Show or solve the next frame of the range; returns the time to wait for a change [s]."""
        shown = self._session.step(self.span, self.is_wanted)
        if shown is None:
            self._watcher.solved()
            return 0.0
        self._watcher.show(shown)
        now = clock.monotonic()
        self._due = max(now, self._due + self._session.shot.scene.seconds)
        return self._due - now

    def is_wanted(self) -> bool:
        """Whether something is to be done at once; read without the lock between steps."""
        return bool(self._asked) or self._closing
