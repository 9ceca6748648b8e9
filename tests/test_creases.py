"""Crease memory: folds that were there stay a little, fade, and are a value that passes from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from cloth import FABRIC, frame_of, group_of, settings_of, sheet, wave
from folds import curved, placed, strip
from hypothesis import given
from hypothesis import strategies as st
from sheets import garment_of
from stages import GARMENT_API, add_sheet, author, new_stage, save

from benchmarks.crease import HELD, MOVES, STRAIGHT, Worn, worn
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.forces.bending import Bending
from physgraph_usd.solver.frame.creases import SHARE, creases_of
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.solve import solve_frame
from physgraph_usd.solver.frame.values import FrameInput, FrameState
from physgraph_usd.solver.level import Level, build_levels, hinge_geometry
from physgraph_usd.solver.scene import Frame, GarmentFrame, Scene
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.schema import fabric_values

MESH, REST = sheet(6, 5)
CREASED = replace(FABRIC, crease_time=0.5)


def bent_strip(turn: float) -> tuple[Level, torch.Tensor]:
    """A strip, flat at rest, and where it is bent by an angle from end to end [m]."""
    mesh, points = strip()
    level = build_levels([garment_of(mesh, points)], [()], dtype=torch.float64)[0]
    return level, placed(level, lambda rest: curved(rest, turn))


def left_at(x: torch.Tensor, *bent: torch.Tensor | None) -> FrameState:
    """What a frame left whose cloth was somewhere [m], of which its creases matter alone."""
    return FrameState(x, x, torch.eye(3).expand(len(x), 3, 3), fine=x, bent=bent)


def asked(elapsed: float, *times: float) -> FrameInput:
    """A frame of garments with crease times, so long after the last one [s]."""
    frames = [GarmentFrame(REST, replace(FABRIC, crease_time=time)) for time in times]
    return FrameInput(frames, elapsed=[elapsed] * len(times))


def angles(level: Level, x: torch.Tensor) -> torch.Tensor:
    """The angles of a level's hinges [rad], without a kernel."""
    return torch.as_tensor(hinge_geometry(x.numpy(), level.hinges.numpy())[0])


@given(st.floats(0.01, 10.0), st.floats(0.0, 20.0), st.floats(0.1, 3.0))
def test_a_memory_follows_its_angle_at_its_own_pace(time: float, elapsed: float, turn: float):
    level, x = bent_strip(turn)
    found = creases_of(level, asked(elapsed, time), left_at(x))
    assert found is not None
    assert torch.allclose(found.bent, -np.expm1(-elapsed / time) * angles(level, x), atol=1e-9)
    assert torch.allclose(found.rest_angle, SHARE * found.bent, atol=1e-12)


def test_forces_at_other_angles_are_minus_the_gradient_and_leave_the_first_as_they_are():
    level, x = bent_strip(1.0)
    plain = Bending(level, torch.tensor([1e-3]))
    rests = plain.resting_at(0.5 * angles(level, x))
    before = float(plain.add_force(x, torch.zeros_like(x)))
    force, energy = torch.zeros_like(x), float(rests.add_force(x, torch.zeros_like(x)))
    rests.add_force(x, force)
    assert energy == pytest.approx(0.25 * before)
    assert float(plain.add_force(x, torch.zeros_like(x))) == before
    assert float(plain.resting_at(angles(level, x)).add_force(x, torch.zeros_like(x))) < 1e-9 * before
    push = torch.as_tensor(np.random.default_rng(0).normal(size=x.shape))
    ends = [float(rests.add_force(x + sign * 1e-6 * push, torch.zeros_like(x))) for sign in (-1.0, 1.0)]
    assert -float((force * push).sum()) == pytest.approx((ends[1] - ends[0]) / 2e-6, rel=1e-5)


def waving(fabric: Fabric, count: int = 6, *, temporal: str = "tether") -> tuple[Refiner, list[Frame]]:
    """A refiner of a sheet, and frames in which it waves."""
    scene = Scene((garment_of(MESH, REST),), np.array([0.0, -9.81, 0.0]), tuple(map(float, range(count))))
    refiner = Refiner(scene, settings_of(temporal=temporal), levels=[1], dtype=torch.float64)
    return refiner, [frame_of(wave(REST, phase=0.2 * k), float(k), fabric=fabric) for k in range(count)]


def points_of(refiner: Refiner, frames: Sequence[Frame]) -> list[bytes]:
    """The result of frames in order, to the bit."""
    return [np.asarray(state.points[0]).tobytes() for state in refiner.refine(frames)]


def test_creases_change_what_follows_the_second_frame_alone():
    plain, creased = (points_of(*waving(fabric)) for fabric in (FABRIC, CREASED))
    assert plain[0] == creased[0]
    assert all(a != b for a, b in zip(plain[1:], creased[1:], strict=True))
    assert plain == points_of(*waving(FABRIC))


