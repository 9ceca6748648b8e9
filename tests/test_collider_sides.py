"""The side on which cloth belongs, where an artist says so: winding, start, front, back."""

from pathlib import Path

import igl
import numpy as np
import pytest
from bodies import around, ball, flipped, pane, signed, split, surfaces, together, tube
from cloth import sheet
from folds import frame_with, measured, named, refiner_with
from pxr import Usd, UsdGeom
from stages import COLLIDER_API, add_mesh, add_sheet, author, new_stage, save, set_matrix

from physgraph_usd.errors import SchemaError
from physgraph_usd.solver.contact.broad_phase import Bodies
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.schema import COLLIDER, SIDES

MESH, REST = sheet(6, 6, 0.05)
FLAT = np.ascontiguousarray((REST - REST.mean(axis=0))[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0]))
"""A small sheet lying level."""
SHEET = named((MESH, REST))


TUBE = tube(rows=17)
TUBES = {
    "tube": TUBE,
    "inward": flipped(TUBE),
    "mixed": flipped(TUBE, 0.5),
    "split": split(TUBE),
    "two": together(TUBE, (TUBE[0] + np.array([0.5, 0.0, 0.0]), TUBE[1])),
}


class TestWinding:
    @pytest.mark.parametrize("name", TUBES)
    def test_open_pieces_have_the_inside_that_libigls_winding_number_gives(self, name: str):
        soup = TUBES[name]
        (surface,) = surfaces(soup, "winding")
        assert surface.closed
        outward = TUBES["two" if name == "two" else "tube"]
        x = around(soup, 3000)
        number = np.asarray(igl.winding_number(outward[0], outward[1].astype(np.int64), x))
        clear = np.abs(number - 0.5) > 0.03
        assert 200 < (number[clear] > 0.5).sum() < 2500
        np.testing.assert_array_equal(signed(surface, x)[clear] < 0, number[clear] > 0.5)

    @pytest.mark.parametrize("side", ["auto", "winding"])
    def test_cloth_that_starts_in_an_open_body_comes_out_of_it(self, side: str):
        """A dome without a floor: on auto what starts under it belongs there."""
        points, triangles = ball(0.2, level=4)
        dome = points, triangles[points[triangles][:, :, 1].min(axis=1) > -0.05]
        state = refiner_with([SHEET], ["mesh"], level=2, side=side).solve(
            frame_with([FLAT + np.array([0.0, 0.19, 0.0])], dome)
        )
        assert measured(state)["inside"] == 0
        assert measured(state, "before")["inside"] == (0 if side == "auto" else pytest.approx(75, abs=25))
        found = state.points[0]
        assert (np.linalg.norm(found, axis=1) > 0.1995).all() == (side == "winding")


class TestStart:
    @pytest.mark.parametrize("side", ["auto", "start"])
    def test_cloth_inside_a_closed_body_stays_there_only_with_start(self, side: str):
        soup = ball(0.3, level=4)
        start = FLAT + np.array([0.0, -0.2, 0.0])
        state = refiner_with([SHEET], ["mesh"], level=2, side=side).solve(frame_with([start], soup))
        points = state.points[0]
        radius = np.linalg.norm(points, axis=1)
        assert (radius < 0.3).all() == (side == "start")


class TestFrontAndBack:
    @pytest.mark.parametrize(("side", "up"), [("front", 1.0), ("back", -1.0), ("start", None)])
    def test_the_side_of_an_open_surface_is_fixed(self, side: str, up: float | None):
        (surface,) = surfaces(pane(), side)
        assert (surface.closed, surface.fixed_side) == (False, up)
        x = np.array([[0.1, 0.2, 0.1], [0.1, -0.2, 0.1], [2.0, 0.2, 0.1], [2.0, -0.2, 0.1]])
        signs = np.sign(signed(surface, x))
        expected = [1.0, 1.0] if up is None else [up, -up]
        np.testing.assert_array_equal(signs, [*expected, 1.0, 1.0])

    @pytest.mark.parametrize(("side", "above"), [("front", True), ("back", False), ("auto", False)])
    def test_cloth_that_starts_under_a_floor(self, side: str, above: bool):
        start = FLAT + np.array([0.0, -0.004, 0.0])
        state = refiner_with([SHEET], ["mesh"], level=2, side=side, gravity=np.zeros(3)).solve(
            frame_with([start], pane())
        )
        points = state.points[0]
        assert (points[:, 1] > 0.0).all() == above
        assert (points[:, 1] < 0.0).all() != above


