"""S17, S21, S23, S29, S30: pins in bodies, cloth without room, bodies that jump with the cloth or pass through it."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh
from bodies import BodyMesh, ball, box, together
from cloth import Answer
from folds import EDGE, frame_with, named, refiner_with, square

from physgraph_usd.solver.colliders.pose import Pose
from physgraph_usd.solver.colliders.primitives import primitive

SHEET = square(8)
REST = SHEET[1]
STILL = 1e-4
"""Motion from frame to frame that nobody sees [m]."""


def bodies(answer: Answer, which: str = "after") -> list[dict[str, Any]]:
    """What was measured against each body."""
    return [each[which] for each in answer.telemetry[0].get("contact", {}).get("bodies", {}).values()]


class TestPins:
    """S17."""

    @pytest.mark.parametrize("pins", ["some", pytest.param("none", marks=pytest.mark.slow)])
    def test_s17_pins_against_a_body_are_told_and_nothing_trembles(self, pins: str):
        """Six frames of a cage that moves by less than is seen; pinned vertices start 3 cm inside."""
        radius = np.linalg.norm(REST, axis=1)
        pin = {"none": radius < 0, "one": radius < 0.01, "some": radius < 0.08}[pins].astype(float)
        soup, cage = ball(0.2, level=4), REST + np.array([0.0, 0.17, 0.0])
        one = refiner_with([named(SHEET, pin=pin)], ["mesh"], times=tuple(range(6)))
        states = [one.solve(frame_with([cage + 1e-6 * t], soup, time=float(t))) for t in range(6)]
        for time, state in enumerate(states):
            assert (bodies(state)[0]["pinned"] > 0) == (pins != "none")
            assert bodies(state)[0]["inside"] == 0
            held = np.flatnonzero(pin)
            np.testing.assert_array_equal(state.points[0][held], (cage + 1e-6 * time)[held])
        moves = [np.abs(b.points[0] - a.points[0]).max() for a, b in pairwise(states[1:])]
        assert max(moves) < STILL, moves


def jaws(gap: float, kind: str) -> tuple[Any, ...]:
    """Two bodies above and below the plane of x and z, a gap apart; "one" has both in one mesh."""
    shift = np.array([0.0, 0.05 + 0.5 * gap, 0.0])
    if kind == "capsules":
        size = np.array([0.05, 0.05, 0.1])
        return tuple(primitive("capsule", size, turn=np.eye(3), centre=side * shift) for side in (1.0, -1.0))
    made = [ball(0.05, level=3)] * 2 if kind == "one" else [box((0.18, 0.1, 0.18)), box((0.2, 0.1, 0.2))]
    both = [(points + side * shift, faces) for side, (points, faces) in zip((1.0, -1.0), made, strict=True)]
    return (Pose(*together(*both)),) if kind == "one" else tuple(Pose(*each) for each in both)


def closing(*, stays: int, **options: Any) -> list[float]:
    """Farthest move of a vertex from frame to frame [m] between boxes that close to an overlap of 5 mm and stay."""
    gaps = [*np.linspace(0.02, -0.005, 6), *[-0.005] * stays]
    one = refiner_with([named(SHEET)], KINDS["boxes"], times=tuple(range(len(gaps))), **options)
    points = [
        one.solve(frame_with([REST + 1e-6 * time], *jaws(float(gap), "boxes"), time=float(time))).points[0]
        for time, gap in enumerate(gaps)
    ]
    return [float(np.linalg.norm(b - a, axis=1).max()) for a, b in pairwise(points)]


KINDS = {"capsules": ["capsule"] * 2, "boxes": ["mesh"] * 2, "one": ["mesh"]}


class TestNoRoom:
    """S21, S23."""

    @pytest.mark.parametrize(
        "kind", ["boxes", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("capsules", "one"))]
    )
    def test_s21_cloth_between_jaws_comes_to_rest(self, kind: str):
        """Half a millimetre apart, a quarter of what both keep together: the cloth lies in the middle."""
        found = [
            refiner_with([named(SHEET)], KINDS[kind], steps=steps).solve(frame_with([REST], *jaws(5e-4, kind)))
            for steps in (25, 50)
        ]
        assert np.abs(found[1].points[0] - found[0].points[0]).max() < 1e-3
        assert all(body["inside"] + body["crossings"] == 0 for body in bodies(found[1]))

    def test_s21_cloth_stays_between_two_bodies_that_close_and_overlap(self):
        """A way sideways out of both moved it by 40 mm as they touched, and by up to 13 mm a frame after."""
        moves = closing(stays=4)
        assert max(moves) < 5e-3
        assert max(moves[-3:]) < STILL


def needles() -> BodyMesh:
    """Nine thin cones, tips up."""
    made = []
    for x in (-0.1, 0.0, 0.1):
        for z in (-0.1, 0.0, 0.1):
            cone = trimesh.creation.cone(radius=0.008, height=0.1, sections=12)
            points = np.asarray(cone.vertices)[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
            made.append((points + np.array([x + 0.004, -0.1, z + 0.007]), np.asarray(cone.faces, np.int32)))
    starts = np.cumsum([0, *(len(points) for points, _ in made)])
    return np.concatenate([points for points, _ in made]), np.concatenate(
        [faces + start for (_, faces), start in zip(made, starts, strict=False)]
    ).astype(np.int32)


class TestJumps:
    """S29."""

    @pytest.mark.parametrize("jump", ["half a turn", pytest.param("two metres", marks=pytest.mark.slow)])
    def test_s29_cloth_and_body_jump_together_and_stay_warm(self, jump: str):
        turn = np.diag([-1.0, 1.0, -1.0]) if jump == "half a turn" else np.eye(3)
        shift = np.zeros(3) if jump == "half a turn" else np.array([2.0, 0.0, 0.0])
        cage, (points, triangles) = REST + np.array([0.0, 0.19, 0.02]), ball(0.2, level=3)
        frames = [
            frame_with(
                [(cage + 1e-3 * time) @ (turn if time > 2 else np.eye(3)) + (shift if time > 2 else 0.0)],
                (points @ (turn if time > 2 else np.eye(3)) + (shift if time > 2 else 0.0), triangles),
                time=float(time),
            )
            for time in range(5)
        ]
        states = list(refiner_with([named(SHEET)], ["mesh"], times=tuple(range(5))).refine(frames))
        assert [state.telemetry[0]["start"] for state in states] == ["cold", *["warm"] * 4]
        stays = [frame_with([cage + 1e-3 * time], (points, triangles), time=float(time)) for time in range(5)]
        stayed = list(refiner_with([named(SHEET)], ["mesh"], times=tuple(range(5))).refine(stays))
        for there, here in zip(states[3:], stayed[3:], strict=True):
            assert np.abs((there.points[0] - shift) @ turn - here.points[0]).max() <= 1e-2 * EDGE


STEP = 5 * EDGE
"""Five edge lengths."""


class TestFast:
    """S30."""

    def test_s30_a_ball_that_goes_to_and_fro_through_still_cloth_leaves_nothing_inside(self):
        one = refiner_with([named(SHEET)], ["mesh"], times=tuple(range(6)))
        points, triangles = ball(0.12, level=4)
        for time, height in enumerate((-1.4, -0.4, 0.6, -0.3, 0.7, 1.7)):
            pose = points + np.array([0.03, 0.03 + height * STEP, 0.03]), triangles
            found = bodies(one.solve(frame_with([REST], pose, time=float(time))))
            if found:
                assert found[0]["inside"] == 0
