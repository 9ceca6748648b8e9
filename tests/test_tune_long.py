"""A long session of `tune` without a pause for thought: memory stays bounded and nothing is left stale."""

from __future__ import annotations

import gc
import os
import random
import time as clock
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch
from shots import CLOTH, cloth_shot

from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.integrate.factors import Factors
from physgraph_usd.studio.loop import SolveLoop
from physgraph_usd.studio.session import Shown, TuneSession
from physgraph_usd.studio.values import MAPS, TUNABLES

SECONDS = float(os.environ.get("PHYSGRAPH_TUNE_SECONDS", "120"))
"""How long the moves go on; 3600 for an hour."""
TOO_WEAK = ("the refined cloth ", "nothing holds it up but a guide")
"""Errors of values that cannot hold the cloth: it leaves its cage, or its size, or would fall."""
MOST_GROWTH = 150e6
"""Bytes by which memory may grow from a quarter of the time to the end, beside `LEFT_BEHIND`."""
LEFT_BEHIND = 24
"""Bytes a vertex that cholespy 2.2 never frees of a factor that has solved: its workspace for three columns."""


class Log:
    """Errors, and the frame shown last."""

    def __init__(self) -> None:
        self.errors: list[str] = []
        self.last: Shown | None = None
        self.count = self.shows = 0

    def busy(self, what: str) -> None:
        """Nothing is kept."""

    def seen(self, points: object) -> None:
        self.count += 1

    def show(self, shown: Shown) -> None:
        self.last = shown
        self.shows += 1

    def solved(self) -> None:
        self.count += 1

    def fail(self, error: Exception) -> None:
        self.errors.append(str(error))


def moved(session: TuneSession, loop: SolveLoop, chance: random.Random) -> None:
    """One random move of an artist."""
    name = chance.choice([*TUNABLES])
    painted = session.painted(CLOTH, chance.choice(MAPS[:4]))
    span = tuple(sorted(chance.sample(session.codes, 2)))
    moves: list[tuple[int, Any]] = [
        (40, lambda: session.set_value(CLOTH, name, TUNABLES[name].at(chance.random()))),
        (4, lambda: session.set_preset(CLOTH, chance.choice([*PRESETS]))),
        (4, lambda: session.set_time(chance.choice(session.times))),
        (2, lambda: session.set_level(CLOTH, chance.choice([1, 2]))),
        (3, lambda: session.paint(CLOTH, chance.choice(MAPS[:4]), np.clip(painted * chance.uniform(0.5, 1.5), 0, 5))),
        (8, session.undo),
        (4, session.redo),
        (2, session.keep),
        (2, session.swap),
        (1, lambda: session.set_contact(chance.random() < 0.8)),
        (3, lambda: session.reset(CLOTH, name)),
        (3, lambda: setattr(loop, "span", span)),
        (2, lambda: setattr(loop, "playing", not loop.playing)),
    ]
    chance.choices([move for _, move in moves], [weight for weight, _ in moves])[0]()


@pytest.mark.slow
@pytest.mark.timeout(SECONDS + 300)
def test_random_moves_leave_memory_bounded_and_nothing_stale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    chance, log, process, factors = random.Random(1), Log(), psutil.Process(), list[int]()
    factorised = Factors.of

    def counted(own: Factors, values: torch.Tensor) -> Any:
        factors.append(len(values))
        return factorised(own, values)

    monkeypatch.setattr(Factors, "of", counted)
    with closing(TuneSession(cloth_shot(tmp_path / "sheet.usda", size=(16, 12)), garments=[CLOTH])) as session:
        loop = SolveLoop(session, log, rest_seconds=0.05)
        loop.start()
        began, sizes = clock.monotonic(), list[tuple[float, int]]()
        while clock.monotonic() - began < SECONDS:
            loop.ask(lambda own: moved(own, loop, chance))
            clock.sleep(chance.choice([0.01, 0.05, 0.3, 1.0]))
            sizes.append((clock.monotonic() - began, process.memory_info().rss))
        stopped = list[int]()

        def stop(_: TuneSession) -> None:
            loop.playing = False
            stopped.append(log.shows)

        loop.ask(stop)
        end = clock.monotonic() + 120.0
        while not stopped or log.shows == stopped[0] or log.last is None or not log.last.settled:
            assert clock.monotonic() < end
            clock.sleep(0.1)
        loop.close()
        gc.collect()
        shown = log.last
        assert session.solve() is shown
        assert shown.frame.time == session.time
        assert shown.frame.garments[0].fabric == session.shot.frame(session.time).garments[0].fabric
    assert log.count > 10
    assert {error for error in log.errors if not any(weak in error for weak in TOO_WEAK)} == set()
    quarter = max(size for at, size in sizes if at < 0.3 * SECONDS)
    assert sizes[-1][1] - quarter < MOST_GROWTH + LEFT_BEHIND * sum(factors)
