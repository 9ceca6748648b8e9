"""Contact: sheets that rest on bodies."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bodies import BodyMesh, ball, box, distances, flipped, together
from cloth import FABRIC, sheet
from folds import frame_with, measured, named, refiner_with, square

from physgraph_usd.errors import SolveError
from physgraph_usd.solver.colliders.pose import Collider, Pose
from physgraph_usd.solver.colliders.primitives import primitive
from physgraph_usd.solver.contact.broad_phase import Bodies

MESH, REST = sheet(12, 12, 0.05)
FLAT = np.ascontiguousarray((REST - REST.mean(axis=0))[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0]))
"""The sheet lying level: normals up, gravity is down y."""
SHEET = named((MESH, REST))


def draped(height: float) -> np.ndarray:
    """The level sheet at a height."""
    return FLAT + np.array([0.0, height, 0.0])


def up(kind: str, size: tuple[float, float, float]) -> Pose:
    """A primitive whose axis is up, at the origin."""
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    return primitive(kind, np.array(size), turn=turn, centre=np.zeros(3))


SHAPES = {
    "sphere": (up("sphere", (0.2, 0.2, 0.2)), 0.19),
    "plane": (up("plane", (0.0, 0.0, 0.0)), -0.004),
    "cube": (up("cube", (0.15, 0.15, 0.1)), 0.095),
    "cylinder": (up("cylinder", (0.15, 0.15, 0.1)), 0.095),
    "capsule": (up("capsule", (0.15, 0.15, 0.1)), 0.24),
}
MESHES: dict[str, tuple[BodyMesh, float]] = {
    "ball": (ball(level=4), 0.19),
    "block": (box((0.3, 0.2, 0.3)), 0.095),
    "mixed": (flipped(ball(level=4), 0.5), 0.19),
    "two": (together(ball(0.12, at=(-0.12, 0.0, 0.0)), ball(0.12, at=(0.14, 0.0, 0.0))), 0.11),
}


FAST = ("sphere", "plane", "mixed", "two")


class TestRest:
    @pytest.mark.parametrize(
        "kind", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in SHAPES]
    )
    def test_on_a_primitive(self, kind: str):
        pose, height = SHAPES[kind]
        state = refiner_with([SHEET], [kind], level=2).solve(frame_with([draped(height)], pose))
        assert measured(state, "before")["inside"] > 0
        assert measured(state)["inside"] == 0
        assert measured(state)["crossings"] <= measured(state, "before")["crossings"]

    @pytest.mark.parametrize(
        "name", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in MESHES]
    )
    def test_on_a_mesh(self, name: str):
        soup, height = MESHES[name]
        state = refiner_with([SHEET], ["mesh"], level=2).solve(frame_with([draped(height)], soup))
        assert measured(state, "before")["inside"] > 0
        assert measured(state)["inside"] == 0
        assert measured(state)["crossings"] <= measured(state, "before")["crossings"]
        points = state.points[0]
        if name != "two":
            above = points[np.linalg.norm(points[:, [0, 2]], axis=1) < 0.05]
            assert (above[:, 1] > height).all()
        assert distances(soup, points).min() > 2e-4

    def test_a_sheet_over_a_block_is_lifted_over_its_corners(self):
        """Through the upsampled input the block's corners and edges come in dozens of places."""
        cloth = square(8)
        cage = cloth[1] + np.array([0.004, 0.102, 0.003])
        cage[:, 1] -= 0.8 * (np.abs(cage[:, [0, 2]] - [0.004, 0.003]).max(axis=1).clip(0.1) - 0.1)
        state = refiner_with([named(cloth)], ["mesh"], level=2).solve(frame_with([cage], box((0.22, 0.2, 0.22))))
        told = next(iter(state.telemetry[0]["contact"]["bodies"].values()))
        assert told["before"]["crossings"] > 10
        assert told["after"]["inside"] == 0
        assert told["after"]["crossings"] == 0

    def test_the_offset_is_kept(self):
        """Under its own weight alone the sheet sinks into the 2 mm by less than a tenth."""
        pose = SHAPES["plane"][0]
        state = refiner_with([SHEET], ["plane"], level=2, steps=60).solve(frame_with([draped(0.0)], pose))
        points = state.points[0]
        assert 0.0016 < points[:, 1].min() < points[:, 1].max() < 0.0021

    def test_pinned_vertices_stay_and_are_told(self):
        soup, height = MESHES["ball"]
        pin = (np.linalg.norm(FLAT, axis=1) < 0.06).astype(float)
        state = refiner_with([replace(SHEET, pin=pin)], ["mesh"], level=2).solve(frame_with([draped(height)], soup))
        assert measured(state)["pinned"] > 0
        assert measured(state)["inside"] == 0
        points = state.points[0]
        np.testing.assert_allclose(points[np.flatnonzero(pin)], draped(height)[pin > 0], atol=1e-7)


