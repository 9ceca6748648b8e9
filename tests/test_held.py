"""In a held pose cloth slows down and rests; what moves, or is set anew, is followed as ever."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from bodies import ball
from cloth import sheet
from touching import frame, mesh_pose, refiner

from physgraph_usd.solver.colliders.pose import MeshPose, ShapePose
from physgraph_usd.solver.frame import start
from physgraph_usd.solver.frame.start import SLOWER, SLOWEST, STILL, slowing
from physgraph_usd.solver.frame.values import State, join, split
from physgraph_usd.solver.scene import Frame

MESH, REST = sheet(8, 8, 0.05)
HANGING = REST - REST.mean(axis=0)
NORMAL = np.eye(3)[np.ptp(HANGING, axis=0).argmin()]
BALL = ball(0.1)
DRIFT = np.array([1e-6, 0.0, 0.0])
"""Of the cage, a frame [m]: equal frames would be taken over as they are."""
FRAMES = 12


class TestSlowing:
    def test_it_grows_from_frame_to_frame_up_to_a_limit(self):
        held, found = 0, []
        for _ in range(100):
            held, slowed = slowing(held, 0.0)
            found.append(slowed)
        assert held == 100
        assert found[:3] == [SLOWER, SLOWER**2, SLOWER**3]
        assert found[-1] == SLOWEST
        assert sorted(found) == found

    def test_what_moves_ends_it(self):
        assert slowing(30, STILL) == (0, 1.0)
        assert slowing(30, np.inf) == (0, 1.0)

    def test_what_moves_slowly_is_followed(self):
        """Half as fast, four times as stiffly, and no more."""
        found = [slowing(30, part * STILL)[1] for part in (0.999, 0.5, 0.25)]
        assert found == pytest.approx([1.0, 4.0, 16.0], rel=3e-3)


class TestHowFarABodyMoved:
    def test_a_mesh(self):
        points, triangles = BALL
        moved = points.copy()
        moved[3] += [0.3, 0.0, 0.4]
        assert MeshPose(moved, triangles).moved(MeshPose(points, triangles)) == pytest.approx(0.5)
        assert MeshPose(points, triangles).moved(MeshPose(points, triangles)) == 0.0
        assert MeshPose(points, triangles).moved(MeshPose(points, triangles[:-1])) == np.inf
        moved[3] = np.nan
        assert MeshPose(moved, triangles).moved(MeshPose(points, triangles)) == np.inf
        assert MeshPose(points[:0], triangles[:0]).moved(MeshPose(points[:0], triangles[:0])) == 0.0

    @pytest.mark.parametrize("kind", ["capsule", "plane"])
    def test_a_shape(self, kind: str):
        size = np.zeros(3) if kind == "plane" else np.array([0.1, 0.1, 0.3])
        at = ShapePose(kind, np.eye(3), np.zeros(3), size)
        assert at.moved(at) == 0.0
        assert replace(at, centre=np.array([0.0, 0.2, 0.0])).moved(at) == pytest.approx(0.2)
        turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        assert replace(at, turn=turn).moved(at) == pytest.approx(np.sqrt(2.0) * (1.0 if kind == "plane" else 0.3))
        assert at.moved(replace(at, kind="sphere")) == np.inf
        assert at.moved(MeshPose(*BALL)) == np.inf


class TestState:
    def test_garments_that_join_count_from_the_last_to_move(self):
        one, other = (State(torch.zeros(2, 3), torch.zeros(4, 3), torch.zeros(2, 3, 3), held) for held in (7, 2))
        both = join([one, other])
        assert both.held == 2
        assert [each.held for each in split(both, [slice(0, 2), slice(2, 4)], [slice(0, 4), slice(4, 8)])] == [2, 2]


class TestHeldPose:
    def test_cloth_that_has_not_settled_comes_to_rest(self, monkeypatch: pytest.MonkeyPatch):
        held = moves([at(count) for count in range(FRAMES)])
        monkeypatch.setattr(start, "slowing", never)
        free = moves([at(count) for count in range(FRAMES)])
        assert held[0] == pytest.approx(free[0], rel=0.05), "the first frame that is held has only begun to slow down"
        assert free[0] > 5e-4
        assert free[8:].min() > 1e-5
        assert held[8:].max() == pytest.approx(1e-6, rel=0.01), "it stays, but for the drift"

    def test_with_a_body_that_moves_nothing_changes(self, monkeypatch: pytest.MonkeyPatch):
        frames = [at(count, ball_moves=0.003 * count) for count in range(6)]
        slow = solved(frames)
        monkeypatch.setattr(start, "slowing", never)
        assert bool((slow == solved(frames)).all())

    def test_where_one_corner_moves_nothing_changes(self, monkeypatch: pytest.MonkeyPatch):
        """However little that is of the cage."""

        def bent(count: int) -> Frame:
            whole = at(count)
            (garment,) = whole.garments
            points = garment.points.copy()
            points[0] += 0.002 * count * NORMAL
            return replace(whole, garments=(replace(garment, points=points),))

        slow = solved([bent(count) for count in range(5)])
        monkeypatch.setattr(start, "slowing", never)
        assert bool((slow == solved([bent(count) for count in range(5)])).all())

    def test_where_a_body_stops_cloth_slows_down(self, monkeypatch: pytest.MonkeyPatch):
        frames = [at(count, ball_moves=0.003 * min(count, 2)) for count in range(6)]
        slow = solved(frames)
        monkeypatch.setattr(start, "slowing", never)
        free = solved(frames)
        assert bool((slow[:3] == free[:3]).all())
        assert not (slow[3] == free[3]).all()

    def test_what_an_artist_sets_is_followed(self, monkeypatch: pytest.MonkeyPatch):
        def tuned(count: int) -> Frame:
            whole = at(count)
            (garment,) = whole.garments
            stiffer = replace(garment.fabric, bend=garment.fabric.bend * 1.3**count)
            return replace(whole, garments=(replace(garment, fabric=stiffer),))

        slow = solved([tuned(count) for count in range(5)])
        monkeypatch.setattr(start, "slowing", never)
        assert bool((slow == solved([tuned(count) for count in range(5)])).all())


def at(count: int, *, ball_moves: float = 0.0) -> Frame:
    """A sheet held over a ball that it hangs on, but for its drift."""
    body = mesh_pose((BALL[0] - (0.09 - ball_moves) * NORMAL, BALL[1]))
    return frame(HANGING + count * DRIFT, body, time=float(count))


def solved(frames: list[Frame]) -> np.ndarray:
    """Positions in each frame, solved in so few steps that cloth settles for long [m], shape (F, V, 3)."""
    solver = refiner((MESH, REST), level=1, steps=1, tolerance=0.0)
    return np.stack([np.asarray(solver.solve(each).points[0]) for each in frames])


def moves(frames: list[Frame]) -> np.ndarray:
    """The farthest move from frame to frame [m]."""
    return np.linalg.norm(np.diff(solved(frames), axis=0), axis=2).max(axis=1)


def never(_held: int, _motion: float, _pace: float = 1.0, *, again: bool = False) -> tuple[int, float]:
    """Cloth that is never slowed down."""
    del again
    return 0, 1.0
