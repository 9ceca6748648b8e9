"""Recorded steps: the same numbers as step by step. Replaying on CUDA is tested in `test_cuda.py`."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import pytest
import torch
from cloth import FABRIC, GUIDE, finest_system, frame_of, group_of, sheet, wave
from test_self_contact import gaps_of

from physgraph_usd.solver.contact.metric import HeldMetric
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.forces.self_contact import SelfContact
from physgraph_usd.solver.frame.problem import LevelProblem, Problem
from physgraph_usd.solver.frame.solve import solve_frame
from physgraph_usd.solver.frame.values import FrameInput
from physgraph_usd.solver.integrate.base import System
from physgraph_usd.solver.integrate.fused import fused_physgraph
from physgraph_usd.solver.integrate.learned import LearnedMetric
from physgraph_usd.solver.integrate.network import VECTORS, Physgraph, PhysgraphConfig
from physgraph_usd.solver.integrate.weights import random_network
from physgraph_usd.solver.scene import GarmentFrame

LOCAL = PhysgraphConfig(("secant", "metric1", "move1", "diagonal"), width=16)
ALL = PhysgraphConfig(VECTORS, width=8)


def problem() -> tuple[System, torch.Tensor]:
    mesh, rest = sheet(6, 5)
    return finest_system(group_of(mesh, rest, level=2, dtype=torch.float32), wave(rest))


def network_of(config: PhysgraphConfig) -> Physgraph:
    network = random_network(config, seed=3, scale=0.1)
    assert isinstance(network, Physgraph)
    return network


class Recorder(LearnedMetric):
    """Records although it is not on CUDA: it then runs a step's kernels one by one."""

    def records(self, system: System) -> bool:
        return True


@pytest.mark.parametrize("config", [ALL])
def test_recorded_steps_are_the_same_steps(config: PhysgraphConfig):
    """Among them steps that start from an earlier carry, under resumed forces, or where a guard has shortened one."""
    system, x = problem()
    ends = []
    for kind in (LearnedMetric, Recorder):
        integrator = kind(network_of(config))
        carry, before = integrator.start(system, x), (system.evaluations, system.metric_solves)
        for _ in range(7):
            carry = integrator.step(system, carry)
        first = carry.x.clone()
        shortened = integrator.follow(system, carry, carry.x + 0.25 * (integrator.step(system, carry).x - carry.x))
        after = integrator.step(system, integrator.resume(system, shortened))
        assert torch.equal(carry.x, first)
        assert (system.evaluations - before[0], system.metric_solves - before[1]) == (11, 11)
        ends.append((first, shortened.x, after.x, after.energy))
    for one, other in zip(*ends, strict=True):
        if isinstance(one, float):
            assert other == pytest.approx(one, rel=1e-4)
        else:
            assert float((one - other).abs().max()) < 1e-3 * float(system.spacing.mean())


@pytest.mark.parametrize("made", [0, 3])
def test_steps_that_are_no_longer_recorded_keep_the_memory(made: int, monkeypatch: pytest.MonkeyPatch):
    """As where cloth comes near something after a level's first steps: that system is met only once."""
    system, x = problem()
    network = network_of(LOCAL)
    one, other = LearnedMetric(network), Recorder(network)
    a, b = one.start(system, x), other.start(system, x)
    for _ in range(made):
        a, b = one.step(system, a), other.step(system, b)
    monkeypatch.setattr(Recorder, "records", lambda *_: False)
    a, b = one.resume(system, a), other.resume(system, b)
    assert b.memory.step == made
    for _ in range(3):
        a, b = one.step(system, a), other.step(system, b)
        assert float((a.x - b.x).abs().max()) < 1e-3 * float(system.spacing.mean())


def test_a_recording_keeps_what_its_kernels_write_to():
    """A cache of a few would drop it while later levels and garments come by."""
    system, x = problem()
    network = network_of(LOCAL)
    integrator = Recorder(network)
    carry = integrator.step(system, integrator.start(system, x))
    fused = integrator._fused(system)
    known = weakref.ref(fused)
    del fused
    fused_physgraph.cache_clear()
    gc.collect()
    assert known() is not None
    del integrator, carry
    gc.collect()
    assert known() is None


@pytest.mark.parametrize("integrator", ["quasi-newton", "physgraph"])
def test_systems_that_last_solve_each_frame_as_fresh_ones_do(integrator: str, monkeypatch: pytest.MonkeyPatch):
    """A cold frame, warm ones with a tether, another fabric, and creases: systems aimed anew give the same bytes."""
    mesh, rest = sheet(6, 5)
    stiff = Fabric(10.0 * FABRIC.stretch, FABRIC.bend, FABRIC.density)
    creased = replace(FABRIC, crease_time=0.1)
    shown = [(0.0, FABRIC), (0.1, FABRIC), (0.2, FABRIC), (0.2, stiff), (0.3, stiff), (0.4, creased), (0.5, creased)]
    frames = [[GarmentFrame(wave(rest, phase=phase), fabric, GUIDE)] for phase, fabric in shown]
    fresh = Problem.level

    def lasting(problem: Problem, index: int, *, since: float) -> LevelProblem:
        detailed, stiffness = problem.start.detailed, problem.tether
        tie = None if detailed is None or stiffness is None else (stiffness, detailed)
        angles = None if problem.creases is None else problem.creases.rest_angle
        system = problem.forces[index].lasting_system(problem.aim, tie, rest_angle=angles)
        return replace(fresh(problem, index, since=since), alone=system)

    results = []
    for level in (fresh, lasting):
        group = group_of(mesh, rest, level=2, dtype=torch.float32, integrator=integrator)
        monkeypatch.setattr(Problem, "level", level)
        state, points = None, []
        for frame in frames:
            solved = solve_frame(group, FrameInput(frame, elapsed=[0.05]), state)
            state = solved.state
            points.append(solved.points[0])
        results.append(points)
    assert [a.tobytes() for a in results[0]] == [b.tobytes() for b in results[1]]


def test_contact_in_the_buffers_of_a_lasting_system_is_the_same_contact():
    """In rounds with more pairs than before and with fewer, in one room and in another."""
    mesh, rest = sheet(6, 5)
    group, frame = group_of(mesh, rest, level=2, dtype=torch.float64), frame_of(wave(rest))
    lasting, coarse = group.forces_for(frame.garments)[-1], group.cage(frame.garments).points
    alone, x = lasting.lasting_system(coarse), lasting.level.base.apply(coarse)
    kept = set[System]()
    for count, seed in ((40, 0), (60, 1), (20, 2), (300, 3)):
        term = SelfContact(lasting.level, gaps_of(x, count, lack=1e-3, seed=seed))
        metric = HeldMetric(lasting.metric, 3.0 * term.diagonal(x))
        assert isinstance(alone.field, ForceModule)
        expected = lasting.system_in(alone.field.joined_by((term,)), metric)
        system = lasting.touched.of(alone, (term,), metric)
        kept.add(system.recorded)
        for found in (system, system.recorded):
            for one, other in zip(found.energy_and_force(x), expected.energy_and_force(x), strict=True):
                assert one == pytest.approx(other, rel=1e-12)
            force = expected.energy_and_force(x)[1]
            assert torch.allclose(found.apply_short_inverse(force), expected.apply_short_inverse(force), rtol=1e-12)
            assert torch.allclose(found.rest_diagonal_columns, expected.rest_diagonal_columns, rtol=1e-12)
    assert len(kept) == 2
