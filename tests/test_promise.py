"""Moves of cloth that nothing newly crosses in: what moves together goes together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from brute import Soup, crossings
from folds import EDGE, levels_of, named, promise_of, square

from physgraph_usd.solver.collide.distance import weights
from physgraph_usd.solver.collide.pairs import Pairs
from physgraph_usd.solver.contact.along import COMES, ApproachLimits, along
from physgraph_usd.solver.level import Placed

GAP = 0.2 * EDGE
FLOOR = 0.02
"""The gap that pairs keep [m], of distances of 0.1."""


def two_sheets() -> tuple[list, torch.Tensor, torch.Tensor]:
    """Levels of two sheets, one closely over the other, their positions, and which vertices are the upper one's."""
    (_, flat), garments = square(4), [named(square(4), each) for each in "AB"]
    levels = levels_of(*garments, dtype=torch.float64)
    level = levels[-1]
    x = torch.as_tensor(level.from_coarse @ np.concatenate([flat, flat + np.array([0.31 * EDGE, GAP, 0.17 * EDGE])]))
    return [levels, garments], x, level.vertex_garment == 1


class TestLayersThatMoveTogether:
    def test_go_where_they_want_but_for_where_they_would_cross(self):
        """Twenty edges along their normal, the lower one half an edge farther than the upper one in places."""
        (levels, garments), x, upper = two_sheets()
        bump = 0.5 * EDGE * torch.exp(-((x - x[~upper].mean(dim=0)) / (2 * EDGE)).square().sum(dim=1)) * ~upper
        way = torch.zeros_like(x)
        way[:, 1] = 20 * EDGE + bump
        y = promise_of(levels, garments).move(Placed(x), x + way)
        assert not crossings(Soup.of(levels[-1], y))
        late = (x + way - y).norm(dim=1)
        assert float(late.max()) < 0.5 * EDGE
        assert float(late.median()) < 0.05 * EDGE

    def test_turned_away_from_one_another_go_all_the_way(self):
        (levels, garments), x, _ = two_sheets()
        c, s = np.cos(1.0), np.sin(1.0)
        wanted = x @ torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=x.dtype)
        assert torch.allclose(promise_of(levels, garments).move(Placed(x), wanted), wanted, atol=1e-9)


class TestAlong:
    def scene(self) -> tuple[torch.Tensor, torch.Tensor, Pairs]:
        """A vertex over a face, and two edges, that all move up, the lower parts faster."""
        face = [[0.3, 0.1, 0.3], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
        edges = [[5.0, 0.1, 0.4], [6.0, 0.1, 0.5], [5.5, 0.0, 0.0], [5.4, 0.0, 1.0]]
        x = torch.tensor(face + edges, dtype=torch.float64)
        way = torch.zeros_like(x)
        way[:, 1] = torch.tensor([10.0, 11.0, 11.0, 11.0, 10.0, 10.0, 12.0, 11.0])
        corners = torch.arange(8, dtype=torch.int32).reshape(2, 4)
        return x, way, Pairs(corners, torch.ones(2, dtype=torch.float64), torch.tensor([True, False]))

    def test_no_pair_comes_nearer_than_it_may_and_together_they_go_as_far(self):
        x, way, pairs = self.scene()
        out = along(way, ApproachLimits.of(x, x, pairs, FLOOR), free=torch.ones(8, 1, dtype=torch.bool))
        weight = weights(x, pairs.corners, pairs.face)
        nearer = -(weight * out[pairs.corners.long(), 1]).sum(dim=1)
        assert torch.allclose(nearer, torch.full_like(nearer, COMES * (0.1 - FLOOR)), atol=1e-6)
        assert torch.allclose(out.sum(dim=0), way.sum(dim=0))

    def test_what_is_held_goes_its_own_way(self):
        x, way, pairs = self.scene()
        free = torch.ones(8, 1, dtype=torch.bool)
        free[0] = False
        out = along(way, ApproachLimits.of(x, x, pairs, FLOOR), free=free)
        assert torch.equal(out[0], way[0])
        weight = weights(x, pairs.corners, pairs.face)
        assert float(-(weight[0] * out[pairs.corners[0].long(), 1]).sum()) <= COMES * (0.1 - FLOOR) + 1e-6

    def test_what_turns_on_its_way_is_held_where_it_meets_what_it_meets(self):
        """An edge over another slides along until its end, which goes down, is over it: no plane of its middle sees
        that."""
        ends = [[-1.0, 0.1, 0.0], [1.0, 0.1, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]
        x, way = torch.tensor(ends, dtype=torch.float64), torch.zeros(4, 3, dtype=torch.float64)
        way[0], way[1] = torch.tensor([0.9, -0.4, 0.0]), torch.tensor([0.9, 0.3, 0.0])
        corners, free = torch.arange(4, dtype=torch.int32).reshape(1, 4), torch.ones(4, 1, dtype=torch.bool)
        met = Pairs(corners, torch.ones(1, dtype=torch.float64), torch.tensor([False]))

        def gap(planes: ApproachLimits) -> float:
            end = x + along(way, planes, free=free)
            part = -end[0, 0] / (end[1, 0] - end[0, 0])
            return float(end[0, 1] + part * (end[1, 1] - end[0, 1]) - end[2:, 1].mean())

        planes = ApproachLimits.of(x, x, met, FLOOR)
        assert gap(planes) < 0.0
        for _ in range(2):
            end = x + along(way, planes, free=free)
            planes = planes.joined(ApproachLimits.of(x, end, replace(met, value=0.0 * met.value), FLOOR, corners=True))
        assert gap(planes) > 0.0
