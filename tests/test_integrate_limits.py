"""What an integrator may keep and when it may stop, on functions whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from cloth import Watched

from physgraph_usd.lab.methods.lbfgs import Lbfgs
from physgraph_usd.solver.integrate.base import Integrator, System
from physgraph_usd.solver.integrate.metric import Metric
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.solve import Budget, solve_level

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


@pytest.mark.parametrize("tolerance", [1e-1, 1e-2, 1e-3])
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
