"""The preconditioner of cloth that something touches is what its formula says, with pins and with seams."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cloth import finest_system, group_of, sheet, wave
from numpy.linalg import inv

from physgraph_usd.solver.contact.metric import COARSE, ROUGH, HeldMetric
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.integrate.metric import Metric, on_edges


def held_by_pins(level: int) -> tuple[Metric, np.ndarray, np.ndarray, list[np.ndarray]]:
    """A metric whose cloth has a fixed side, its matrix, what is free (0 or 1), and the maps between its levels."""
    mesh, rest = sheet(6, 5)
    system, _ = finest_system(group_of(mesh, rest, level=level, dtype=torch.float64), wave(rest))
    assert system.level is not None
    assert isinstance(system.field, ForceModule)
    side = system.level.rest[:, :1] > system.level.rest[:, 0].min() + 1e-6
    matrix, ups = on_edges(system.field.rest_matrix(), system.level.springs.numpy()), system.level.ups
    metric = Metric(matrix, free=side, dtype=torch.float64, ups=ups)
    free = side[:, 0].numpy().astype(float)
    return metric, free[:, None] * matrix.toarray() * free, free, [up.matrix.toarray() for up in ups]


def touched(metric: Metric) -> torch.Tensor:
    """A stiffness at a third of the vertices, ten times the cloth's."""
    rng = np.random.default_rng(1)
    some = rng.random(len(metric.diagonal)) < 0.3
    return torch.as_tensor(some * rng.random(len(some)) * 10.0 * float(metric.diagonal.mean()))


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_the_solve_is_the_sum_over_levels(level: int):
    metric, matrix, free, ups = held_by_pins(level)
    stiff = touched(metric)
    a = matrix + np.diag(free * stiff.numpy())
    expected = ROUGH * np.diag(free / np.where(free > 0, np.diag(a), 1.0))
    basis = np.diag(free)
    for number, up in enumerate(ups):
        basis = basis @ up
        if number < len(ups) - 1:
            diagonal = np.diag(basis.T @ a @ basis)
            expected += (basis * np.where(diagonal > 0, 1.0 / np.maximum(diagonal, 1e-300), 0.0)) @ basis.T
    cage = basis[:, np.abs(basis).sum(axis=0) > 0]
    expected += COARSE * cage @ inv(cage.T @ a @ cage) @ cage.T
    force = free[:, None] * np.random.default_rng(2).normal(size=(len(free), 3))
    found = HeldMetric(metric, stiff).solve(torch.as_tensor(force)).numpy()
    assert np.abs(found - expected @ force).max() < 1e-5 * np.abs(expected @ force).max()


@pytest.mark.parametrize("level", [0, 1, 2])
def test_sewn_vertices_move_together_and_the_solve_is_symmetric(level: int):
    metric, _, free, _ = held_by_pins(level)
    label = np.arange(len(free))
    label[5], label[9] = 3, 3
    held = HeldMetric(metric.merged(label), touched(metric))
    forces = torch.as_tensor(free[:, None, None] * np.random.default_rng(4).normal(size=(len(free), 2, 3)))
    moves = [held.solve(forces[:, number].contiguous()) for number in range(2)]
    for move in moves:
        assert torch.equal(move[5], move[3])
        assert torch.equal(move[9], move[3])
    work = [float((forces[:, n] * moves[1 - n]).sum()) for n in range(2)]
    assert abs(work[0] - work[1]) < 1e-9 * float((forces[:, 0] * moves[0]).sum())