def test_frames_that_are_solved_by_themselves_have_none():
    assert points_of(*waving(FABRIC, temporal="off")) == points_of(*waving(CREASED, temporal="off"))


def test_a_frame_asked_twice_is_the_same():
    refiner, frames = waving(CREASED)
    first = points_of(refiner, frames)
    assert points_of(refiner, frames[-1:]) == first[-1:]
    refiner.forget()
    assert points_of(refiner, frames) == first
    group = group_of(MESH, REST, level=1)
    inputs = [FrameInput(each.garments, each.time, elapsed=[1 / 24]) for each in frames]
    state = solve_frame(group, inputs[0], None).state
    once, other, again = (solve_frame(group, inputs[k], state).points[0] for k in (1, 2, 1))
    assert once.tobytes() == again.tobytes() != other.tobytes()


def test_a_jump_forgets():
    group = group_of(MESH, REST, level=1)
    first, second, _ = (FrameInput(each.garments, elapsed=[0.1]) for each in waving(CREASED, 3)[1])
    state = solve_frame(group, second, solve_frame(group, first, None).state).state
    assert len(state.bent) == 1
    away = FrameInput([replace(first.garments[0], points=first.garments[0].points + 100.0)], elapsed=[0.1])
    jumped = solve_frame(group, away, state)
    assert jumped.telemetry["start"].startswith("cold")
    assert jumped.state.bent == ()


def test_creases_go_on_from_before_a_broken_frame_by_the_time_since_then():
    """The frame after it is that of a shot without it."""
    refiner, frames = waving(CREASED)
    whole = points_of(refiner, [*frames[:3], frames[4]])
    broken = replace(frames[3], garments=(replace(frames[3].garments[0], points=frames[3].garments[0].points + 100.0),))
    refiner.forget()
    *_, last = refiner.refine([*frames[:3], broken, frames[4]])
    assert last.telemetry[0]["broken_before"] == 3.0
    assert np.asarray(last.points[0]).tobytes() == whole[-1]


def test_a_pose_that_is_held_comes_to_rest_when_creases_have_set():
    """After four crease times of half a second, at 24 frames a second; before that something moves in each."""
    refiner, [frame, *_] = waving(CREASED)
    points = [np.asarray(refiner.solve(replace(frame, time=float(k))).points[0]) for k in range(60)]
    moves = [np.abs(b - a).max() for a, b in pairwise(points)]
    assert min(moves[:47]) > 1e-7
    assert max(moves[48:]) < 1e-12
    assert refiner.solve(replace(frame, time=60.0)).reused == (True,)


def test_the_attribute_is_read_reported_and_in_the_worn_preset(tmp_path: Path):
    stage = new_stage(tmp_path / "shot.usda")
    prim = add_sheet(stage).GetPrim()
    prim.AddAppliedSchema(GARMENT_API)
    plain = inspect_shot(save(stage))
    assert "crease memory" not in plain["modelled"]
    author(prim, "physgraph:rest:creaseTime", 1.5)
    shot = save(stage)
    assert open_shot(shot).frame(1.0).garments[0].fabric.crease_time == 1.5
    words = inspect_shot(shot)["modelled"]["crease memory"]
    assert words == f"folds set and fade in 1.5 s for {prim.GetPath()}"
    assert "crease memory" not in inspect_shot(shot, temporal="off")["modelled"]
    assert fabric_values(PRESETS["worn-denim"])["rest:creaseTime"] == 1.5
    assert "rest:creaseTime" not in fabric_values(PRESETS["denim"])


@cache
def elbow(time: float) -> Worn:
    """The elbow of the benchmark in cotton at one subdivision."""
    return worn(replace(PRESETS["cotton"], crease_time=time), level=1)


@pytest.mark.slow
def test_an_elbow_that_is_straight_again_shows_where_it_was_bent():
    """A quarter more one second later, less as it is held, and no jumps or energy that are not there without."""
    plain, creased = elbow(0.0), elbow(2.0)
    later, late = STRAIGHT + 24, STRAIGHT + 72
    assert creased.folds[later] > 1.25 * plain.folds[later]
    assert creased.folds[late] < 0.9 * creased.folds[STRAIGHT]
    held = creased.folds[STRAIGHT : late + 1]
    assert np.diff(held).max() < 0.01 * held[0]
    assert np.sqrt((creased.jumps**2).mean()) < 1.1 * np.sqrt((plain.jumps**2).mean())
    assert creased.jumps[STRAIGHT + 1 :].max() < 0.05e-3
    assert creased.joules.max() < 1.1 * plain.joules.max()
    assert creased.joules[:STRAIGHT].mean() < 1.05 * plain.joules[:STRAIGHT].mean()
    assert creased.joules[MOVES + HELD] < plain.joules[MOVES + HELD]
