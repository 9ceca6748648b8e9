"""The repaired cage: pieces that crossed go back to their side, and cloth between overlapping parts is drawn taut."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bodies import ball, together
from brute import Soup, crossings
from folds import EDGE, frame_with, levels_of, named, refiner_with, square
from test_untangle import BOTH, UPPER, found_in, pair

from physgraph_usd.contact.apart import drawn_apart, pieces_of
from physgraph_usd.contact.cloth_mesh import ClothMesh
from physgraph_usd.contact.repair import repaired_cage
from physgraph_usd.options import RefineOptions
from physgraph_usd.pipeline import Refiner
from physgraph_usd.samples import write_sample
from physgraph_usd.usd.reader import open_shot

GAP = 0.002


class TestPieces:
    @pytest.mark.parametrize("name", ["dented", "cornered", "tilted"])
    def test_the_smaller_ones_are_cut_off(self, name: str):
        level, x = pair(name)
        piece, off, _ = pieces_of(*found_in(level, x))
        under, second = (x[:, 1] < 0).numpy(), (level.vertex_garment == 1).numpy()
        side = under if under[second].mean() < 0.5 else ~under
        np.testing.assert_array_equal(off[piece][second], side[second])

    def test_by_area_not_by_the_number_of_vertices(self):
        """Many small faces are less than few large ones."""
        level, x = pair("tilted")
        mesh, found = found_in(level, x)
        mesh.level.vertex_area.copy_(torch.where(x[:, 1] < 0, 10.0, 1.0).to(x))
        piece, off, _ = pieces_of(mesh, found)
        second = (level.vertex_garment == 1).numpy()
        np.testing.assert_array_equal(off[piece][second], (x[:, 1] > 0).numpy()[second])


class TestDrawnApart:
    @pytest.mark.parametrize("name", ["dented", "cornered", "tilted"])
    def test_the_piece_that_was_cut_off_goes_back(self, name: str):
        """Smaller pieces move, no farther than they were deep and half an edge."""
        level, x = pair(name)
        out, before, after = drawn_apart(ClothMesh(level, BOTH), x, gap=GAP)
        assert before == len(crossings(Soup.of(level, x))) > 0
        assert after == len(crossings(Soup.of(level, out))) == 0
        moved = (out - x).norm(dim=1) > 1e-9
        assert 0 < float(moved.double().mean()) < 0.25
        deepest = float(-x[:, 1].min())
        assert float((out - x).norm(dim=1).max()) < deepest + 0.5 * EDGE

    def test_positions_without_crossings_are_the_result(self):
        level, x = pair("tilted")
        x[level.vertex_garment == 1, 1] += 1.0
        out, before, after = drawn_apart(ClothMesh(level, BOTH), x, gap=GAP)
        assert out is x
        assert before == after == 0

    @pytest.mark.parametrize("name", UPPER)
    def test_never_more_crossings(self, name: str):
        level, x = pair(name)
        _, before, after = drawn_apart(ClothMesh(level, BOTH), x, gap=GAP)
        assert after <= before

    def test_pins_stay(self):
        level, x = pair("cornered")
        level.free[level.vertex_garment == 1] = False
        out, *_ = drawn_apart(ClothMesh(level, BOTH), x, gap=GAP)
        torch.testing.assert_close(out, x, atol=0, rtol=0)


class TestRepairedCage:
    def test_a_cage_that_crosses_nothing_is_followed_itself(self):
        level = levels_of(named(square(4)))[0]
        x = level.rest.clone()
        assert repaired_cage(level, x, bodies=None, mesh=ClothMesh(level, np.ones((1, 1), bool)), gap=GAP) is x

    def test_cloth_between_overlapping_parts_comes_to_lie_between_them(self):
        """Two balls overlap by 6 cm; a sheet goes through the first, 2 cm beside the lens: none stays inside alone."""
        body = together(ball(0.1, at=(-0.07, 0.0, 0.0)), ball(0.1, at=(0.07, 0.0, 0.0)))
        cells = square(12, edge=0.025)
        upright = np.ascontiguousarray(cells[1][:, [1, 0, 2]]) + np.array([-0.05, 0.0, 0.0])
        one = refiner_with([named(cells)], ["mesh"])
        state = one.solve(frame_with([upright], body))
        told = next(iter(state.telemetry[0]["contact"]["bodies"].values()))
        assert told["before"]["inside"] + told["before"]["pinched"] > 50
        assert told["after"]["inside"] == 0
        assert 5 < state.telemetry[0]["contact"]["repaired"]["vertices"] < 100
        assert 1.0 < state.telemetry[0]["contact"]["repaired"]["largest_mm"] < 100.0
        hidden = np.linalg.norm(state.points[0][:, 1:], axis=1) < 0.03
        assert hidden.sum() > 5
        assert np.abs(state.points[0][hidden, 0]).max() < 0.03


@pytest.mark.slow
def test_a_sleeve_deep_in_the_body_ends_with_no_more_crossings(tmp_path: Path):
    """The T-shirt with an arm through its chest: nothing that has a way out stays inside."""
    shot = open_shot(str(write_sample("tshirt", tmp_path)))
    refiner = Refiner(shot.scene, RefineOptions().solve_settings(), levels=[2])
    telemetry: dict[str, Any] = refiner.solve(shot.frame(36.0)).telemetry[0]
    contact = telemetry["contact"]
    assert contact["cloth"]["before"]["crossings"] > 200
    assert contact["cloth"]["after"]["crossings"] <= contact["cloth"]["before"]["crossings"]
    for body in contact["bodies"].values():
        assert body["after"]["inside"] == 0
        assert body["after"]["pinched"] <= body["before"]["inside"] + body["before"]["pinched"]
