"""Integrators against mathematics: quadratics, matrices and reasons to stop."""

from __future__ import annotations

import time
from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from cloth import Watched, finest_system, group_of, sheet, wave

from physgraph_usd.errors import SolveError, UsageError
from physgraph_usd.lab.methods import METHODS
from physgraph_usd.lab.methods.lbfgs import Lbfgs
from physgraph_usd.lab.methods.newton import Newton
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.integrate import method_named
from physgraph_usd.solver.integrate.base import Carry, ForceField, Integrator, System
from physgraph_usd.solver.integrate.metric import REGULARISATION, Metric, on_edges
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton, backtrack
from physgraph_usd.solver.integrate.solve import Budget, solve_level


class Quadratic:
    """E = 1/2 (x - minimum) A (x - minimum), A acting alike on each axis."""

    def __init__(self, matrix: np.ndarray, minimum: torch.Tensor) -> None:
        self.matrix, self.minimum = torch.as_tensor(matrix), minimum

    def energy_and_force(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        force = self.matrix @ (self.minimum - x)
        return 0.5 * ((self.minimum - x) * force).sum(), force

    def diagonal(self, x: torch.Tensor) -> torch.Tensor:
        return self.matrix.diagonal().clone()


def laplacian(count: int, *, anchor: float = 0.1) -> np.ndarray:
    """A chain of springs, each vertex tied a little to its place: symmetric positive definite."""
    matrix = np.diag(np.full(count, 2.0 + anchor)) - np.eye(count, k=1) - np.eye(count, k=-1)
    matrix[0, 0] = matrix[-1, -1] = 1.0 + anchor
    return matrix


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
    """Where a quadratic's energy is least."""
    assert isinstance(system.field, Quadratic)
    return system.field.minimum


def start(count: int) -> torch.Tensor:
    return torch.as_tensor(np.random.default_rng(2).normal(size=(count, 3)))


def real_problem(*, level: int = 1) -> tuple[System, torch.Tensor]:
    """A squeezed, waved sheet with every force."""
    mesh, rest = sheet(6, 4)
    return finest_system(group_of(mesh, rest, level=level), wave(rest))


class TestMetric:
    @pytest.mark.parametrize(("dtype", "most"), [(torch.float32, 1e-4), (torch.float64, 1e-12)])
    def test_error_is_the_regularisation_and_no_more(self, dtype: torch.dtype, most: float):
        matrix = 1e-4 * laplacian(40)
        shifted = matrix + REGULARISATION * matrix.diagonal().mean() * np.eye(40)
        free = torch.ones((40, 1), dtype=torch.bool)
        force = start(40).to(dtype)
        before = force.clone()
        got = Metric(sp.csr_matrix(matrix), free=free, dtype=dtype).solve(force).double().numpy()
        expected = np.linalg.solve(shifted, force.double().numpy())
        assert np.abs(got - expected).max() < most * np.abs(expected).max()
        assert torch.equal(force, before)

    def test_fixed_vertices_stay_and_the_rest_is_solved_as_if_they_were_held(self):
        matrix, held = laplacian(30), [0, 7, 29]
        free = torch.ones((30, 1), dtype=torch.bool)
        free[held] = False
        force = start(30)
        got = Metric(sp.csr_matrix(matrix), free=free, dtype=torch.float64).solve(force).numpy()
        keep = np.setdiff1d(np.arange(30), held)
        assert not got[held].any()
        assert np.allclose(got[keep], np.linalg.solve(matrix[np.ix_(keep, keep)], force.numpy()[keep]), rtol=1e-5)

    def test_nothing_free_moves_nothing(self):
        free = torch.zeros((5, 1), dtype=torch.bool)
        metric = Metric(sp.csr_matrix(laplacian(5)), free=free, dtype=torch.float32)
        assert not metric.solve(torch.ones((5, 3))).any()


def test_a_rest_form_kept_to_the_edges_is_definite_and_has_its_row_sums():
    mesh, rest = sheet(6, 4)
    group = group_of(mesh, rest)
    level, (system, _) = group.levels[-1], finest_system(group, wave(rest))
    assert isinstance(system.field, ForceModule)
    whole, edges = system.field.rest_matrix(), level.edges.numpy()
    dense = on_edges(whole, edges).toarray()
    assert np.allclose(dense.sum(axis=1), np.ravel(whole.sum(axis=1)), rtol=1e-9, atol=1e-12 * abs(whole).max())
    assert np.allclose(dense, dense.T, rtol=0, atol=1e-14 * np.abs(dense).max())
    assert np.linalg.eigvalsh(dense).min() > 0
    off = dense - np.diag(dense.diagonal())
    assert (off <= 0).all()
    off[edges[:, 0], edges[:, 1]] = off[edges[:, 1], edges[:, 0]] = 0.0
    assert not off.any()


class TestQuasiNewton:
    def test_exact_metric_solves_a_quadratic_in_one_step(self):
        matrix = spd(12, 50.0)
        system = system_of(matrix)
        method = QuasiNewton()
        carry = method.step(system, method.start(system, start(12)))
        assert float((carry.x - minimum_of(system)).abs().max()) < 1e-4
        assert carry.energy < 1e-8

    def test_wrong_metric_converges_in_as_many_steps_as_there_are_curvatures(self):
        """Three curvatures seen through an identity metric: about a step for each, and a few for inexact searches."""
        q = np.linalg.qr(np.random.default_rng(3).normal(size=(12, 12)))[0]
        matrix = q @ np.diag(np.repeat([1.0, 5.0, 30.0], 4)) @ q.T
        system = system_of(matrix, metric=np.eye(12))
        x, report = solve_level(system, QuasiNewton(), start(12), level=0, budget=Budget(60, 1e-7))
        assert report.stopped == "tolerance"
        assert report.steps <= 15, report.steps
        assert float((x - minimum_of(system)).abs().max()) < 1e-6

    @pytest.mark.parametrize("use_metric", [True, False])
    def test_images_are_the_inverse_metric_of_the_yields(self, use_metric: bool):
        system, x = real_problem()
        method = QuasiNewton() if use_metric else Lbfgs()
        carry = method.start(system, x)
        scale = 1.0 / system.diagonal(x).unsqueeze(1)
        for _ in range(8):
            carry = method.step(system, carry)
        assert 3 <= len(carry.memory.secants) <= 5
        for pair in carry.memory.secants:
            expected = system.apply_metric_inverse(pair.yields) if use_metric else scale * pair.yields
            assert float((pair.image - expected).norm() / expected.norm()) < 1e-9
            assert pair.curvature == pytest.approx(float((pair.move * pair.yields).sum()), rel=1e-12)
            assert pair.curvature > 0

    def test_one_metric_solve_and_mostly_one_force_a_step(self):
        system, x = real_problem()
        _, report = solve_level(system, QuasiNewton(), x, level=0, budget=Budget(20))
        assert report.metric_solves == report.steps + 1
        assert report.evaluations <= 1.5 * report.steps + 1

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


class TestBacktrack:
    def test_shortens_an_overshoot_to_the_minimum_of_its_parabola(self):
        system = system_of(np.eye(4))
        carry = Carry(torch.zeros((4, 3), dtype=torch.float64), *system.energy_and_force(torch.zeros(4, 3).double()))
        direction = 4.0 * carry.force
        found = backtrack(system, carry, direction, float((carry.force * direction).sum()))
        assert found is not None
        assert torch.allclose(found[0], minimum_of(system))

    def test_refuses_ascent(self):
        system = system_of(np.eye(4))
        carry = Carry(torch.zeros((4, 3), dtype=torch.float64), *system.energy_and_force(torch.zeros(4, 3).double()))
        assert backtrack(system, carry, -carry.force, -1.0) is None
        assert backtrack(system, carry, carry.force, float("nan")) is None


class OnAPlateau(Quadratic):
    """The same on top of so much energy that what it falls by near the minimum is lost in rounding errors."""

    def energy_and_force(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        energy, force = super().energy_and_force(x)
        return energy + 1e10 + 2e-6 * torch.sin(1e9 * x.sum()), force


class TestRounding:
    def test_steps_go_on_by_the_force_where_the_energy_tells_nothing(self):
        plain = system_of(spd(12, 50.0), metric=np.eye(12))
        assert isinstance(plain.field, Quadratic)
        field = OnAPlateau(plain.field.matrix.numpy(), plain.field.minimum)
        system = System(field, plain.metric, free=plain.free, spacing=plain.spacing)
        _, report = solve_level(system, QuasiNewton(), start(12), level=0, budget=Budget(100, tolerance=1e-9))
        assert report.stopped == "tolerance"
        assert report.evaluations < 2 * report.steps

    @pytest.mark.parametrize("by_force", [False, True])
    def test_only_who_says_so_goes_by_the_force(self, by_force: bool):
        """The guard promises that the energy never rises, not even by its rounding."""
        system, x = system_of(np.eye(12)), torch.zeros((12, 3), dtype=torch.float64)
        system.field.energy_and_force = lambda at: (1e10 + 2e-6 * at.any().double(), torch.ones_like(at))  # pyright: ignore
        carry = Carry(x, *system.energy_and_force(x))
        assert (backtrack(system, carry, torch.ones_like(x), 36.0, by_force=by_force) is not None) == by_force

    @pytest.mark.parametrize(("share", "kept"), [(0.5, 2), (0.001, 0)])
    def test_a_step_that_was_shortened_much_drops_the_secants(self, share: float, kept: int, monkeypatch):
        def short(system: System, carry: Carry, direction: torch.Tensor, slope: float, **_: bool):
            x = carry.x + share * direction
            return x, *system.energy_and_force(x)

        system, method = system_of(spd(12, 50.0), metric=np.eye(12)), QuasiNewton()
        carry = method.step(system, method.start(system, start(12)))
        monkeypatch.setattr("physgraph_usd.solver.integrate.quasi_newton.backtrack", short)
        assert len(method.step(system, carry).memory.secants) == kept


class TestNewton:
    def test_direction_on_a_quadratic_is_exact_with_the_exact_metric(self):
        matrix = spd(10, 20.0)
        system = system_of(matrix)
        method = Newton()
        carry = method.start(system, start(10))
        got = method._direction(system, carry)
        expected = torch.as_tensor(np.linalg.solve(matrix, carry.force.numpy()))
        assert float((got - expected).norm() / expected.norm()) < 1e-5

    def test_converges_faster_than_linearly_on_cloth(self):
        system, x = real_problem()
        moves: list[float] = []
        solve_level(
            system,
            Watched(
                Newton(inner_steps=1000),
                lambda carry: moves.append(system.remaining_move(system.apply_metric_inverse(carry.force))),
            ),
            x,
            level=0,
            budget=Budget(60, 1e-9),
        )
        assert moves[-1] < 1e-9
        assert moves[-1] < 0.05 * moves[-2], moves[-4:]

    def test_agrees_with_quasi_newton_where_there_is_one_minimum(self):
        """Stretched cloth does not buckle."""
        mesh, rest = sheet(6, 4)
        system, x = finest_system(group_of(mesh, rest), wave(rest, squeeze=-0.1, height=0.005))
        reference = solve_level(system, Newton(), x, level=0, budget=Budget(60, 1e-9))[1].energy_after
        found = solve_level(system, QuasiNewton(), x, level=0, budget=Budget(400, 1e-7))[1].energy_after
        assert found == pytest.approx(reference, rel=1e-6)

    def test_negative_curvature_gives_a_descent_direction(self):
        """A flat sheet under compression is a saddle: H is indefinite there."""
        mesh, rest = sheet(6, 4)
        points = wave(rest, squeeze=0.2, height=1e-4)
        system, x = finest_system(group_of(mesh, rest), points)
        method = Newton()
        carry = method.start(system, x)
        assert float((method._direction(system, carry) * carry.force).sum()) > 0
        assert method.step(system, carry).energy < carry.energy


class TestWhyItStopped:
    @pytest.mark.parametrize("steps", [0, 7])
    def test_steps(self, steps: int):
        system, x = real_problem()
        out, report = solve_level(system, QuasiNewton(), x, level=3, budget=Budget(steps))
        assert (report.stopped, report.steps, report.level, report.vertices) == ("steps", steps, 3, len(x))
        assert sum(report.movers.values()) == steps
        assert report.milliseconds > 0
        assert torch.equal(out, x) == (report.energy_after == report.energy_before) == (steps == 0)

    def test_deadline(self):
        system, x = real_problem()
        _, report = solve_level(system, QuasiNewton(), x, level=0, budget=Budget(500, 0.0, time.perf_counter()))
        assert (report.stopped, report.steps) == ("budget", 0)

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


def test_names():
    assert all(isinstance(method.build(), Integrator) for method in METHODS.values())
    with pytest.raises(UsageError, match=r"unknown integrator 'strech'; known integrators: .*quasi-newton"):
        method_named("strech")


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
