"""Phi*: below what any method finds, the same for all who ask, and lowered where somebody finds less after all."""

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from cloth import DOWN, frame_of, sheet, wave
from sheets import garment_of

from physgraph_usd.lab.chart.problem import ALONE, Problem
from physgraph_usd.lab.chart.reference import Reference, find_reference
from physgraph_usd.lab.methods import METHODS
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.scene import Frame, Scene


def squeezed() -> tuple[Problem, Frame]:
    """A sheet of 4 by 3 cells that is squeezed by a fifth and buckles."""
    mesh, rest = sheet(4, 3)
    problem = Problem(Scene((garment_of(mesh, rest),), DOWN, ()), [1], device="cpu", threads=1, dtype=torch.float64)
    return problem, frame_of(wave(rest, squeeze=0.2))


def searched(**bounds: Any) -> Reference:
    """A search whose seconds are the processor's, since other work on the machine takes time too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "perf_counter", time.process_time)
        return find_reference(*squeezed(), settings=ALONE, **bounds)


@pytest.fixture(scope="module")
def found() -> Reference:
    return searched()


@pytest.fixture(scope="module")
def bounded() -> Reference:
    return searched(short=True)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["quasi-newton", "quasi-newton-flat", "physgraph", "lbfgs"])
def test_no_method_with_any_budget_ends_below_it(found: Reference, method: str):
    problem, frame = squeezed()
    for steps in (12, 96):
        points, _ = problem.go_on(frame, replace(ALONE, method=METHODS[method], steps=steps), [None])
        assert found.gap(problem.judge(frame, points, ALONE).energy) > -1e-4


def test_a_bounded_search_compares_two_starts_at_least(found: Reference, bounded: Reference):
    for less in (bounded, searched(seconds=0.0)):
        assert less.seconds < found.seconds
        assert less.apart is not None
        assert 0.0 <= found.gap(less.least) < 0.1


class Landscape:
    """A problem whose starts each end below the ones before, and Newton falls far from the first alone."""

    def __init__(self) -> None:
        self.begun, self.refiner = 0, SimpleNamespace(parts_of=lambda frame: [None])

    def upsampled(self, frame: object, *, smooth: bool) -> float:
        return 10.0

    def judge(self, frame: object, energy: float, settings: object) -> SimpleNamespace:
        return SimpleNamespace(energy=energy, energies={})

    def go_on(self, frame: object, settings: SolveSettings, states: list[int | None]) -> tuple[float, list[int]]:
        (number,) = states
        if number is None:
            number, self.begun = self.begun, self.begun + 1
        return -5.0 if number == 0 and settings.method is METHODS["newton"] else 9.0 - number, [number]


def test_a_long_search_finds_what_a_short_one_does():
    """It goes on from what a search that ends earlier would go on from, not from its own best two alone."""
    problem: Any = Landscape
    frame: Any = None
    whole, short = (find_reference(problem(), frame, short=short) for short in (False, True))
    assert whole.least <= short.least == -5.0