def test_cloth_wholly_behind_a_plane_and_deeper_than_its_size_is_refused():
    solver = refiner_with([SHEET], ["plane"], level=1)
    with pytest.raises(SolveError, match=r"mm deep in <.*>, and only"):
        solver.solve(frame_with([draped(-2.0)], SHAPES["plane"][0]))


@pytest.mark.parametrize(("offset", "counts"), [(0.04, False), (0.06, True)])
def test_a_body_counts_within_its_own_offset(offset: float, counts: bool):
    """A ball that begins 5 cm over the bounds of the cloth."""
    bodies = Bodies([Collider("/World/Ball", "sphere", offset)], device="cpu", threads=1)
    bodies.pose([primitive("sphere", np.full(3, 0.5), turn=np.eye(3), centre=np.array([0.0, 0.55, 0.0]))])
    garment = replace(named((MESH, FLAT)), colliders=(0,))
    assert (bodies.near(garment, np.stack([FLAT.min(axis=0), FLAT.max(axis=0)]), 0.0) == (0,)) == counts


class TestLeftOut:
    def test_a_far_body_changes_no_bit(self):
        far = (ball()[0] + 10.0, ball()[1])
        alone = refiner_with([SHEET], level=2).solve(frame_with([draped(0.0)]))
        beside = refiner_with([SHEET], ["mesh"], level=2).solve(frame_with([draped(0.0)], far))
        np.testing.assert_array_equal(alone.points[0], beside.points[0])
        assert beside.telemetry[0]["near"] == []
        told: Any = beside.telemetry[0].get("contact", {})
        assert "bodies" not in told

    def test_a_moving_body_ends_reuse_only_where_it_is_near(self):
        soup = ball()
        one = refiner_with([SHEET], ["mesh"], level=1)
        one.solve(frame_with([draped(0.19)], soup, time=1.0))
        assert one.solve(frame_with([draped(0.19)], (soup[0].copy(), soup[1]), time=2.0)).reused == (True,)
        moved = (soup[0] + np.array([0.0, 0.01, 0.0]), soup[1])
        assert one.solve(frame_with([draped(0.19)], moved, time=3.0)).reused == (False,)
        far = [(soup[0] + shift, soup[1]) for shift in (10.0, 11.0)]
        two = refiner_with([SHEET], ["mesh"], level=1)
        assert [two.solve(frame_with([draped(0.19)], pose, time=float(t))).reused[0] for t, pose in enumerate(far)] == [
            False,
            True,
        ]

    def test_a_body_without_a_pose_is_not_there(self):
        alone = refiner_with([SHEET], level=2).solve(frame_with([draped(0.0)]))
        state = refiner_with([SHEET], ["mesh"], level=2).solve(frame_with([draped(0.0)], None))
        np.testing.assert_array_equal(alone.points[0], state.points[0])


def test_stiffer_cloth_is_pushed_harder():
    """k_c follows the fabric, so that a stiff one does not cut in."""
    soup, height = MESHES["ball"]
    stiff = replace(FABRIC, stretch=3000.0, bend=1e-3)
    base = frame_with([draped(height)], soup)
    state = refiner_with([SHEET], ["mesh"], level=2).solve(
        replace(base, garments=(replace(base.garments[0], fabric=stiff),))
    )
    assert measured(state)["inside"] == 0
    projected = state.telemetry[0]["contact"]["projected"]  # type: ignore[index]
    assert projected["largest_mm"] < 3.0
