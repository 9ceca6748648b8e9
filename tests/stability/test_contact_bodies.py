"""S17 to S23: cloth against bodies that give it no good place to be."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from bodies import Soup, ball, box, distances, flipped, together, tube
from cloth import Answer, base_of
from folds import curved, frame_with, named, refiner_with, square
from test_contact import MESH as WIDE
from test_contact import REST as WIDE_REST
from test_contact import SHAPES, draped, up
from touching import frame, measured, mesh_pose, refiner

from physgraph_usd.solver.colliders.pose import MeshPose, ShapePose
from physgraph_usd.solver.colliders.primitives import ShapeSurface

SHEET = square(8)
REST = SHEET[1]
STILL = 1e-4
"""Motion from frame to frame that nobody sees [m]."""
CAP = 0.05
"""Farthest from its place in the cage that a vertex may be sent: one cage edge [m]."""


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

    @pytest.mark.parametrize("pins", ["none", "one", "some"])
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

    @pytest.mark.parametrize("turn", [0.0, 0.5, 1.0])
    def test_s18_an_open_surface_is_not_crossed(self, turn: float):
        """The sheet starts above the flank of an open tube that lies down, whichever way its faces look."""
        points, triangles = flipped(tube(0.15, 0.5), turn)
        lying = points[:, [2, 0, 1]]
        state = refiner((WIDE, WIDE_REST)).solve(frame(draped(0.152), mesh_pose((lying, triangles))))
        fine = state.points[0]
        assert fine is not None
        over = (np.abs(fine[:, 0]) < 0.24) & (np.abs(fine[:, 2]) < 0.1)
        assert (np.linalg.norm(fine[over][:, 1:], axis=1) > 0.149).all()

    @pytest.mark.parametrize("turn", [0.0, 0.5, 1.0])
    @pytest.mark.parametrize("below", [1.0, -1.0])
    def test_s18_an_open_plane_keeps_each_side(self, below: float, turn: float):
        """Pulled down through it, or lying under it and pulled up."""
        soup = flipped(pane(0.6), turn)
        cage = REST + np.array([0.0, 0.001 * below, 0.0])
        gravity = np.array([0.0, -9.81 * below, 0.0])
        state = refiner_with([named(SHEET)], ["mesh"], gravity=gravity).solve(frame_with([cage], soup))
        assert (below * state.points[0][:, 1] > 0).all()


def pane(size: float, cells: int = 4) -> Soup:
    """An open level square at height zero."""
    ticks = np.linspace(-0.5 * size, 0.5 * size, cells + 1)
    z, x = np.meshgrid(ticks, ticks)
    ids = np.arange(x.size).reshape(cells + 1, cells + 1)
    a, b, c, d = (part.ravel() for part in (ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1), faces


class TestThin:
    """S19."""

    @pytest.mark.parametrize("kind", ["card", "sheet"])
    @pytest.mark.parametrize("layers", [0.0006, 0.003])
    def test_s19_a_thin_body_between_two_layers_stays_between_them(self, kind: str, layers: float):
        """A closed card 0.2 mm thick, and an open sheet; the layers are nearer than the offset, and farther."""
        soup = box((0.3, 0.0002, 0.3)) if kind == "card" else pane(0.3)
        cages = [REST + np.array([0.0, side * layers, 0.0]) for side in (1.0, -1.0)]
        garments = [named(SHEET, "Upper"), named(SHEET, "Lower")]
        for gravity in (np.zeros(3), np.array([0.0, -9.81, 0.0])):
            state = refiner_with(garments, ["mesh"], gravity=gravity).solve(frame_with(cages, soup))
            over = (np.abs(state.points[0][:, [0, 2]]) < 0.14).all(axis=1)
            assert (state.points[0][over, 1] > 0).all()
            under = (np.abs(state.points[1][:, [0, 2]]) < 0.14).all(axis=1)
            assert (state.points[1][under, 1] < 0).all()


class TestDeep:
    """S20, S22."""

    def test_s20_deep_vertices_come_out(self):
        """The middle of the sheet starts 15 cm inside."""
        state = refiner((WIDE, WIDE_REST)).solve(frame(draped(0.05), mesh_pose(ball(0.2, level=4))))
        assert measured(state, "before")["deepest_mm"] > 100
        assert measured(state)["inside"] == 0

    def test_s20_beyond_the_medial_axis_of_a_torso(self):
        """Part of the sheet is nearer to the back than to the front: it comes out there, whole and told before."""
        points, triangles = ball(0.2, level=4)
        torso = points * np.array([1.0, 0.5, 1.0]), triangles
        cage = curved(REST * 1.0) + np.array([0.0, 0.04, 0.0])
        cage[np.linalg.norm(REST, axis=1) < 0.06, 1] = -0.02
        state = refiner_with([named(SHEET)], ["mesh"], level=2).solve(frame_with([cage], torso))
        assert body_of(state, "before")["deepest_mm"] > 50
        assert body_of(state)["inside"] == 0
        assert np.isfinite(state.points[0]).all()

    def test_s22_a_body_that_swallows_the_cloth_is_told_or_left_out(self):
        """A hand in a pocket: with the filter, no bit changes; without, what could not come out is counted."""
        soup, cage = ball(0.5, level=3), REST
        alone = refiner((SHEET), felt=(), level=1).solve(frame(cage)).points[0]
        filtered = refiner((SHEET), felt=(), level=1).solve(frame(cage, mesh_pose(soup))).points[0]
        np.testing.assert_array_equal(alone, filtered)
        state = refiner_with([named(SHEET)], ["mesh"]).solve(frame_with([cage], soup))
        assert body_of(state, "before")["inside"] == len(state.points[0])
        outside = (np.linalg.norm(state.points[0], axis=1) > 0.49).sum()
        told = body_of(state)["inside"] + body_of(state)["pinched"]
        assert outside + told >= len(state.points[0])
        assert np.isfinite(state.points[0]).all()


class TestOnTheSurface:
    """S23; the centre of a sphere is in test_colliders."""

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

    def test_s23_a_sheet_exactly_on_a_body(self):
        """Every vertex of the cage on the top face of a box: all of it is lifted alike, none to the side."""
        cage = REST + np.array([0.0, 0.1, 0.0])
        state = refiner_with([named(SHEET)], ["mesh"]).solve(frame_with([cage], box((0.6, 0.2, 0.6))))
        lifted = state.points[0] - base_of(SHEET[0], cage, 1)
        assert (lifted[:, 1] > 2e-4).all()
        assert np.abs(lifted[:, [0, 2]]).max() < 1e-4

    def test_s23_a_sheet_through_the_centre_of_a_sphere(self):
        state = refiner_with([named(SHEET)], ["sphere"]).solve(frame_with([REST], up("sphere", (0.1, 0.1, 0.1))))
        assert np.isfinite(state.points[0]).all()
        assert body_of(state)["inside"] == 0
        again = refiner_with([named(SHEET)], ["sphere"]).solve(frame_with([REST], up("sphere", (0.1, 0.1, 0.1))))
        np.testing.assert_array_equal(state.points[0], again.points[0])


def jaws(gap: float, kind: str) -> tuple[Any, ...]:
    """Two bodies above and below the plane of x and z, a gap apart; "one" has both in one mesh."""
    shift = np.array([0.0, 0.05 + 0.5 * gap, 0.0])
    if kind == "capsules":
        return tuple(ShapePose("capsule", np.eye(3), side * shift, np.array([0.05, 0.05, 0.1])) for side in (1.0, -1.0))
    made = [ball(0.05, level=3)] * 2 if kind == "one" else [box((0.18, 0.1, 0.18)), box((0.2, 0.1, 0.2))]
    both = [(points + side * shift, faces) for side, (points, faces) in zip((1.0, -1.0), made, strict=True)]
    return (MeshPose(*together(*both)),) if kind == "one" else tuple(MeshPose(*each) for each in both)


KINDS = {"capsules": ["capsule"] * 2, "boxes": ["mesh"] * 2, "one": ["mesh"]}


class TestPinched:
    """S21: an armpit. The cloth is 1 mm thick and keeps 2 mm from bodies."""

    @pytest.mark.parametrize("gap", [0.0015, 0.0005])
    @pytest.mark.parametrize("kind", KINDS)
    def test_s21_in_a_gap_thinner_than_the_cloth_it_lies_in_the_middle(self, kind: str, gap: float):
        state = refiner_with([named(SHEET)], KINDS[kind], steps=50).solve(frame_with([REST], *jaws(gap, kind)))
        self.bounded(state)
        for body in range(len(KINDS[kind])):
            assert body_of(state, body=body)["inside"] == 0
        width = 0.085 if kind == "boxes" else 0.013
        height = state.points[0][np.abs(state.points[0][:, [0, 2]]).max(axis=1) < width, 1]
        assert len(height) > 0
        assert np.abs(height).max() < 0.5 * gap + (0.0 if kind == "boxes" else 5e-4)

    @pytest.mark.parametrize("kind", KINDS)
    def test_s21_between_bodies_that_overlap_it_stays_bounded(self, kind: str):
        """By 5 mm. Boxes leave no way out to the side: there it is as deep in one as in the other."""
        state = refiner_with([named(SHEET)], KINDS[kind], steps=50).solve(frame_with([REST], *jaws(-0.005, kind)))
        self.bounded(state)
        if kind == "boxes":
            deepest = [body_of(state, body=body)["deepest_mm"] for body in (0, 1)]
            assert deepest == pytest.approx([2.5, 2.5], abs=0.05)

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", KINDS)
    def test_s21_50_more_steps_do_not_send_it_to_and_fro(self, kind: str):
        """From 25 to 100 steps, each from cold: it settles, and no vertex moves farther than the cloth is thick."""
        found = []
        for steps in (25, 50, 100):
            one = refiner_with([named(SHEET)], KINDS[kind], steps=steps, tolerance=1e-6)
            state = one.solve(frame_with([REST], *jaws(0.0005, kind)))
            found.append(state.points[0])
        assert state.telemetry[0]["levels"][-1]["remaining_move"] < 1e-4
        assert max(np.linalg.norm(b - a, axis=1).max() for a, b in pairwise(found)) < 1e-3

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", KINDS)
    def test_s21_jaws_that_close_and_stay_closed_over_24_frames(self, kind: str):
        """They close from 2 cm to half a millimetre in 12 frames and stay; in the last eight nothing trembles."""
        moves = self.closing(0.0005, kind)
        assert max(moves) < (0.02 if kind == "boxes" else 0.002), moves
        assert max(moves[-8:]) < STILL, moves

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", KINDS)
    def test_s21_jaws_that_overlap_over_24_frames(self, kind: str):
        assert max(self.closing(-0.005, kind)[-8:]) < 2 * STILL

    def closing(self, gap: float, kind: str) -> list[float]:
        """Farthest move of a vertex from frame to frame [m]."""
        one = refiner_with([named(SHEET)], KINDS[kind], times=tuple(range(24)))
        points = []
        for time, here in enumerate([*np.linspace(0.02, gap, 12), *[gap] * 12]):
            state = one.solve(frame_with([REST + 1e-6 * time], *jaws(float(here), kind), time=float(time)))
            self.bounded(state)
            points.append(state.points[0])
        return [float(np.linalg.norm(b - a, axis=1).max()) for a, b in pairwise(points)]

    @staticmethod
    def bounded(state: Answer) -> None:
        base = base_of(SHEET[0], REST, 1)
        assert np.isfinite(state.points[0]).all()
        assert np.linalg.norm(state.points[0] - base, axis=1).max() < CAP
        for entry in state.telemetry[0]["levels"]:
            assert np.isfinite(entry["energy_after"])
            assert entry["energy_after"] <= entry["energy_before"]


def test_helpers_are_what_they_say():
    upper, lower = jaws(0.01, "boxes")
    assert upper.points[:, 1].min() == pytest.approx(0.005)
    assert lower.points[:, 1].max() == pytest.approx(-0.005)
    capsule = ShapeSurface(jaws(0.01, "capsules")[0])
    at = torch.as_tensor(-capsule.origin[None])
    assert float(capsule.closest(at, torch.full((1,), torch.inf, dtype=torch.float64)).distance) == pytest.approx(0.005)
    assert distances(box((0.2, 0.2, 0.2)), np.array([[0.0, 0.2, 0.0]])) == pytest.approx(0.1)
