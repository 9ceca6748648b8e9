"""The repaired cage: cloth between overlapping parts is drawn taut."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bodies import ball, together
from folds import crumpled, frame_with, levels_of, named, refiner_with, square

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.colliders.mesh import MeshBody
from physgraph_usd.solver.colliders.pose import MeshPose
from physgraph_usd.solver.contact.bodies import FrameBodies, Touching
from physgraph_usd.solver.contact.cloth_mesh import ClothMesh
from physgraph_usd.solver.contact.repair import repaired_cage
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.usd.read.reader import open_shot


def test_the_mean_beside_a_vertex_is_that_of_its_neighbours():
    level = levels_of(named(square(3), "A"), named(square(3), "B"))[-1]
    mesh = ClothMesh(level, np.ones((2, 2), bool), np.array([[0, level.vertex_count // 2]]))
    values, near = torch.randn((level.vertex_count, 3), dtype=torch.float64), mesh.beside.toarray()
    expected = near @ values.numpy() / near.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.mean_beside(values).numpy(), expected, rtol=1e-12)


class TestRepairedCage:
    def test_a_cage_between_no_parts_is_followed_itself(self):
        """Whether it crosses itself or not, and also where it goes through a body."""
        cloth = square(4)
        garment = named(cloth)
        levels = levels_of(garment)
        for points in (cloth[1], crumpled(cloth[1])):
            cage = torch.as_tensor(points, dtype=torch.float32)
            surface = MeshBody(device="cpu", threads=1).pose(MeshPose(*ball(0.1)))[0]
            body, settings = Touching("/Ball", surface, (0.002,)), ContactSettings(stiffness=1.0)
            bodies = FrameBodies.begin(levels, [body], cage, origin=np.zeros(3), settings=settings)
            view = bodies.at(levels[0], levels[-1])
            view = view.losing(cage)
            mesh = ClothMesh(levels[0], np.ones((1, 1), bool), np.zeros((0, 2), np.int64))
            assert bool(view.within(cage)[0].any())
            assert repaired_cage(levels[0], cage, bodies=view, mesh=mesh) is cage

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
