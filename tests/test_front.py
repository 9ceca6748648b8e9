"""Where the default stands among its rivals, from rows alone."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("pxr", reason="benchmarks read stages with usd-core")

from benchmarks.front import SLOW_MS, TURNS, placed, timed
from physgraph_usd.lab.chart.problem import Solved
from physgraph_usd.lab.chart.table import quickest


def rows(*runs: tuple[str, int, float, float]) -> list[dict[str, Any]]:
    """Runs as (method, steps, milliseconds, energy), the start at 1 J and Phi* at 0."""
    found = [{"method": "start", "steps": 0, "ms": 0.0, "energy": 1.0, "vertices": 9}]
    found += [{"method": m, "steps": s, "ms": ms, "energy": e} for m, s, ms, e in runs]
    return [*found, {"method": "least", "steps": 0, "ms": 0.0, "energy": 0.0, "by": "many steps", "apart": 0.01}]


def test_the_default_is_on_the_front_where_no_rival_is_a_tenth_quicker_to_its_gap():
    slow = ("quasi-newton-flat", 4, 100.0, 0.1), ("quasi-newton-flat", 8, 400.0, 0.001)
    line, on, _ = placed("flag", 1, rows(("default", 12, 210.0, 0.01), *slow))
    assert on
    assert line[5] == "quasi-newton-flat, 200 ms"
    assert line[6] == "1.05"
    assert not placed("flag", 1, rows(("default", 12, 230.0, 0.01), *slow))[1]


def test_a_rival_that_never_gets_there_does_not_count():
    assert placed("flag", 1, rows(("default", 12, 900.0, 0.01), ("physgraph", 2, 10.0, 0.02)))[0][6] == "1.00"


def test_a_method_that_comes_below_the_reference_is_what_all_gaps_are_counted_from():
    """And the reference then says who it was, and how far the one before lies above it."""
    below = [("default", 12, 100.0, 0.1), ("lbfgs", 8, 300.0, -0.25)]
    line, _, known = placed("flag", 1, rows(*below))
    assert line[3] == "28.00%"
    assert (known.least, known.by, known.apart) == (-0.25, "lbfgs, 8 steps", pytest.approx(0.2))
    assert "by lbfgs, 8 steps; the next best ends 20.00% of the fall above" in str(known)


@pytest.mark.parametrize(("first", "turns"), [(20.0, TURNS), (SLOW_MS + 1.0, 1)])
def test_the_time_of_every_method_is_the_least_of_as_many_turns(first: float, turns: int):
    taken = [first, first - 5.0, first + 5.0][:turns]
    left = iter(taken)
    _, least = timed(lambda: Solved((), next(left), 0.0, 0, None))
    assert least == min(taken)
    assert not list(left)


def test_a_time_between_two_budgets_is_interpolated_by_powers_and_what_gets_worse_is_left_out():
    assert quickest([(10.0, 0.1), (20.0, 0.5), (40.0, 0.001)], 0.01) == pytest.approx(20.0)
    assert quickest([(10.0, 0.1)], 0.01) is None
    assert quickest([(10.0, 0.1), (20.0, 0.01)], 0.2) == 10.0
