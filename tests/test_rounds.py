"""Rounds: what crosses at their start is mended, and planes last while vertices stay."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from bodies import ball
from folds import EDGE, contact_of, folded, levels_of, named, square, strip

from physgraph_usd.colliders.mesh import MeshBody, MeshSurface
from physgraph_usd.colliders.pose import MeshPose
from physgraph_usd.contact import rounds
from physgraph_usd.contact.bodies import STALE, FrameBodies, Touching
from physgraph_usd.contact.settings import ContactSettings
from physgraph_usd.integrate.base import System
from physgraph_usd.integrate.metric import Metric
from physgraph_usd.integrate.quasi_newton import QuasiNewton
from physgraph_usd.integrate.solve import Budget
from physgraph_usd.level import Level


class Nothing:
    """No force."""

    def energy_and_force(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.zeros((), dtype=torch.float64), torch.zeros_like(x)

    def diagonal(self, x: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(x[:, 0])


def still(level: Level) -> System:
    metric = Metric(sp.csr_matrix(sp.identity(level.vertex_count)), free=level.free, dtype=level.dtype)
    return System(Nothing(), metric, free=level.free, spacing=level.spacing, level=level)


@pytest.mark.parametrize("warm", [True, False])
def test_what_crosses_at_a_levels_start_is_mended(warm):
    cloth, points = strip()
    garment = named((cloth, points))
    levels = levels_of(garment)
    cage = torch.as_tensor(folded(points, 0.4 * EDGE), dtype=torch.float32)
    contact = contact_of(levels, [garment], cage)
    view, fine = contact.at(levels[1]), levels[1]
    x = fine.base.apply(cage)
    above = (x[:, 1] > 0.3 * EDGE) & (x[:, 2].abs() < EDGE)
    over = torch.nonzero(above & ((x[:, 0] - 3 * EDGE).abs() < EDGE)).squeeze(1)
    x[over[len(over) // 2], 1] -= 0.8 * EDGE
    assert view.cloth is not None
    assert view.cloth.look(x).crossings.count > 0
    assert view.cloth.before.crossings.count == 0
    system = still(fine)
    out, _, _ = rounds.solve_touching(
        lambda *_: system,
        QuasiNewton(),
        x,
        view=view,
        level=fine,
        finest=False,
        outward=None if warm else torch.ones(1),
        budget=Budget(0),
    )
    assert view.cloth.look(out).crossings.count == 0


class TestPlanes:
    def test_those_of_vertices_that_stay_are_not_looked_for_again(self, monkeypatch):
        garment = named(square(6))
        levels = levels_of(garment)
        surface = MeshBody(device="cpu", lanes=1).pose(MeshPose(*ball(0.2, at=(0.0, -0.201, 0.0))))[0]
        cage = torch.as_tensor(garment.rest, dtype=torch.float32)
        body = Touching("/Ball", surface, (0.002,))
        settings = ContactSettings(stiffness=1.0)
        bodies = FrameBodies.begin(levels, [body], cage, origin=np.zeros(3), settings=settings)
        view, level = bodies.at(levels[1], levels[1]), levels[1]
        asked: list[torch.Tensor] = []
        closest = MeshSurface.closest
        monkeypatch.setattr(MeshSurface, "closest", lambda self, x, reach: asked.append(x) or closest(self, x, reach))
        x = level.rest.clone()
        first = view.term(x)
        assert first is not None
        seen = first.planes[0].vertex.long()
        assert len(asked.pop()) >= len(seen) > 20
        moved = x + 0.5 * STALE * level.spacing.unsqueeze(1) * torch.tensor([0.0, 1.0, 0.0])
        one = int(seen[len(seen) // 2])
        moved[one, 0] += 3.0 * STALE * float(level.spacing[one])
        second = view.term(moved)
        assert second is not None
        again = (asked[0].unsqueeze(1) == (moved[seen] - torch.as_tensor(surface.origin)).to(x)).all(dim=2).any(dim=0)
        assert seen[again].tolist() == [one]
        before, after = first.planes[0], second.planes[0]
        assert torch.equal(before.vertex, after.vertex)
        same = before.vertex != one
        assert torch.equal(before.height[same], after.height[same])
        assert torch.equal(before.normal[same], after.normal[same])
        assert not torch.equal(before.normal[~same], after.normal[~same])
