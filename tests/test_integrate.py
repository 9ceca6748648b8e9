"""Integrators against mathematics: quadratics, matrices, preconditioners and reasons to stop."""

import gc
import subprocess
import sys
import weakref
from itertools import pairwise

import numpy as np
import psutil
import pytest
import scipy.sparse as sp
import torch
from cloth import Watched, finest_system, group_of, sheet, wave

from physgraph_usd.errors import SolveError
from physgraph_usd.lab.methods import METHODS
from physgraph_usd.lab.methods.lbfgs import Lbfgs
from physgraph_usd.solver.contact.metric import HeldMetric
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.integrate import method_named
from physgraph_usd.solver.integrate.base import ForceField, Integrator, System
from physgraph_usd.solver.integrate.descend import solve_level
from physgraph_usd.solver.integrate.factors import Factors
from physgraph_usd.solver.integrate.metric import MergedMetric, Metric, laplacian
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.stop import Budget


class Quadratic:
    """E = 1/2 (x - minimum) A (x - minimum), A acting alike on each axis."""

    def __init__(self, matrix: np.ndarray, minimum: torch.Tensor) -> None:
        self.matrix, self.minimum = torch.as_tensor(matrix), minimum

    def energy_and_force(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        force = self.matrix @ (self.minimum - x)
        return 0.5 * ((self.minimum - x) * force).sum(), force

    def diagonal(self, x: torch.Tensor) -> torch.Tensor:
        return self.matrix.diagonal().clone()


def spd(count: int, condition: float) -> np.ndarray:
    """A random symmetric positive definite matrix of a given condition."""
    rng = np.random.default_rng(3)
    q = np.linalg.qr(rng.normal(size=(count, count)))[0]
    return q @ np.diag(np.geomspace(1.0, condition, count)) @ q.T


def system_of(matrix: np.ndarray, *, metric: np.ndarray | None = None, fixed: tuple[int, ...] = ()) -> System:
    count = len(matrix)
    free = torch.ones((count, 1), dtype=torch.bool)
    free[list(fixed)] = False
    minimum = torch.as_tensor(np.random.default_rng(1).normal(size=(count, 3)))
    h0 = Metric(sp.csr_matrix(matrix if metric is None else metric), free=free, dtype=torch.float64)
    field = Quadratic(matrix, minimum)
    assert isinstance(field, ForceField)
    return System(field, h0, free=free, spacing=torch.ones(count, dtype=torch.float64))


def minimum_of(system: System) -> torch.Tensor:
    assert isinstance(system.field, Quadratic)
    return system.field.minimum


def start(count: int) -> torch.Tensor:
    return torch.as_tensor(np.random.default_rng(2).normal(size=(count, 3)))


def real_problem(*, level: int = 1) -> tuple[System, torch.Tensor]:
    """A squeezed, waved sheet with every force."""
    mesh, rest = sheet(6, 4)
    return finest_system(group_of(mesh, rest, level=level), wave(rest))


class TestQuasiNewton:
    def test_wrong_metric_converges_in_as_many_steps_as_there_are_curvatures(self):
        """Three curvatures seen through an identity metric: about a step for each, and a few for inexact searches."""
        q = np.linalg.qr(np.random.default_rng(3).normal(size=(12, 12)))[0]
        matrix = q @ np.diag(np.repeat([1.0, 5.0, 30.0], 4)) @ q.T
        system = system_of(matrix, metric=np.eye(12))
        x, report = solve_level(system, QuasiNewton(), start(12), level=0, budget=Budget(60, 1e-7))
        assert report.stopped == "tolerance"
        assert report.steps <= 15, report.steps
        assert float((x - minimum_of(system)).abs().max()) < 1e-6

    @pytest.mark.parametrize("name", METHODS)
    def test_energy_never_rises(self, name: str):
        system, x = real_problem()
        seen: list[float] = []
        solve_level(
            system,
            Watched(method_named(name).build(), lambda carry: seen.append(carry.energy)),
            x,
            level=0,
            budget=Budget(25),
        )
        assert all(after <= before for before, after in pairwise(seen))
        assert seen[-1] < seen[0]

    @pytest.mark.parametrize("name", [name for name in METHODS if "physgraph" not in name])  # networks need a mesh
    def test_fixed_vertices_never_move(self, name: str):
        system = system_of(spd(12, 9.0), metric=np.eye(12), fixed=(0, 5))
        x = start(12)
        out, _ = solve_level(system, method_named(name).build(), x, level=0, budget=Budget(10))
        assert torch.equal(out[[0, 5]], x[[0, 5]])
        assert not torch.equal(out[1], x[1])


class TestWhyItStopped:
    @pytest.mark.parametrize("steps", [0, 7])
    def test_steps(self, steps: int):
        system, x = real_problem()
        out, report = solve_level(system, QuasiNewton(), x, level=3, budget=Budget(steps))
        assert (report.stopped, report.steps, report.level, report.vertices) == ("steps", steps, 3, len(x))
        assert sum(report.movers.values()) == steps
        assert report.milliseconds > 0
        assert torch.equal(out, x) == (report.energy_after == report.energy_before) == (steps == 0)

    def test_stalled(self):
        system = system_of(np.eye(4))
        _, report = solve_level(system, QuasiNewton(), minimum_of(system), level=0, budget=Budget(9))
        assert (report.stopped, report.movers) == ("stalled", {"stayed": 1})

    @pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e200])
    def test_start_that_is_not_finite_is_refused(self, bad: float):
        system = system_of(spd(4, 2.0))
        x = start(4)
        x[2, 1] = bad
        with pytest.raises(SolveError, match=r"level 5: .*not finite"):
            solve_level(system, QuasiNewton(), x, level=5, budget=Budget(3))


