"""S27, S29, S30: cloth pulled over bodies, bodies that jump, and bodies that pass to and fro through cloth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from bodies import Soup, ball
from cloth import Answer
from folds import EDGE, frame_with, named, refiner_with, square

SHEET = square(8)
REST = SHEET[1]


def bodies(answer: Answer) -> list[dict[str, Any]]:
    """What was measured against each body."""
    return list(answer.telemetry[0].get("contact", {}).get("bodies", {}).values())


def no_new(answer: Answer) -> None:
    """No more crossings than in the input, of the cloth with bodies or with itself, and nothing inside."""
    for body in bodies(answer):
        assert body["after"]["crossings"] <= body["before"]["crossings"], body
        assert body["after"]["inside"] == 0, body
    cloth = answer.telemetry[0].get("contact", {}).get("cloth")
    if cloth:
        assert cloth["after"]["crossings"] <= cloth["before"]["crossings"], cloth
    assert np.isfinite(answer.points[0]).all()


def needles() -> Soup:
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


class TestPulled:
    """S27, after the scenes of C-IPC; through a torus: tests/test_frame.py."""

    def test_s27_over_a_sphere_that_turns(self):
        """The sheet lies on it; its middle is dragged round, the rim lags behind."""
        radius = np.linalg.norm(REST[:, [0, 2]], axis=1)
        one = refiner_with([named(SHEET)], ["mesh"], times=tuple(range(6)))
        soup = ball(0.12, level=4)
        for time in range(6):
            angle = 0.25 * time * np.exp(-radius / 0.08)
            cos, sin = np.cos(angle), np.sin(angle)
            x, z = REST[:, 0], REST[:, 2]
            height = np.sqrt(np.maximum(0.125**2 - radius**2, 0.0))
            cage = np.stack([cos * x - sin * z, np.maximum(height, 0.125 - 1.1 * radius), sin * x + cos * z], axis=1)
            no_new(one.solve(frame_with([cage], soup, time=float(time))))

    def test_s27_over_needles(self):
        """The cage lies half a millimetre over the tips, and then 4 mm under them."""
        one = refiner_with([named(SHEET)], ["mesh"], level=2, times=(0.0, 1.0))
        for time, height in ((0.0, 0.0005), (1.0, -0.004)):
            no_new(one.solve(frame_with([REST + np.array([0.0, height, 0.0])], needles(), time=time)))


class TestJumps:
    """S29."""

    @pytest.mark.parametrize("jump", ["two metres", "half a turn"])
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
                assert found[0]["after"]["inside"] == 0
