"""Stand-ins for what runs in processes of its own, in a module that a worker process imports fast."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from physgraph_usd.errors import GarmentError
from physgraph_usd.shot.frames import Outcome


class Counting:
    """A solver whose answer tells how many frames its process had solved before; picklable."""

    def __call__(self, times: Sequence[float | None]) -> Iterator[Outcome]:
        for before, time in enumerate(times):
            yield Outcome(time, (np.full((2, 3), before),), (before % 2 == 1,), {"time": time, "pid": os.getpid()})


class Failing(Counting):
    def __call__(self, times: Sequence[float | None]) -> Iterator[Outcome]:
        for outcome in super().__call__(times):
            failed = outcome.time == 5.0
            yield Outcome(5.0, (), (), {"time": 5.0, "error": "no"}) if failed else outcome


class Ending(Counting):
    """Comes to an end at the frame 5."""

    def end(self) -> None:
        raise NotImplementedError

    def __call__(self, times: Sequence[float | None]) -> Iterator[Outcome]:
        for outcome in super().__call__(times):
            if outcome.time == 5.0:
                self.end()
            yield outcome


class Dying(Ending):
    def end(self) -> None:
        os._exit(9)


class Killed(Ending):
    def end(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


class Raising(Ending):
    def end(self) -> None:
        raise ValueError("a bug")


class Exhausted(Ending):
    def end(self) -> None:
        np.empty(1 << 50)


class Allocating(Ending):
    """Asks Warp for more than there is."""

    def end(self) -> None:
        import warp as wp  # here: the other workers start without it

        wp.empty((1 << 30, 1 << 30), dtype=float, device="cpu")


class Broken(Ending):
    def end(self) -> None:
        raise GarmentError("/World/cloth", "torn", time=5.0, remedy="mend it")


class Short(Counting):
    def __call__(self, times: Sequence[float | None]) -> Iterator[Outcome]:
        yield from list(super().__call__(times))[:-1]


def as_named(shot: str, *_: object) -> Any:
    """Stands in for refine_shot in a process of its own."""
    if shot == "dies":
        os.kill(os.getpid(), signal.SIGSEGV)
    if shot == "raises":
        raise KeyError("a bug")
    return shot


def fails(kind: str) -> int:
    """What a task of a farm may do."""
    if kind == "garment":
        raise GarmentError("/World/cloth", "torn", time=5.0)
    if kind == "bug":
        raise ValueError("a bug")
    if kind == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()
