"""Steps made ahead of their check: the result and the report of steps made one at a time."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from cloth import finest_system, group_of, sheet, wave

from physgraph_usd.lab.methods.random_networks import random_network
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.integrate import ahead, stop
from physgraph_usd.solver.integrate.base import Carry, Integrator, System
from physgraph_usd.solver.integrate.descend import LevelReport, descend
from physgraph_usd.solver.integrate.guard import Guard
from physgraph_usd.solver.integrate.learned import LearnedMetric
from physgraph_usd.solver.integrate.network import PhysgraphConfig
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.stop import Budget
from physgraph_usd.solver.integrate.weights import shipped_network
from physgraph_usd.usd.read.reader import open_shot


def problem() -> tuple[System, torch.Tensor]:
    mesh, rest = sheet(6, 5)
    return finest_system(group_of(mesh, rest, level=2, dtype=torch.float32), wave(rest))


def shipped() -> Integrator:
    return Guard(LearnedMetric(shipped_network("physgraph")), spare=QuasiNewton())


class Overshooting(LearnedMetric):
    """A network of which every tenth step goes too far."""

    def _by_kernel(self, system: System, carry: Carry) -> tuple[torch.Tensor, torch.Tensor]:
        move, x = super()._by_kernel(system, carry)
        return (move, x) if carry.memory.step % 10 != 9 else (4.0 * move, carry.x + 4.0 * move)


def random(scale: float, *, spare: bool) -> Integrator:
    network = random_network(PhysgraphConfig(width=16), seed=0, scale=scale)
    return Guard(LearnedMetric(network), spare=QuasiNewton() if spare else None)


def cancelled_before(step: int) -> Callable[[], bool]:
    """Whether so many steps are begun."""
    calls = itertools.count(1)
    return lambda: next(calls) >= step


def descents(build: Callable[[], Integrator], budget: Callable[[], Budget]) -> tuple[list[Any], list[LevelReport]]:
    """Tensors and numbers after a descent, and after another one that goes on from it; and the reports."""
    system, x = problem()
    found, reports, integrator, carry = list[Any](), list[LevelReport](), build(), None
    for _ in range(2):
        carry, report = descend(system, integrator, x, level=0, budget=budget(), resume=carry)
        found += [carry.x, carry.force, carry.energy, carry.remaining, carry.mover, carry.setbacks, system.counted]
        reports.append(report)
    return found, reports


CASES: dict[str, tuple[Callable[[], Integrator], Callable[[], Budget], Callable[[LevelReport], object]]] = {
    "all steps": (shipped, lambda: Budget(22), lambda report: report.steps == 22),
    "tolerance": (shipped, lambda: Budget(40, 1e-2), lambda report: report.stopped == "tolerance"),
    "seen": (shipped, lambda: Budget(400, warm=True), lambda report: report.stopped == "seen"),
    "corrections of good memory": (
        lambda: Guard(Overshooting(shipped_network("physgraph"))),
        lambda: Budget(33),
        lambda report: report.movers == {"physgraph": 30, "halved": 2, "quartered": 1},
    ),
    "corrections": (
        lambda: random(0.3, spare=False),
        lambda: Budget(33),
        lambda report: {"physgraph", "halved", "quartered"} <= report.movers.keys(),
    ),
    "spare": (
        lambda: random(1e4, spare=True),
        lambda: Budget(22),
        lambda report: {"fallback", "quasi-newton"} <= report.movers.keys(),
    ),
    "cancelled": (
        shipped,
        lambda: Budget(22, cancelled=cancelled_before(7)),
        lambda report: (report.stopped, report.steps) == ("budget", 6),
    ),
    "deadline": (shipped, lambda: Budget(22, deadline=7.5), lambda report: report.stopped == "budget"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_descent_with_steps_ahead_is_that_of_steps_one_at_a_time(name: str, monkeypatch: pytest.MonkeyPatch):
    build, budget, happens = CASES[name]
    answers = []
    for most in (1, 2, 3, 4):
        monkeypatch.setitem(ahead.STEPS_AHEAD, "cpu", most)
        clock = itertools.count(1)
        monkeypatch.setattr(stop, "time", SimpleNamespace(perf_counter=lambda clock=clock: next(clock)))
        answers.append(descents(build, budget))
    (expected, first), others = answers[0], answers[1:]
    assert happens(first[0]), first[0]
    for found, reports in others:
        assert all(
            torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b for a, b in zip(expected, found, strict=True)
        )
        for one, other in zip(first, reports, strict=True):
            assert vars(one) | {"milliseconds": 0.0} == vars(other) | {"milliseconds": 0.0}


@pytest.mark.parametrize(("most", "waits"), [(1, 0), (2, 11), (4, 6)])
def test_the_numbers_of_several_steps_are_read_at_once(most: int, waits: int, monkeypatch: pytest.MonkeyPatch):
    sizes, read = list[int](), ahead.read
    monkeypatch.setattr(ahead, "read", lambda carries: sizes.append(len(carries)) or read(carries))
    monkeypatch.setitem(ahead.STEPS_AHEAD, "cpu", most)
    system, x = problem()
    descend(system, shipped(), x, level=0, budget=Budget(22))
    assert len(sizes) == waits
    assert sum(sizes) == (22 if waits else 0)


def test_frames_with_steps_ahead_are_those_of_steps_one_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Crossing cloth, cold and warm: rounds with contact, corrected steps, the spare."""
    opened = open_shot(str(write_sample("crossing", tmp_path)), level=1)
    frames, answers = [opened.frame(time) for time in opened.scene.times[:2]], []
    for most in (1, 4):
        monkeypatch.setitem(ahead.STEPS_AHEAD, "cpu", most)
        refiner = Refiner(opened.scene, RefineOptions().solve_settings(), levels=[1] * len(opened.scene.garments))
        answers.append([garment for frame in frames for garment in refiner.solve(frame).garments])
    for one, other in zip(*answers, strict=True):
        assert one.points is not None
        assert other.points is not None
        assert one.points.tobytes() == other.points.tobytes()
        rounds, same = (
            [report | {"milliseconds": 0.0} for report in each.telemetry["levels"]] for each in (one, other)
        )
        assert rounds == same
    movers = {mover for garment in answers[0] for report in garment.telemetry["levels"] for mover in report["movers"]}
    assert {"physgraph", "halved", "quartered"} <= movers
