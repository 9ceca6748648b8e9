"""Time codes: merged up to rounding, kept as authored."""

from __future__ import annotations

import pytest

from physgraph_usd.usd.times import merge, snap, within


def test_times_that_differ_by_rounding_are_one_and_the_first_given_stays() -> None:
    assert merge([2.0, 1.0, 1.0 + 1e-9, 2.0 - 1e-9, 3.0]) == (1.0, 2.0, 3.0)
    assert merge([1.0 + 1e-9, 1.0]) == (1.0 + 1e-9,)
    assert merge([]) == ()


def test_snapped_times_are_the_merged_ones_to_the_bit() -> None:
    merged = merge([1.0, 2.0, 2.0 + 1e-9, 5.0])
    assert snap((1.0, 2.0 + 1e-9), merged) == (1.0, 2.0)
    assert snap((), ()) == ()


def test_sub_frames_stay_apart() -> None:
    assert merge([1.0, 1.001, 1.25]) == (1.0, 1.001, 1.25)


@pytest.mark.parametrize(
    ("frames", "expected"), [(None, (1.0, 2.0, 3.5)), ((2.0, 3.0), (2.0,)), ((2.0 + 1e-9, 3.5 - 1e-9), (2.0, 3.5))]
)
def test_ranges_are_closed_up_to_rounding(frames: tuple[float, float] | None, expected: tuple[float, ...]) -> None:
    assert within((1.0, 2.0, 3.5), frames) == expected
