"""What `benchmarks.fidelity` hands to a solver outside, and that it comes back simulated."""

from __future__ import annotations

import os

import numpy as np
import pytest

pytest.importorskip("trimesh", reason="benchmarks draw bodies with trimesh")

from benchmarks.fidelity import Task, garment_of, level_at, panel_of, problem_of
from benchmarks.fidelity_stages import SCENES
from physgraph_usd.solver.fabric import PRESETS


@pytest.mark.parametrize("name", SCENES)
def test_panels_are_the_triangles_laid_flat_with_the_warp_upright(name: str):
    stage = SCENES[name]()
    level = level_at(garment_of(stage, 0), 0)
    rest, triangles, panel = level.rest.double().numpy(), level.triangles.numpy(), panel_of(stage, level)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        solid = np.linalg.norm(rest[triangles[:, a]] - rest[triangles[:, b]], axis=1)
        assert np.linalg.norm(panel[:, a] - panel[:, b], axis=1) == pytest.approx(solid, rel=1e-5)
    u, v = panel[:, 1] - panel[:, 0], panel[:, 2] - panel[:, 0]
    assert (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0).all(), "no triangle is turned over"
    down = np.array([0.0, 1.0]) @ np.linalg.inv(np.stack([u, v], axis=2)).transpose(0, 2, 1)
    spans = rest[triangles]
    warp = down[:, :1] * (spans[:, 1] - spans[:, 0]) + down[:, 1:] * (spans[:, 2] - spans[:, 0])
    corners = stage.rest[stage.faces[0]]
    assert ((warp / np.linalg.norm(warp, axis=1, keepdims=True)) @ (corners[3] - corners[0]) > 0).all()


def test_a_problem_has_the_fabrics_stiffnesses_and_moves_what_is_held():
    stage, denim = SCENES["elbow"](), PRESETS["denim"]
    given = problem_of(stage, denim, 0, frames=2)
    assert given["stretch"].tolist() == [226.0, 1054.0, 69.0]
    assert given["targets"].shape == (2 * int(given["substeps"]), stage.held.sum(), 3)
    assert given["middles"].shape[1:] == (2, 3)
    assert np.abs(np.linalg.det(given["turns"]) - 1.0).max() < 1e-9


@pytest.mark.slow
def test_newton_simulates_a_sheet_that_falls_onto_a_ball():
    python = os.environ.get("PHYSGRAPH_NEWTON_PYTHON")
    if not python:
        pytest.skip("PHYSGRAPH_NEWTON_PYTHON does not name a Python that has newton")
    frames = np.array(Task("ball", "silk", 10, python).by_newton(0))
    middle = np.array([0.0, 0.0, -0.18])
    assert np.isfinite(frames).all()
    assert frames[-1][:, 2].min() < -0.15, "it falls"
    assert np.linalg.norm(frames[-1] - middle, axis=1).min() > 0.17, "the ball holds it"
