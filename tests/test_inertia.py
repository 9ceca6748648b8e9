"""Inertia: cloth feels the acceleration of its cage beyond gravity, and in slow shots none."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cloth import frame_of, group_of, refiner_of, sheet
from meshes import quads_of
from pxr import Usd, UsdGeom
from sheets import garment_of
from stages import add_mesh, author, new_stage, save, vec3

from physgraph_usd.errors import GarmentError
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.solver.forces.guide import Guide
from physgraph_usd.solver.inertia import CUT, FASTEST, GRAVITY, acceleration_of, felt
from physgraph_usd.solver.scene import Frame
from physgraph_usd.usd.read.motion import FRAMES, CageMotion
from physgraph_usd.usd.read.reader import open_shot

PACE: dict[str, Any] = {"edges": np.zeros((0, 2), np.int64), "frame": 1.0, "seconds": 1.0 / 24.0}


def along_x(*sizes: float) -> np.ndarray:
    return np.array(sizes)[:, None] * np.array([[1.0, 0.0, 0.0]])


def test_a_push_on_the_guide_pushes_every_fine_vertex_by_its_area() -> None:
    group = group_of(*sheet(5, 4))
    level, guide_map = group.levels[-1], group.guide_maps[-1]
    count = level.from_coarse.shape[1]
    guide = Guide(level, guide_map, torch.linspace(500.0, 4000.0, count, dtype=torch.float64))
    random = np.random.default_rng(0)
    cage, push = (torch.as_tensor(random.normal(size=(count, 3))) for _ in range(2))
    x, forces = level.base.apply(cage), list[torch.Tensor]()
    for given in (None, push):
        forces.append(torch.zeros_like(x))
        guide.retarget(cage, given).add_force(x, forces[-1])
    torch.testing.assert_close(forces[1] - forces[0], level.vertex_area[:, None] * level.base.apply(push))


@pytest.mark.parametrize("times", [(0.0, 0.1, 0.2), (0.0, 0.03, 0.2)])
def test_a_uniform_acceleration_is_found_at_any_spacing(times: tuple[float, float, float]) -> None:
    a, v = np.array([[3.0, -20.0, 0.5]]), np.array([[1.0, 2.0, -3.0]])
    np.testing.assert_allclose(acceleration_of([v * t + 0.5 * a * t * t for t in times], times), a)


def test_gravity_outweighs_slow_motion_and_a_cut_is_none() -> None:
    assert felt(along_x(0.0, 0.99 * GRAVITY)) is None
    found = felt(along_x(0.5 * GRAVITY, 3.0 * GRAVITY, 100.0 * GRAVITY))
    assert found is not None
    np.testing.assert_allclose(found, along_x(0.0, 2.0 * GRAVITY, FASTEST))
    assert felt(along_x(1.1 * CUT, 1.2 * CUT, 0.0)) is None
    assert felt(along_x(np.nan, 3.0 * GRAVITY)) is None


def test_little_more_than_gravity_is_felt_a_little() -> None:
    """No step at the threshold, which cloth would show as a jump."""
    found = felt(along_x(GRAVITY + 1e-3, 2.0 * GRAVITY))
    assert found is not None
    np.testing.assert_allclose(found[0], [1e-3, 0.0, 0.0], atol=1e-9)


def motion_of(path: np.ndarray, times: np.ndarray | None = None) -> CageMotion:
    """The motion of a cage of one point by its path along x [m]."""
    times = np.arange(len(path), dtype=float) if times is None else times
    return CageMotion(times.tolist(), lambda time: np.array([[np.interp(time, times, path), 0.0, 0.0]]), **PACE)


def at(motion: CageMotion, path: np.ndarray, time: int) -> np.ndarray | None:
    return motion.felt(float(time), np.array([[path[time], 0.0, 0.0]]))


def test_every_frame_has_the_acceleration_of_its_motion_in_any_order() -> None:
    path = 0.5 * 40.0 * (np.arange(9) * PACE["seconds"]) ** 2
    for order in (range(9), reversed(range(9))):
        motion = motion_of(path)
        for time in order:
            found = at(motion, path, time)
            assert found is not None
            np.testing.assert_allclose(found, [[40.0 - GRAVITY, 0.0, 0.0]], rtol=1e-6)


def test_what_alternates_from_frame_to_frame_is_not_felt() -> None:
    path = 0.05 * (-1.0) ** np.arange(9)
    motion = motion_of(path)
    assert all(at(motion, path, time) is None for time in range(9))


def test_a_broken_sample_is_not_felt_beside_it() -> None:
    """By one difference alone it would be felt as 29 m/s^2 there, and as 14 m/s^2 two frames away."""
    path = np.zeros(13)
    path[6] = 0.1
    motion = motion_of(path)
    assert all(at(motion, path, time) is None for time in range(13))


def test_a_cage_that_has_stopped_is_not_felt() -> None:
    """It is slowed by 30 m/s^2 until frame 6, and stands from there on."""
    path = -15.0 * (np.maximum(6.0 - np.arange(13.0), 0.0) * PACE["seconds"]) ** 2
    motion = motion_of(path)
    times = [time for time in range(13) if at(motion, path, time) is not None]
    assert times[:4] == [0, 1, 2, 3]
    assert times[-1] <= 6


def test_single_vertices_that_shake_are_not_felt() -> None:
    """A cage of 21 x 21 vertices, one of which shakes with a period of four frames, at 35 m/s^2."""
    mesh, flat = sheet(20, 20)
    shaken = [flat + 0.06 * np.sin(0.5 * np.pi * time) * (np.arange(len(flat)) == 220)[:, None] for time in range(13)]
    given: dict[str, Any] = PACE | {"edges": mesh.half_edges.edges}
    motion = CageMotion([*map(float, range(13))], lambda time: shaken[int(time)], **given)
    assert all(motion.felt(float(time), points) is None for time, points in enumerate(shaken))


def test_samples_of_motion_blur_do_not_amplify_noise() -> None:
    times = np.sort(np.concatenate([np.arange(9.0), np.arange(9.0) + 0.1]))
    path = 1e-3 * np.random.default_rng(0).normal(size=len(times))
    motion = motion_of(path, times)
    assert all(motion.felt(time, np.array([[x, 0.0, 0.0]])) is None for time, x in zip(times, path, strict=True))


def test_short_shots_and_broken_neighbours_have_none() -> None:
    path = 100.0 * np.arange(2 * FRAMES) ** 2
    assert at(motion_of(path), path, 1) is None

    def broken(time: float) -> np.ndarray:
        raise GarmentError("/cloth", "points are NaN", time=time)

    assert CageMotion([*map(float, range(9))], broken, **PACE).felt(4.0, np.zeros((1, 3))) is None


@pytest.mark.parametrize("farthest", [np.nan, np.inf, 1e300])
def test_a_position_out_of_bounds_is_not_felt_beside_it(farthest: float) -> None:
    """Warnings are errors in tests: numbers of that size overflow when they are squared."""
    path = np.zeros(13)
    path[6] = farthest
    motion = motion_of(path)
    assert all(at(motion, path, time) is None for time in range(13) if time != 6)


@pytest.mark.parametrize("far", [1e37, -1e289])
def test_time_codes_too_far_from_0_to_differ_have_no_acceleration(far: float) -> None:
    times = np.array(sorted([far, 1.0, 3.0, 5.0]))
    motion = motion_of(np.arange(4.0), times)
    for number, time in enumerate(times):
        assert motion.felt(time, np.array([[float(number), 0.0, 0.0]])) is None


def test_cloth_is_drawn_against_the_acceleration_by_its_density_over_the_guide() -> None:
    mesh, rest = sheet(6, 5)
    still = frame_of(rest)
    pushed = replace(still.garments[0], acceleration=np.broadcast_to([0.0, 0.0, 20.0], rest.shape))
    answers = [
        refiner_of([garment_of(mesh, rest)], steps=200).solve(each).points[0]
        for each in (still, Frame(None, (pushed,)))
    ]
    shift = (answers[1] - answers[0]).mean(axis=0)
    expected = -20.0 * pushed.fabric.density / pushed.guide
    np.testing.assert_allclose(shift, [0.0, 0.0, expected], atol=0.05 * abs(expected))


def test_a_frame_like_the_last_but_for_its_acceleration_is_solved_again() -> None:
    mesh, rest = sheet(6, 5)
    still = frame_of(rest, 1.0)
    push = replace(still.garments[0], acceleration=np.broadcast_to([0.0, 0.0, 20.0], rest.shape))
    refiner = refiner_of([garment_of(mesh, rest)], times=(1.0, 2.0, 3.0))
    reused = [refiner.solve(each).reused for each in (still, Frame(2.0, (push,)), Frame(3.0, (push,)))]
    assert reused == [(False,), (False,), (True,)]


def spinning(path: Path, turns: float, **authored: float) -> str:
    """A ring of cloth about y with a radius of 0.3 m that turns so many times a second for a third of a second."""
    stage = new_stage(path)
    columns, rows = 24, 4
    angle, height = np.meshgrid(2.0 * np.pi * np.arange(columns) / columns, 0.1 * np.arange(rows))

    def placed(turn: float) -> np.ndarray:
        at = angle.ravel() + turn
        return np.stack([0.3 * np.sin(at), height.ravel(), 0.3 * np.cos(at)], axis=1)

    mesh = add_mesh(stage, "/World/ring", placed(0.0), quads_of(columns, rows, closed=True))
    for time in range(1, 9):
        mesh.GetPointsAttr().Set(vec3(placed(2.0 * np.pi * turns * time / 24.0)), time)
    for name, value in authored.items():
        author(mesh.GetPrim(), f"physgraph:{name}", value)
    return save(stage)


def ring_of(layer: Path, time: float) -> np.ndarray:
    stage = Usd.Stage.Open(str(layer))
    return np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/World/ring")).GetPointsAttr().Get(time))


def radius(layer: Path, time: float) -> float:
    points = ring_of(layer, time)
    return float(np.linalg.norm(points[:, [0, 2]], axis=1).mean())


def test_a_fast_spin_draws_cloth_outwards_and_the_report_says_so(tmp_path: Path) -> None:
    """Two turns a second at 0.3 m are 4.8 times gravity, 4.2 over chords and neighbours."""
    found = {}
    for name, overrides, inertia in (("on", (), 1.0), ("half", ("inertia=0.5",), 1.0), ("off", (), 0.0)):
        shot = spinning(tmp_path / f"{name}.usda", 2.0, inertia=inertia)
        given = RefineOptions(level=1, overrides=overrides)
        found[name] = refine_shot(shot, tmp_path / f"{name}.usdc", given), radius(tmp_path / f"{name}.usdc", 5.0)
    free = 3.2 * GRAVITY * 0.187 / 2000.0  # The ring's own tension holds it back.
    assert 0.2 * free < found["on"][1] - found["off"][1] < free
    assert found["off"][1] < found["half"][1] < found["on"][1]
    notes = [note for note in found["on"][0].notes if note.startswith("inertia")]
    assert len(notes) == 1
    assert "3.2 times gravity" in notes[0]
    assert not [note for note in found["off"][0].notes if note.startswith("inertia")]


def test_a_slow_shot_is_solved_as_if_nothing_moved(tmp_path: Path) -> None:
    """Half a turn a second at 0.3 m is 0.3 times gravity."""
    shot = spinning(tmp_path / "slow.usda", 0.5)
    layers = [tmp_path / f"{share}.usdc" for share in (0, 1)]
    for share, layer in enumerate(layers):
        refine_shot(shot, layer, RefineOptions(level=1, overrides=(f"inertia={share}",)))
    for time in range(1, 9):
        one, other = (ring_of(layer, time) for layer in layers)
        np.testing.assert_array_equal(one, other)


def test_a_range_of_frames_feels_the_motion_around_it(tmp_path: Path) -> None:
    shot = spinning(tmp_path / "s.usda", 2.0)
    whole = open_shot(shot).frame(5.0).garments[0].acceleration
    part = open_shot(shot, frames=(5.0, 5.0)).frame(5.0).garments[0].acceleration
    assert whole is not None
    assert part is not None
    np.testing.assert_array_equal(whole, part)
