"""The solve of a level that touches: what is apart stays apart, what may go goes, and what rests stays."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from bodies import ball
from brute import Soup, crossings
from folds import EDGE, contact_of, folded, levels_of, named, square, strip

from physgraph_usd.solver.colliders.mesh import MeshBody, MeshSurface
from physgraph_usd.solver.colliders.pose import MeshPose
from physgraph_usd.solver.contact.bodies import STALE, FrameBodies, Touching
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.frame.problem import LevelProblem
from physgraph_usd.solver.frame.solve import solve_one_level
from physgraph_usd.solver.integrate.base import System
from physgraph_usd.solver.integrate.metric import Metric
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.solve import Budget, LevelReport
from physgraph_usd.solver.level import Level


class Springs:
    """Each vertex on a spring to a place of its own [m]."""

    def __init__(self, goal: torch.Tensor) -> None:
        self.goal = goal

    def energy_and_force(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return 0.5 * (x - self.goal).square().sum(), self.goal - x

    def diagonal(self, x: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(x[:, 0])


def system_of(level: Level, field: Springs) -> System:
    """Springs at a level, by themselves, with the metric that fits them."""
    metric = Metric(sp.csr_matrix(sp.identity(level.vertex_count)), free=level.free, dtype=level.dtype)
    return System(field, metric, free=level.free, spacing=level.spacing, level=level)


class Fold:
    """A fold whose upper half is drawn through the lower one at a vertex, and along z elsewhere."""

    def __init__(self, **settings: str) -> None:
        cloth, points = strip()
        garment = named((cloth, points))
        self.levels = levels_of(garment)
        self.level = self.levels[1]
        cage = torch.as_tensor(folded(points, 0.4 * EDGE), dtype=torch.float32)
        self.view = contact_of(self.levels, [garment], cage, **settings).at(self.level)
        self.x = self.level.base.apply(cage)
        above = (self.x[:, 1] > 0.3 * EDGE) & (self.x[:, 2].abs() < EDGE)
        self.over = torch.nonzero(above & ((self.x[:, 0] - 3 * EDGE).abs() < EDGE)).squeeze(1)
        self.goal = self.x.clone()
        self.goal[self.over[len(self.over) // 2], 1] -= 0.8 * EDGE
        self.away = self.x[:, 0] > self.x[:, 0].max() - EDGE
        self.goal[self.away, 2] += 0.1 * EDGE

    def solved(
        self, goal: torch.Tensor, x: torch.Tensor, *, warm: bool = True, steps: int = 20
    ) -> tuple[torch.Tensor, list[LevelReport]]:
        """The level solved from x, drawn to a goal."""
        system = system_of(self.level, Springs(goal))
        problem = SimpleNamespace(
            level=self.level,
            view=self.view,
            module=ForceModule(()),
            alone=system,
            system=lambda *_, **__: system,
            integrator=QuasiNewton(),
            untangler=QuasiNewton(),
            budget=Budget(steps, tolerance=1e-6),
            near=0.0,
            outward=torch.ones(1),
        )
        smoothing = None if warm else torch.zeros_like(x)
        return solve_one_level(cast(LevelProblem, problem), x, smoothing)[:2]

    def crossings(self, x: torch.Tensor) -> int:
        return len(crossings(Soup.of(self.level, x)))


class TestSolve:
    @pytest.mark.parametrize("warm", [True, False])
    def test_what_would_cross_does_not_and_all_else_comes_where_it_is_drawn(self, warm: bool):
        fold = Fold()
        assert fold.crossings(fold.goal) > fold.crossings(fold.x) == 0
        x, _ = fold.solved(fold.goal, fold.x, warm=warm)
        assert fold.crossings(x) == 0
        torch.testing.assert_close(x[fold.away], fold.goal[fold.away], rtol=0.0, atol=1e-5)
        field = Springs(fold.goal)
        assert float(field.energy_and_force(x)[0]) < 0.5 * float(field.energy_and_force(fold.x)[0])

    @pytest.mark.parametrize("warm", [True, False])
    def test_what_crosses_at_its_start_crosses_no_more_at_its_end(self, warm: bool):
        fold = Fold()
        x, _ = fold.solved(fold.goal, fold.goal, warm=warm)
        assert fold.crossings(x) <= fold.crossings(fold.goal)

    def test_a_step_that_takes_what_crosses_out_is_made(self):
        fold = Fold()
        x, _ = fold.solved(fold.x, fold.goal)
        assert fold.crossings(x) == 0
        torch.testing.assert_close(x, fold.x, rtol=0.0, atol=1e-5)

    @pytest.mark.parametrize("warm", [True, False])
    def test_what_rests_stays_to_the_last_bit(self, warm: bool):
        fold = Fold()
        x, reports = fold.solved(fold.x, fold.x, warm=warm)
        assert torch.equal(x, fold.x)
        assert sum(report.steps for report in reports) == 0

    def test_without_steps_nothing_moves(self):
        fold = Fold()
        assert torch.equal(fold.solved(fold.goal, fold.x, steps=0)[0], fold.x)


class TestPlanes:
    def test_those_of_vertices_that_stay_are_not_looked_for_again(self, monkeypatch):
        garment = named(square(6))
        levels = levels_of(garment)
        surface = MeshBody(device="cpu", threads=1).pose(MeshPose(*ball(0.2, at=(0.0, -0.201, 0.0))))[0]
        cage = torch.as_tensor(garment.rest, dtype=torch.float32)
        body = Touching("/Ball", surface, (0.002,))
        settings = ContactSettings(stiffness=1.0)
        bodies = FrameBodies.begin(levels, [body], cage, origin=np.zeros(3), settings=settings)
        view, level = bodies.at(levels[1], levels[1]), levels[1]
        asked: list[torch.Tensor] = []
        closest = MeshSurface.closest
        monkeypatch.setattr(MeshSurface, "closest", lambda self, x, reach: asked.append(x) or closest(self, x, reach))
        x = level.rest.clone()
        view, first = view.seen(x)
        assert first is not None
        seen = first.planes[0].vertex.long()
        assert len(asked.pop()) >= len(seen) > 20
        moved = x + 0.5 * STALE * level.spacing.unsqueeze(1) * torch.tensor([0.0, 1.0, 0.0])
        one = int(seen[len(seen) // 2])
        moved[one, 0] += 3.0 * STALE * float(level.spacing[one])
        _, second = view.seen(moved)
        assert second is not None
        again = (asked[0].unsqueeze(1) == (moved[seen] - torch.as_tensor(surface.origin)).to(x)).all(dim=2).any(dim=0)
        assert seen[again].tolist() == [one]
        before, after = first.planes[0], second.planes[0]
        assert torch.equal(before.vertex, after.vertex)
        same = before.vertex != one
        assert torch.equal(before.height[same], after.height[same])
        assert torch.equal(before.normal[same], after.normal[same])
        assert not torch.equal(before.normal[~same], after.normal[~same])
