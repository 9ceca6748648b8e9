"""The last push out of bodies: over corners, with other cloth before it, and never to more crossings than the input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from bodies import box
from brute import Soup, crossings
from folds import EDGE, contact_of, frame_with, levels_of, named, refiner_with, square
from test_untangle import BOTH, UPPER

from physgraph_usd.contact.cloth_mesh import ClothMesh
from physgraph_usd.contact.squeeze import squeezed

GAP = 0.002


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


class TestSqueezed:
    def test_cloth_moves_the_cloth_before_it(self):
        """The lower of two sheets 1 mm apart is pushed up by 15 mm in the middle, through the upper."""
        cloths = square(4), square(4)
        level = levels_of(named(cloths[0], "A"), named(cloths[1], "B"), dtype=torch.float64)[-1]
        mesh, start = ClothMesh(level, BOTH), level.rest.clone()
        upper = level.vertex_garment == 1
        start[upper] = 0.97 * start[upper] + torch.tensor([0.0031, 0.001, 0.0017], dtype=start.dtype)
        x = start.clone()
        x[~upper, 1] += 0.015 * torch.exp(-(x[~upper][:, [0, 2]].norm(dim=1) / 0.05).square())
        kept = x.clone()

        def push_out(y: torch.Tensor) -> torch.Tensor:
            """The lower sheet does not give way."""
            return torch.where(upper.unsqueeze(1), y, kept)

        out = squeezed(mesh, start, x, push_out=push_out, gap=0.001)
        assert len(crossings(Soup.of(level, x))) > 10
        assert len(crossings(Soup.of(level, out))) == 0
        torch.testing.assert_close(out[~upper], x[~upper], atol=0, rtol=0)
        assert float((out - x).norm(dim=1).max()) < 0.02

    def test_what_touches_nothing_stays(self):
        level = levels_of(named(square(4)))[-1]
        start = level.rest.clone()
        x = start + torch.tensor([0.0, 0.01, 0.0])
        assert squeezed(ClothMesh(level, np.ones((1, 1), bool)), start, x, push_out=lambda y: y, gap=0.001) is x


class TestLastResort:
    @pytest.mark.parametrize("size", [0.1, 0.5, 2.0])
    @pytest.mark.parametrize("name", UPPER)
    def test_no_result_crosses_more_than_the_input(self, name: str, size: float):
        """Whatever the solve leaves: here noise of up to two edges, over sheets that start crossed."""
        garments = [named(square(4), each) for each in "AB"]
        levels, cage = levels_of(*garments, dtype=torch.float64), _cage(name)
        base = levels[-1].base.apply(cage)
        contact = contact_of(levels, garments, cage)
        noise = torch.as_tensor(np.random.default_rng(4).normal(size=(len(base), 3))) * size * EDGE
        out, _, _ = contact.finish(base + noise)
        told: Any = contact.measure(out)[0]["cloth"]
        before = len(crossings(Soup.of(levels[-1], base)))
        assert told["before"]["crossings"] == before
        assert told["after"]["crossings"] == len(crossings(Soup.of(levels[-1], out))) <= before


def _cage(name: str) -> torch.Tensor:
    """The cages of a level sheet and of one that passes through it [m]."""
    points = square(4)[1]
    upper = UPPER[name](0.9 * points + np.array([0.0037, 0.0, 0.0051]))
    return torch.as_tensor(np.concatenate([points, upper]))
