"""Whether a chart repeats: what `benchmarks.order` says of methods that change places."""

from __future__ import annotations

import pytest

pytest.importorskip("pxr", reason="charts read stages with usd-core")
pytest.importorskip("matplotlib", reason="charts are drawn with matplotlib")

from benchmarks.order import compared


def orders(*runs: str) -> list[str]:
    """What three methods' places in some runs have in common; inf where one did not get there."""
    times = [dict(zip(("a", "b", "c"), map(float, run.split()), strict=False)) for run in runs]
    return compared([{name: each for name, each in run.items() if each < float("inf")} for run in times])


def test_runs_have_one_order_where_none_changes_places():
    assert orders("10 20 40", "15 30 70", "11 21 39")[-1] == "the order is the same in 3 runs"


def test_what_is_as_fast_has_no_order():
    lines = orders("10 20 21", "10 20 19", "10 20 20")
    assert lines[-1] == "the order is the same in 3 runs"
    assert "b and c are as fast: 1.05, 0.95, 1.00" in lines


def test_who_does_not_get_there_is_slower_than_all_who_do():
    assert orders("10 20 40", "10 30", "10 20")[-1] == "the order is the same in 3 runs"
    assert orders("10 20", "10", "10")[-1] == "the order is the same in 3 runs"


@pytest.mark.parametrize(
    ("last", "word"),
    [
        ("10 24 20", "b and c change places: 2.00, 1.33, 0.83"),
        ("10 inf 40", "b and c change places: 2.00, 1.33, 0.00"),
    ],
)
def test_runs_differ_where_methods_change_places(last: str, word: str):
    lines = orders("10 20 40", "10 30 40", last)
    assert "the order is not the same" in lines
    assert word in lines
