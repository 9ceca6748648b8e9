"""The last push out of bodies: over corners, and through no other cloth."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from bodies import ball, box
from brute import Soup, crossings
from folds import contact_of, frame_with, levels_of, named, refiner_with, square

from physgraph_usd.solver.level import Placed


class TestCorners:
    @pytest.mark.parametrize("level", [0, 1, 2])
    def test_a_sheet_over_a_block_is_lifted_over_its_corners(self, level: int):
        """Through the upsampled input the block's corners and edges come in dozens of places."""
        cloth = square(8)
        cage = cloth[1] + np.array([0.004, 0.102, 0.003])
        cage[:, 1] -= 0.8 * (np.abs(cage[:, [0, 2]] - [0.004, 0.003]).max(axis=1).clip(0.1) - 0.1)
        state = refiner_with([named(cloth)], ["mesh"], level=level).solve(frame_with([cage], box((0.22, 0.2, 0.22))))
        told = next(iter(state.telemetry[0]["contact"]["bodies"].values()))
        assert told["before"]["crossings"] > 10
        assert told["after"]["inside"] == 0
        assert told["after"]["crossings"] == 0


class TestCloth:
    """What is pushed out of bodies takes no cloth through other cloth."""

    def test_cloth_on_a_body_stops_at_the_cloth_before_it(self):
        """The lower of two sheets 1 mm apart is sent up by 15 mm in the middle, through the upper."""
        cloths = square(4), square(4)
        garments = [named(cloths[0], "A"), named(cloths[1], "B")]
        levels = levels_of(*garments, dtype=torch.float64)
        level = levels[-1]
        upper, start = level.vertex_garment == 1, level.rest.clone()
        start[upper] = 0.97 * start[upper] + torch.tensor([0.0031, 0.001, 0.0017], dtype=start.dtype)
        wanted = start.clone()
        wanted[~upper, 1] += 0.015 * torch.exp(-(wanted[~upper][:, [0, 2]].norm(dim=1) / 0.05).square())
        assert len(crossings(Soup.of(level, wanted))) > 10
        x = contact_of(levels, garments, levels[0].rest).at(level).moved(Placed(start), wanted)
        assert len(crossings(Soup.of(level, x))) == 0
        middle = int(start[~upper][:, [0, 2]].norm(dim=1).argmin())
        assert float(x[middle, 1] - start[middle, 1]) > 0.0005
        assert float((x - wanted)[~upper].norm(dim=1).max()) < 0.015

    @pytest.mark.parametrize("height", [0.0015, 0.004])
    def test_two_sheets_sink_onto_a_ball_together(self, height: float):
        """The cage of the lower one is in the ball, and the last push sends it through the upper."""
        cloth = square(8)
        cages = [cloth[1] + [0.0, 0.147 + number * height, 0.0] for number in range(2)]
        garments = [named(cloth, "A"), named(cloth, "B")]
        answer = refiner_with(garments, ["mesh"]).solve(frame_with(cages, ball(0.15, level=3)))
        told = answer.telemetry[0]["contact"]
        body = next(iter(told["bodies"].values()))
        assert body["before"]["inside"] > 0
        assert body["after"]["inside"] == 0
        assert told["cloth"]["after"]["crossings"] == 0
        over = np.linalg.norm(answer.points[0][:, [0, 2]], axis=1) < 0.1
        assert (answer.points[1][over, 1] > answer.points[0][over, 1]).all()
