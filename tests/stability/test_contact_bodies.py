"""S17, S18, S23: cloth against bodies that give it no good place to be; S19 to S22 are rows of the table."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from bodies import Soup, ball, box, flipped, together, tube
from cloth import Answer, base_of
from folds import frame_with, named, refiner_with, square
from test_contact import MESH as WIDE
from test_contact import REST as WIDE_REST
from test_contact import SHAPES, draped
from touching import frame, mesh_pose, refiner

from physgraph_usd.solver.colliders.pose import MeshPose, ShapePose
from physgraph_usd.solver.colliders.primitives import ShapeSurface

SHEET = square(8)
REST = SHEET[1]
STILL = 1e-4
"""Motion from frame to frame that nobody sees [m]."""


def body_of(state: Answer, which: str = "after", body: int = 0) -> dict[str, Any]:
    """What was measured against one body."""
    return list(state.telemetry[0]["contact"]["bodies"].values())[body][which]


class TestPins:
    """S17."""

    def test_s17_all_pinned_inside_a_body_returns_the_input_to_the_bit(self):
        cage = REST + np.array([3.3, 0.15, -1.7])
        soup = ball(0.2, level=3, at=(3.3, 0.0, -1.7))
        state = refiner_with([named(SHEET, pin=np.ones(len(REST)))], ["mesh"]).solve(frame_with([cage], soup))
        np.testing.assert_array_equal(state.points[0][: len(cage)], cage)
        np.testing.assert_allclose(state.points[0], base_of(SHEET[0], cage, 1), rtol=0, atol=1e-14)
        assert body_of(state)["pinned"] > 0

    @pytest.mark.parametrize("pins", ["none", "some"])
    def test_s17_pins_against_a_body_are_told_and_nothing_trembles(self, pins: str):
        """Six frames of a cage that moves by less than is seen; pinned vertices start 3 cm inside."""
        radius = np.linalg.norm(REST, axis=1)
        pin = {"none": radius < 0, "one": radius < 0.01, "some": radius < 0.08}[pins].astype(float)
        soup, cage = ball(0.2, level=4), REST + np.array([0.0, 0.17, 0.0])
        one = refiner_with([named(SHEET, pin=pin)], ["mesh"], times=tuple(range(6)))
        states = [one.solve(frame_with([cage + 1e-6 * t], soup, time=float(t))) for t in range(6)]
        for time, state in enumerate(states):
            assert (body_of(state)["pinned"] > 0) == (pins != "none")
            assert body_of(state)["inside"] == 0
            held = np.flatnonzero(pin)
            np.testing.assert_array_equal(state.points[0][held], (cage + 1e-6 * time)[held])
        moves = [np.abs(b.points[0] - a.points[0]).max() for a, b in pairwise(states[1:])]
        assert max(moves) < STILL, moves


class TestOpen:
    """S18."""

    @pytest.mark.parametrize("turn", [0.5, 1.0])
    def test_s18_an_open_surface_is_not_crossed(self, turn: float):
        """The sheet starts above the flank of an open tube that lies down, whichever way its faces look."""
        points, triangles = flipped(tube(0.15, 0.5), turn)
        lying = points[:, [2, 0, 1]]
        state = refiner((WIDE, WIDE_REST)).solve(frame(draped(0.152), mesh_pose((lying, triangles))))
        fine = state.points[0]
        assert fine is not None
        over = (np.abs(fine[:, 0]) < 0.24) & (np.abs(fine[:, 2]) < 0.1)
        assert (np.linalg.norm(fine[over][:, 1:], axis=1) > 0.149).all()


def pane(size: float, cells: int = 4) -> Soup:
    """An open level square at height zero."""
    ticks = np.linspace(-0.5 * size, 0.5 * size, cells + 1)
    z, x = np.meshgrid(ticks, ticks)
    ids = np.arange(x.size).reshape(cells + 1, cells + 1)
    a, b, c, d = (part.ravel() for part in (ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1), faces


class TestOnTheSurface:
    """S23."""

    @pytest.mark.parametrize("kind", SHAPES)
    def test_s23_a_vertex_on_a_primitive_or_at_its_centre_has_a_normal(self, kind: str):
        surface = ShapeSurface(SHAPES[kind][0])
        rng = np.random.default_rng(3)
        x = torch.as_tensor(np.concatenate([np.zeros((1, 3)), rng.uniform(-0.3, 0.3, (50, 3))]))
        reach = torch.full((len(x),), torch.inf, dtype=x.dtype)
        on = surface.closest(x, reach).point
        for at in (on, x[:1]):
            found = surface.closest(at, reach[: len(at)])
            torch.testing.assert_close(found.normal.norm(dim=1), torch.ones(len(at), dtype=x.dtype))
            assert bool(found.point.isfinite().all())


def jaws(gap: float, kind: str) -> tuple[Any, ...]:
    """Two bodies above and below the plane of x and z, a gap apart; "one" has both in one mesh."""
    shift = np.array([0.0, 0.05 + 0.5 * gap, 0.0])
    if kind == "capsules":
        return tuple(ShapePose("capsule", np.eye(3), side * shift, np.array([0.05, 0.05, 0.1])) for side in (1.0, -1.0))
    made = [ball(0.05, level=3)] * 2 if kind == "one" else [box((0.18, 0.1, 0.18)), box((0.2, 0.1, 0.2))]
    both = [(points + side * shift, faces) for side, (points, faces) in zip((1.0, -1.0), made, strict=True)]
    return (MeshPose(*together(*both)),) if kind == "one" else tuple(MeshPose(*each) for each in both)


KINDS = {"capsules": ["capsule"] * 2, "boxes": ["mesh"] * 2, "one": ["mesh"]}