BODY = "/World/body"


class TestOnStages:
    @pytest.fixture
    def stage(self, tmp_path: Path) -> Usd.Stage:
        made = new_stage(tmp_path / "s.usda")
        add_sheet(made)
        add_mesh(made, BODY, *pane(), schema=COLLIDER_API)
        return made

    def side(self, stage: Usd.Stage) -> str:
        return open_shot(save(stage)).scene.colliders[0].side

    @pytest.mark.parametrize("side", SIDES)
    def test_every_word_is_read(self, stage: Usd.Stage, side: str):
        assert COLLIDER["collider:side"].tokens == SIDES
        assert self.side(stage) == "auto"
        author(stage.GetPrimAtPath(BODY), "physgraph:collider:side", side, kind="token")
        assert self.side(stage) == side

    @pytest.mark.parametrize(("kind", "value"), [("token", "left"), ("float", 1.0)])
    def test_anything_else_is_refused_by_name(self, stage: Usd.Stage, kind: str, value: object):
        author(stage.GetPrimAtPath("/World"), "physgraph:collider:side", value, kind=kind)
        with pytest.raises(SchemaError, match=r"</World>\.physgraph:collider:side.*auto, winding, start, front, back"):
            self.side(stage)

    @pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
    @pytest.mark.parametrize("scale", [(1, 1, 1), (-1, 1, 1), (1, -1, 1), (-1, -1, 2)])
    def test_the_front_is_usds(self, stage: Usd.Stage, orientation: str, scale: tuple[int, int, int]):
        prim = stage.GetPrimAtPath(BODY)
        UsdGeom.Mesh(prim).CreateOrientationAttr(orientation)
        set_matrix(prim, np.diag([*scale, 1.0]).astype(float))
        author(prim, "physgraph:collider:side", "front", kind="token")
        pose = open_shot(save(stage)).frame(1.0).colliders[0]
        assert pose is not None
        a, b, c = (pose.points[pose.triangles[:, corner]] for corner in range(3))
        local = np.array([0.0, 1.0 if orientation == "rightHanded" else -1.0, 0.0])
        image = np.linalg.inv(np.diag(scale)).T @ local
        assert (np.cross(b - a, c - a) @ image > 0).all()

    def test_a_mirror_that_comes_and_goes_turns_the_faces(self, stage: Usd.Stage):
        prim = stage.GetPrimAtPath(BODY)
        operation = UsdGeom.Xformable(prim).AddScaleOp()
        for time, x in ((1.0, 1.0), (2.0, -1.0), (3.0, 1.0)):
            operation.Set((x, 1.0, 1.0), time)
        author(prim, "physgraph:collider:side", "front", kind="token")
        shot = open_shot(save(stage))
        for time in (1.0, 2.0, 3.0):
            pose = shot.frame(time).colliders[0]
            assert pose is not None
            a, b, c = (pose.points[pose.triangles[:, corner]] for corner in range(3))
            assert (np.cross(b - a, c - a)[:, 1] > 0).all()

    def test_a_plane_can_be_turned_and_has_no_start_side(self, stage: Usd.Stage):
        plane = UsdGeom.Plane.Define(stage, "/World/plane").GetPrim()
        plane.AddAppliedSchema(COLLIDER_API)
        for side in ("front", "back", "start"):
            author(plane, "physgraph:collider:side", side, kind="token")
            shot = open_shot(save(stage))
            bodies = Bodies(shot.scene.colliders, device="cpu", threads=1)
            bodies.pose(shot.frame(1.0).colliders)
            (found,) = bodies.touching([1], [[0.0]])
            above = np.array([[0.3, 0.2, 0.01]])
            assert signed(found.surface, above) == pytest.approx(-0.01 if side == "back" else 0.01, abs=1e-6)
            assert any("no start side" in str(notice) for notice in shot.warnings) == (side == "start")
