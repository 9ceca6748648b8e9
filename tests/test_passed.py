"""Fast bodies: nothing is left inside, and what goes right through the coarse cloth is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bodies import Soup, ball, box
from cloth import sheet
from pxr import Gf, Usd, UsdGeom, Vt
from shots import CLOTH, cloth_shot, faults, refine
from stages import COLLIDER_API, vec3
from touching import frame, measured, mesh_pose, refiner

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.solver.colliders.pose import MeshPose, ShapePose
from physgraph_usd.solver.colliders.sweep import Sweep, through_shape
from physgraph_usd.solver.contact.passed import Passed
from physgraph_usd.usd.read.reader import open_shot

EDGE = 0.05
MESH, REST = sheet(8, 8, EDGE)
HANGING = REST - REST.mean(axis=0)
"""A sheet about the origin, in one plane."""
NORMAL = np.eye(3)[np.ptp(HANGING, axis=0).argmin()]
STEP = 5.0 * EDGE
"""Five edge lengths, along the normal."""


def across(thickness: float, width: float = 0.18) -> Soup:
    """A closed plate parallel to the sheet."""
    size = np.where(NORMAL > 0, thickness, width)
    return box(tuple(size))


def pane(width: float = 0.18) -> Soup:
    """An open square parallel to the sheet."""
    points, triangles = across(1.0, width)
    corners = points[triangles] @ NORMAL
    return points * (1.0 - NORMAL), triangles[(corners > 0).all(axis=1)]


def passing(soup: Soup, steps: list[float], side: str = "auto") -> list[dict]:
    """Telemetry of a still sheet while a body stands at some steps along the normal."""
    solver = refiner((MESH, REST), side=side, gravity=np.zeros(3))
    states = []
    for time, step in enumerate(steps):
        pose = MeshPose(soup[0] + step * STEP * NORMAL, soup[1])
        states.append(solver.solve(frame(HANGING, pose, time=float(time))))
    return [state.telemetry[0] for state in states]


def under(width: float = 0.18) -> int:
    """Cage points that the plate's outline covers."""
    return int((np.abs(HANGING - (HANGING @ NORMAL)[:, None] * NORMAL) < 0.5 * width).all(axis=1).sum())


@pytest.mark.parametrize("soup", [across(0.02), pane()], ids=["plate", "pane"])
def test_a_body_that_goes_right_through_is_told(soup: Soup):
    told = [entry.get("passed_through") for entry in passing(soup, [-1.5, -0.5, 0.5, 1.5])]
    assert told == [None, None, {"/World/Body0": under()}, None]


def test_a_body_that_stops_in_the_cloth_is_no_passage():
    told = [entry.get("passed_through") for entry in passing(ball(0.13), [-1.0, -0.2, 0.0, 0.2])]
    assert told == [None] * 4


def test_a_closed_body_that_moves_five_edges_a_frame_leaves_nothing_inside():
    solver = refiner((MESH, REST), gravity=np.zeros(3))
    points, triangles = ball(0.12, level=4)
    touched = 0
    for time, step in enumerate((-1.4, -0.4, 0.6, -0.3, 0.7, 1.7)):
        pose = mesh_pose((points + step * STEP * NORMAL + 0.03, triangles))
        state = solver.solve(frame(HANGING, pose, time=float(time)))
        if state.telemetry[0]["near"] and "contact" in state.telemetry[0]:
            touched += measured(state, "before")["inside"] > 0
            assert measured(state)["inside"] == 0
    assert touched >= 2


def test_past_the_rim_is_no_passage():
    aside = pane()[0] + 0.5 * (1.0 - NORMAL), pane()[1]
    assert all("passed_through" not in entry for entry in passing(aside, [-0.5, 0.5]))


START = np.array([[0.0, 0.3, 0.0], [0.15, 0.21, 0.0], [0.3, 0.3, 0.0]])
END = np.array([[0.0, -0.3, 0.0], [0.21, 0.15, 0.0], [0.3, -0.3, 0.0]])
"""Right through a box of half size 0.2, over an edge of it, and past it."""


def test_what_slides_over_a_sharp_edge_of_a_mesh_does_not_come_through():
    points, triangles = box((0.4, 0.4, 0.4))
    counts, opposed = Sweep(triangles).passages(points, points, start=START, end=END)
    assert counts.tolist() == [2, 2, 0]
    assert (opposed & (counts > 0)).tolist() == [True, False, False]


@pytest.mark.parametrize("lift", [0.0, 0.1])
def test_what_slides_over_a_sharp_edge_of_a_primitive_does_not_come_through(lift: float):
    """Also while it moves and turns: its own axes are what the ways are seen in."""
    before = ShapePose("cube", np.eye(3), np.zeros(3), np.full(3, 0.2))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) if lift else np.eye(3)
    after = ShapePose("cube", turn, np.array([lift, 2.0 * lift, 0.0]), np.full(3, 0.2))
    assert through_shape(before, after, start=START, end=END @ turn.T + after.centre).tolist() == [True, False, False]


def test_the_block_sample_has_no_passage(tmp_path: Path):
    shot = open_shot(str(write_sample("block", tmp_path)))
    passed = Passed(shot.scene.garments, shot.scene.colliders)
    assert [passed.look(shot.frame(time)) for time in shot.scene.times] == [[{}]] * len(shot.scene.times)


def test_after_a_gap_in_time_nothing_is_compared():
    solver = refiner((MESH, REST), gravity=np.zeros(3))
    solver.solve(frame(HANGING, MeshPose(pane()[0] - STEP * NORMAL, pane()[1]), time=0.0))
    solver.forget()
    state = solver.solve(frame(HANGING, MeshPose(pane()[0] + STEP * NORMAL, pane()[1]), time=1.0))
    assert "passed_through" not in state.telemetry[0]


def test_the_report_warns_of_it(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usdc", frozen=True)
    stage = Usd.Stage.Open(str(shot))
    mesh = UsdGeom.Mesh.Define(stage, "/World/wall")
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([4]))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray([0, 1, 2, 3]))
    mesh.CreatePointsAttr(vec3(np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], float)))
    operation = mesh.AddTranslateOp()
    for time, height in ((3.0, -4.0), (4.0, 4.0)):
        operation.Set(Gf.Vec3d(0.0, 0.0, height), time)
    mesh.GetPrim().AddAppliedSchema(COLLIDER_API)
    stage.Save()
    report = refine(shot, tmp_path / "fine.usdc")
    said = [warning for warning in report.warnings if "right through" in warning]
    assert said == [
        f"<{CLOTH}> at time code 4: the coarse cloth has passed right through </World/wall> since the frame before, "
        "with at most 35 points at once; the refined cloth follows it to the other side"
    ]
    assert faults(tmp_path / "fine.usdc", shot) == []
