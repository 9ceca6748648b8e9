"""Stand-ins for the solver of a shot, in a module that a worker process imports fast."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

import numpy as np

from physgraph_usd.chunks import Outcome


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


class Dying(Counting):
    def __call__(self, times: Sequence[float | None]) -> Iterator[Outcome]:
        for outcome in super().__call__(times):
            if outcome.time == 5.0:
                os._exit(9)
            yield outcome


class Raising(Counting):
    def __call__(self, times: Sequence[float | None]) -> Iterator[Outcome]:
        for outcome in super().__call__(times):
            if outcome.time == 5.0:
                raise ValueError("a bug")
            yield outcome


class Short(Counting):
    def __call__(self, times: Sequence[float | None]) -> Iterator[Outcome]:
        yield from list(super().__call__(times))[:-1]