def test_a_part_of_the_cloth_is_solved_while_the_rest_is_held():
    mesh, rest = sheet(4, 4, 0.05)
    whole, x = finest_system(group_of(mesh, rest, level=1), wave(rest))
    moving = torch.zeros_like(whole.free)
    moving[: len(x) // 2] = True
    part = System(whole.field, whole.metric, free=whole.free & moving, spacing=whole.spacing, level=whole.level)
    held = ~part.free[:, 0]
    force = part.energy_and_force(x)[1]
    assert not force[held].any()
    assert not part.apply_metric_inverse(force)[held].any()
    out, report = solve_level(part, QuasiNewton(), x, level=0, budget=Budget(20))
    assert torch.equal(out[held], x[held])
    assert report.energy_after < report.energy_before


COUNT = 6


class DoubleWell:
    """E = sum (x^4 / 4 - x^2 / 2): curves downwards within 1/sqrt(3) of the origin, least at 1 and -1."""

    def energy_and_force(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return (x**4 / 4 - x**2 / 2).sum(), x - x**3

    def diagonal(self, x: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(x[:, 0])


def system(*, stiffness: float = 4.0, spacing: float = 1.0, pinned: int = 0) -> System:
    free = torch.arange(COUNT).unsqueeze(1) >= pinned
    metric = Metric(sp.csr_matrix(stiffness * np.eye(COUNT)), free=free, dtype=torch.float64)
    return System(DoubleWell(), metric, free=free, spacing=torch.full((COUNT,), spacing, dtype=torch.float64))


def near_the_saddle() -> torch.Tensor:
    return torch.as_tensor(np.random.default_rng(0).uniform(0.05, 0.2, (COUNT, 3)))


@pytest.mark.parametrize("method", [QuasiNewton(), Lbfgs()], ids=["quasi-newton", "lbfgs"])
def test_secants_of_negative_curvature_are_not_kept(method: Integrator):
    problem = system()
    carry = method.start(problem, near_the_saddle())
    after = method.step(problem, carry)
    moved, yielded = after.x - carry.x, carry.force - after.force
    assert float((moved * yielded).sum()) < 0
    assert after.memory.secants == ()
    kept = 0
    for _ in range(20):
        after = method.step(problem, after)
        assert all(pair.curvature > 0 for pair in after.memory.secants)
        kept = max(kept, len(after.memory.secants))
    assert kept > 0
    assert float((after.x.abs() - 1.0).abs().max()) < 1e-3


def test_the_remaining_move_is_in_local_edges_and_over_the_free_vertices():
    move = torch.full((COUNT, 3), 0.3, dtype=torch.float64)
    expected = 0.3 * np.sqrt(3.0)
    assert system().remaining_move(move) == pytest.approx(expected)
    assert system(spacing=0.01).remaining_move(move) == pytest.approx(100.0 * expected)
    held = system(pinned=4)
    assert held.remaining_move(move * held.free) == pytest.approx(expected)


@pytest.mark.parametrize("tolerance", [1e-1, 1e-3])
def test_the_solve_stops_under_its_tolerance_and_not_before(tolerance: float):
    problem = system()
    moves: list[float] = []
    _, report = solve_level(
        problem,
        Watched(
            QuasiNewton(history=1),
            lambda carry: moves.append(problem.remaining_move(problem.apply_metric_inverse(carry.force))),
        ),
        near_the_saddle() + 1.5,
        level=0,
        budget=Budget(200, tolerance),
    )
    assert report.stopped == "tolerance"
    assert moves[-1] < tolerance
    assert all(move >= tolerance for move in moves[:-1])


@pytest.mark.parametrize("level", [0, 1, 2])
def test_sewn_vertices_move_together_and_the_solve_is_symmetric(level: int):
    """With a side of the cloth fixed, and a stiffness ten times the cloth's at a third of its vertices."""
    mesh, rest = sheet(6, 5)
    system, _ = finest_system(group_of(mesh, rest, level=level, dtype=torch.float64), wave(rest))
    assert system.level is not None
    assert isinstance(system.field, ForceModule)
    side = system.level.rest[:, :1] > system.level.rest[:, 0].min() + 1e-6
    matrix = laplacian(system.level.springs.numpy(), *system.field.rest_springs())
    metric = Metric(matrix, free=side, dtype=torch.float64, ups=system.level.ups)
    rng, label = np.random.default_rng(1), np.arange(len(side))
    label[5], label[9] = 3, 3
    some = rng.random(len(side)) < 0.3
    touched = torch.as_tensor(some * rng.random(len(some)) * 10.0 * float(metric.diagonal.mean()))
    held = HeldMetric(metric.merged(label), touched)
    forces = side[:, :, None] * torch.as_tensor(np.random.default_rng(4).normal(size=(len(side), 2, 3)))
    moves = [held.solve(forces[:, number].contiguous()) for number in range(2)]
    for move in moves:
        assert torch.equal(move[5], move[3])
        assert torch.equal(move[9], move[3])
    work = [float((forces[:, n] * moves[1 - n]).sum()) for n in range(2)]
    assert abs(work[0] - work[1]) < 1e-9 * float((forces[:, 0] * moves[0]).sum())
    metric.merged(label).coarse.dense = True  # As on a card.
    torch.testing.assert_close(HeldMetric(metric.merged(label), touched).solve(forces[:, 0].contiguous()), moves[0])


@pytest.mark.parametrize("level", [0, 2])
def test_a_metric_of_new_materials_takes_over_what_only_the_mesh_determines(level: int):
    """Also where the last materials had no stiffness at all."""
    mesh, rest = sheet(6, 5)
    system, _ = finest_system(group_of(mesh, rest, level=level, dtype=torch.float64), wave(rest))
    assert system.level is not None
    assert isinstance(system.field, ForceModule)
    between, fixed = system.field.rest_springs()
    side = system.level.rest[:, :1] > system.level.rest[:, 0].min() + 1e-6
    given = {"free": side, "dtype": torch.float64, "ups": system.level.ups}
    soft, stiff = (laplacian(system.level.springs.numpy(), each, fixed) for each in (0.0 * between, between))
    last, alone = Metric(soft, **given), Metric(stiff, **given)
    levels = last.coarse
    metric = Metric(stiff, **given, last=last)
    assert metric.coarse.ups is levels.ups
    touched = torch.as_tensor(np.random.default_rng(1).random(len(side)) * 10.0 * float(alone.diagonal.mean()))
    force = side * torch.as_tensor(np.random.default_rng(4).normal(size=(len(side), 3)))
    works = [each.by_levels(touched) for each in (metric, alone)]
    one, other = (work.function(force, *work.tensors)[0] for work in works)
    assert torch.equal(one, other)


@pytest.mark.parametrize("merged", [False, True])
def test_metrics_are_freed_with_their_last_reference(merged: bool):
    """They hold factors, on a card dense inverses: collecting garbage comes too late for those."""
    mesh, rest = sheet(6, 5)
    system, _ = finest_system(group_of(mesh, rest, level=1, dtype=torch.float64), wave(rest))
    assert system.level is not None
    assert isinstance(system.field, ForceModule)
    matrix, count = laplacian(system.level.springs.numpy(), *system.field.rest_springs()), system.level.vertex_count
    force, label = torch.ones((count, 3), dtype=torch.float64), np.arange(count) // 2
    gc.disable()
    try:
        given = {"free": system.free, "dtype": torch.float64, "ups": system.level.ups}
        metric = MergedMetric(matrix, label, **given) if merged else Metric(matrix, **given)
        held = HeldMetric(metric, force[:, 0].contiguous())
        held.held(held.short(held.solve(force)))
        left = [weakref.ref(each) for each in (metric, held)]
        del metric, held
        assert [each() for each in left] == [None, None]
    finally:
        gc.enable()


def test_a_factor_that_something_holds_to_the_end_of_the_process_is_freed_without_a_word():
    """As the traceback of an error does that a host program keeps, or a thread in the midst of a frame."""
    code = """
import threading, time
import scipy.sparse as sp, torch
from physgraph_usd.solver.integrate.factors import Factors
made = threading.Event()

def hold():
    solve = Factors(sp.csr_matrix(sp.identity(3)), dtype=torch.float64, device="cpu").of(torch.full((3,), 2.0).double())
    solve(torch.ones(3, 1).double())
    made.set()
    time.sleep(1000)

threading.Thread(target=hold, daemon=True).start()
made.wait()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_factors_that_solved_something_leave_no_memory_behind():
    """cholespy 2.2 keeps 24 bytes of each vertex of a dropped factor, 96 MB of these."""
    count, process = 20_000, psutil.Process()
    factors = Factors(sp.csr_matrix(sp.identity(count)), dtype=torch.float32, device="cpu")
    values, force = torch.full((count,), 2.0).double(), torch.ones(count, 3)

    def solved(times: int) -> int:
        for _ in range(times):
            assert factors.of(values)(force)[-1, -1] == 0.5
        return process.memory_info().rss

    factors.of(values)
    before = solved(50)
    assert solved(200) - before < 20_000_000
