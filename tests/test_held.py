"""In a held pose, or held up where it crosses, cloth slows down and rests; what moves or is set anew is followed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from bodies import ball
from cloth import sheet
from folds import frame_with, named, refiner_with
from pxr import Usd, UsdGeom
from shots import refine
from stages import add_mesh, new_stage, save

from benchmarks.contact_shots import THREADS, open_one
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.frame import start
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.start import STILL, slowing
from physgraph_usd.solver.frame.state import State, join, split
from physgraph_usd.solver.scene import Frame

MESH, REST = sheet(8, 8, 0.05)
SHEET = named((MESH, REST))
HANGING = REST - REST.mean(axis=0)
NORMAL = np.eye(3)[np.ptp(HANGING, axis=0).argmin()]
BALL = ball(0.1)
DRIFT = np.array([1e-6, 0.0, 0.0])
"""Of the cage, a frame [m]: equal frames would be taken over as they are."""
FRAMES = 12


class TestSlowing:
    def test_what_moves_slowly_is_followed(self):
        """Half as fast, four times as stiffly, and no more."""
        found = [slowing(30, part * STILL)[1] for part in (0.999, 0.5, 0.25)]
        assert found == pytest.approx([1.0, 4.0, 16.0], rel=3e-3)

    def test_the_frames_of_a_held_pose_are_counted(self):
        assert [slowing(30, part * STILL)[0] for part in (0.0, 0.5, 1.0)] == [31, 31, 0]


class TestState:
    def test_garments_that_join_count_from_the_last_to_move(self):
        coarse, fine = (torch.zeros(count, 3) for count in (2, 4))
        one, other = (
            State(
                fine.numpy(),
                crossing=np.zeros(4, bool),
                coarse=coarse,
                fine=fine,
                inside=fine[:, 0] > 0,
                given_up=coarse[:, 0] > 0,
                following=coarse[:, 0].long(),
                still_frames=held,
            )
            for held in (7, 2)
        )
        both = join([one, other])
        assert both.still_frames == 2
        assert [each.still_frames for each in split(both, [slice(0, 2), slice(2, 4)], [slice(0, 4), slice(4, 8)])] == [
            2,
            2,
        ]


class TestHeldPose:
    def test_cloth_that_has_not_settled_comes_to_rest(self, monkeypatch: pytest.MonkeyPatch):
        held = moves([at(count) for count in range(FRAMES)])
        monkeypatch.setattr(start, "slowing", never)
        free = moves([at(count) for count in range(FRAMES)])
        assert free[0] > 5e-4
        assert free[8:].min() > 1e-5
        assert held.max() == pytest.approx(1e-6, rel=0.01), "it stays, but for the drift"

    @pytest.mark.parametrize("what", ["a body", "a corner of the cage", "what an artist sets"])
    def test_what_moves_or_is_set_anew_is_followed(self, monkeypatch: pytest.MonkeyPatch, what: str):
        """However little of it that is: as where nothing is ever slowed down.

        The tether pulls from the second step on: in the first, cloth is where it pulls to.
        """

        def changing(count: int) -> Frame:
            whole = at(count, ball_moves=0.003 * count if what == "a body" else 0.0)
            (garment,) = whole.garments
            points, fabric = garment.points.copy(), garment.fabric
            if what == "a corner of the cage":
                points[0] += 0.002 * count * NORMAL
            elif what == "what an artist sets":
                fabric = replace(fabric, bend=fabric.bend * 1.3**count)
            return replace(whole, garments=(replace(garment, points=points, fabric=fabric),))

        frames = [changing(count) for count in range(5)]
        slow = solved(frames, steps=2)
        monkeypatch.setattr(start, "slowing", never)
        assert bool((slow == solved(frames, steps=2)).all())


def at(count: int, *, ball_moves: float = 0.0) -> Frame:
    """A sheet held over a ball that it hangs on, but for its drift."""
    body = (BALL[0] - (0.09 - ball_moves) * NORMAL, BALL[1])
    return frame_with([HANGING + count * DRIFT], body, time=float(count))


def solved(frames: list[Frame], *, steps: int = 1) -> np.ndarray:
    """Positions in each frame, solved in so few steps that cloth settles for long [m], shape (F, V, 3)."""
    solver = refiner_with([SHEET], ["mesh"], level=1, steps=steps, tolerance=0.0)
    return np.stack([np.asarray(solver.solve(each).points[0]) for each in frames])


def moves(frames: list[Frame]) -> np.ndarray:
    """The farthest move from frame to frame [m]."""
    return np.linalg.norm(np.diff(solved(frames), axis=0), axis=2).max(axis=1)


def never(_held: int, _motion: float, _pace: float = 1.0, *, again: bool = False) -> tuple[int, float]:
    del again
    return 0, 1.0


NAMES = ("wide", "thin", "alike")


def tubes(file: Path, jitter: int) -> Path:
    """Closed tubes of 2 cm, a wide one and two thin ones inside it that cross its caps, all but at one place.

    Vertices are moved by up to 0.1 um: at exactly one place rounding decides which of two equal tubes is outside.
    """
    rng = np.random.default_rng(jitter)
    stage = new_stage(file, metres=0.01)
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    for name, half, rings in zip(NAMES, (0.5, 0.05, 0.05), (10, 3, 3), strict=True):
        points = [[half * a, height, half * b] for height in np.linspace(0.0, 2.0, rings) for a, b in corners]
        sides = [
            [4 * r + k, 4 * r + (k + 1) % 4, 4 * r + 4 + (k + 1) % 4, 4 * r + 4 + k]
            for r in range(rings - 1)
            for k in range(4)
        ]
        faces = [*sides, [0, 1, 2, 3], [4 * rings - 1, 4 * rings - 2, 4 * rings - 3, 4 * rings - 4]]
        moved = np.array(points) + 1e-5 * (rng.random((len(points), 3)) - 0.5)
        mesh = add_mesh(stage, f"/World/{name}", moved, faces, schema=None)
        mesh.CreateSubdivisionSchemeAttr("none")
    return Path(save(stage))


@pytest.mark.parametrize("jitter", range(3))
def test_tubes_that_cross_keep_their_length_in_few_steps(tmp_path: Path, jitter: int):
    """Two steps a level do not settle them; the wide one grew by 0.4 of its length, the thin ones shrank by 0.7."""
    few = {"level": 1, "steps": 2, "integrator": "quasi-newton"}
    report = refine(tubes(tmp_path / "shot.usda", jitter), tmp_path / "fine.usdc", garments=["/World/*"], **few)
    assert report.unsettled
    stage = Usd.Stage.Open(str(tmp_path / "fine.usdc"))
    for name in NAMES:
        points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}")).GetPointsAttr().Get())
        assert 1.8 < np.ptp(points, axis=0).max() < 2.6, name


UNSEEN = 1e-4
"""Move of the farthest vertex from frame to frame that nobody sees [m]."""
LEAD, LAST = 3, 6
"""Frames before the held ones, and held frames at the end that are judged: the first ones may still settle."""


@dataclass(frozen=True)
class Moves:
    """Fine vertices; how far the farthest one moves in a frame [m], and how many by over 1 mm: means at the end."""

    vertices: int
    farthest: float
    many: float


def held(name: str, place: Path, *, level: int, frames: int = 15) -> Moves:
    """Refine a few frames of a sample in a row, then hold the pose of the last one but for a drift of its cage."""
    shot, at = open_one(name, place, None)
    times = shot.scene.times[max(at - LEAD, 0) : at + 1]
    settings = RefineOptions().solve_settings()
    refiner = Refiner(shot.scene, settings, levels=[level] * len(shot.scene.garments), device="cpu", threads=THREADS)
    given = [shot.frame(time) for time in times]
    given += [_held(given[-1], count) for count in range(1, frames + 1)]
    solved = [refiner.solve(frame).garments for frame in given][-LAST - 1 :]
    points = [np.concatenate([each.points for each in garments if each.points is not None]) for garments in solved]
    moves = [np.linalg.norm(after - before, axis=1) for before, after in pairwise(points)]
    farthest = float(np.mean([each.max() for each in moves]))
    return Moves(len(points[0]), farthest, float(np.mean([np.count_nonzero(each > 1e-3) for each in moves])))


def _held(frame: Frame, count: int) -> Frame:
    garments = tuple(replace(each, points=each.points + count * DRIFT) for each in frame.garments)
    return replace(frame, time=None if frame.time is None else frame.time + count, garments=garments)


@pytest.mark.parametrize("name", ["hood", pytest.param("armpit", marks=pytest.mark.slow)])
def test_it_rests(name: str, tmp_path: Path):
    moves = held(name, tmp_path, level=1)
    assert moves.vertices > 1000
    assert moves.farthest < UNSEEN, moves


@pytest.mark.slow
@pytest.mark.parametrize("level", [1, 2])
def test_in_layers_it_rests(level: int, tmp_path: Path):
    """In sharp folds what passed through itself was mended, and did so again, for ever."""
    assert held("layers", tmp_path, level=level).farthest < UNSEEN


@pytest.mark.slow
def test_between_overlapping_parts_it_rests(tmp_path: Path):
    """A T-shirt whose arm has come down onto a torso that it overlaps; what crosses starts anew in the first frames."""
    moves = held("tshirt", tmp_path, level=2, frames=18)
    assert moves.many == 0, moves
    assert moves.farthest < UNSEEN, moves
