"""An elbow with crease memory, bent and straight again, beside one without."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from benchmarks.crease import HELD, MOVES, STRAIGHT, Worn, worn
from physgraph_usd.solver.fabric import PRESETS


@cache
def elbow(time: float) -> Worn:
    """The elbow of the benchmark in cotton at one subdivision."""
    return worn(replace(PRESETS["cotton"], crease_time=time), level=1)


def test_an_elbow_that_is_straight_again_shows_where_it_was_bent():
    """A quarter more one second later, less as it is held, and no jumps or energy that are not there without."""
    plain, creased = elbow(0.0), elbow(2.0)
    later, late = STRAIGHT + 24, STRAIGHT + 72
    assert creased.folds[later] > 1.25 * plain.folds[later]
    assert creased.folds[late] < 0.9 * creased.folds[STRAIGHT]
    held = creased.folds[STRAIGHT : late + 1]
    assert np.diff(held).max() < 0.01 * held[0]
    assert np.sqrt((creased.jumps**2).mean()) < 1.1 * np.sqrt((plain.jumps**2).mean())
    assert creased.jumps[STRAIGHT + 1 :].max() < 0.05e-3
    assert creased.joules.max() < 1.1 * plain.joules.max()
    assert creased.joules[:STRAIGHT].mean() < 1.05 * plain.joules[:STRAIGHT].mean()
    assert creased.joules[MOVES + HELD] < plain.joules[MOVES + HELD]
