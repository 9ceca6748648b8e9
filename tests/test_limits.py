"""Max distance and backstop: cloth stays within them in every frame, in contact too, and others change no bit."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bodies import ball
from cloth import DOWN, FABRIC, GUIDE, settings_of, wave
from folds import EDGE, named, sewn, square
from meshes import grid
from sheets import garment_of
from stages import add_sheet, author, new_stage, save

from physgraph_usd.errors import SchemaError
from physgraph_usd.solver.colliders.pose import Collider, Pose
from physgraph_usd.solver.forces.limit import Limit
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.level import Level, build_levels, refine_garments
from physgraph_usd.solver.scene import Frame, Garment, GarmentFrame, Limits, Scene
from physgraph_usd.solver.seen import vertex_normals
from physgraph_usd.usd.read.reader import open_shot

HELD = 1e-4
"""Largest excess over a limit [m]."""


def limits(
    count: int, distance: float | None, backstop: float | None = None, *, scale: np.ndarray | None = None
) -> Limits:
    scale = np.ones(count) if scale is None else scale
    return Limits(distance, backstop, scale, scale)


def solve(
    garments: Sequence[Garment], frames: Sequence[Frame], colliders: Sequence[Collider] = (), *, level: int = 2
) -> tuple[list[list[np.ndarray]], list[dict[str, Any]]]:
    """Positions of the garments in each frame, and the first garment's telemetry."""
    scene = Scene(tuple(garments), DOWN, tuple(float(frame.time or 0.0) for frame in frames), tuple(colliders))
    refiner = Refiner(scene, settings_of(integrator="physgraph"), levels=[level] * len(garments))
    results = [refiner.solve(frame).garments for frame in frames]
    points = [[garment.points for garment in garments if garment.points is not None] for garments in results]
    return points, [garments[0].telemetry for garments in results]


def level_of(garment: Garment, level: int = 2) -> Level:
    return build_levels([garment], refine_garments([garment], [level]))[-1]


def away(garment: Garment, cage: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance from the subdivided cage, and distance inwards [m], at free vertices; 0 at others."""
    level = level_of(garment, 2)
    smooth = level.smooth_from_coarse @ cage
    free = level.free[:, 0].numpy()
    normals = vertex_normals(smooth, level.triangles.numpy()) * (-1.0 if garment.flipped else 1.0)
    far = np.linalg.norm(points - smooth, axis=1)
    return np.where(free, far, 0.0), np.where(free, -((points - smooth) * normals).sum(axis=1), 0.0)


def waved(rest: np.ndarray, count: int = 4) -> list[np.ndarray]:
    return [wave(rest, squeeze=0.08 + 0.01 * time, phase=0.3 * time) for time in range(count)]


@pytest.fixture
def sheet() -> tuple[Garment, list[np.ndarray]]:
    mesh, points = grid(8, 8, "triangles")
    garment = garment_of(mesh, EDGE * points)
    return garment, waved(garment.rest)


def moving(garment: Garment, cages: Sequence[np.ndarray], *each: Limits | None) -> list[list[np.ndarray]]:
    """Positions in each frame of a sheet with limits, one for all frames or one for each."""
    held = each if len(each) == len(cages) else each * len(cages)
    frames = [
        Frame(float(time), (GarmentFrame(cage, FABRIC, GUIDE, limits=limit),))
        for time, (cage, limit) in enumerate(zip(cages, held, strict=True))
    ]
    return solve([garment], frames)[0]


@pytest.mark.parametrize("distance", [0.01, 0.003, 0.0005, 0.0])
def test_max_distance_holds_in_each_frame(sheet: tuple[Garment, list[np.ndarray]], distance: float) -> None:
    garment, cages = sheet
    free = moving(garment, cages, None)
    held = moving(garment, cages, limits(len(garment.rest), distance))
    for cage, (before,), (after,) in zip(cages, free, held, strict=True):
        assert away(garment, cage, before)[0].max() > 0.012
        far = away(garment, cage, after)[0]
        assert far.max() <= distance + HELD
        assert far.max() >= 0.5 * distance


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("backstop", [0.002, 0.0])
def test_a_backstop_limits_one_side(sheet: tuple[Garment, list[np.ndarray]], backstop: float, *, flipped: bool) -> None:
    garment, cages = sheet
    garment = replace(garment, flipped=flipped)
    for cage, (points,) in zip(cages, moving(garment, cages, limits(len(garment.rest), None, backstop)), strict=True):
        far, deep = away(garment, cage, points)
        assert deep.max() <= backstop + HELD
        assert far.max() > 0.008


def test_both_limits_hold_together(sheet: tuple[Garment, list[np.ndarray]]) -> None:
    garment, cages = sheet
    for cage, (points,) in zip(cages, moving(garment, cages, limits(len(garment.rest), 0.006, 0.001)), strict=True):
        far, deep = away(garment, cage, points)
        assert far.max() <= 0.006 + HELD
        assert deep.max() <= 0.001 + HELD


def test_cloth_painted_0_stays_on_the_subdivided_cage(sheet: tuple[Garment, list[np.ndarray]]) -> None:
    garment, cages = sheet
    scale = (garment.rest[:, 0] > np.median(garment.rest[:, 0])).astype(float)
    level = level_of(garment)
    painted = np.asarray(level.from_coarse @ scale)
    for cage, (points,) in zip(cages, moving(garment, cages, limits(len(scale), 0.008, scale=scale)), strict=True):
        far = away(garment, cage, points)[0]
        assert far[painted == 0.0].max() <= 1e-5
        assert (far <= 0.008 * painted + HELD).all()
        assert far.max() > 0.003


def test_an_animated_limit_holds(sheet: tuple[Garment, list[np.ndarray]]) -> None:
    garment, cages = sheet
    distances = (0.02, 0.001, 0.0, 0.01)
    held = moving(garment, cages, *(limits(len(garment.rest), distance) for distance in distances))
    for cage, (points,), distance in zip(cages, held, distances, strict=True):
        assert away(garment, cage, points)[0].max() <= distance + HELD


def test_limits_out_of_reach_are_no_limits_of_another_kind(sheet: tuple[Garment, list[np.ndarray]]) -> None:
    """A wide limit changes nothing that is seen, and no limit changes no bit."""
    garment, cages = sheet
    free, again = moving(garment, cages, None), moving(garment, cages, None)
    wide = moving(garment, cages, limits(len(garment.rest), 1.0, 1.0))
    for (a,), (b,), (c,) in zip(free, again, wide, strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.abs(a - c).max() < 1e-5


def ball_frames(garment: Garment, limit: Limits | None) -> list[Frame]:
    """A level sheet whose middle a ball pushes up; it never reaches the sheet's cage."""
    points, faces = ball(0.1)
    frames = []
    for time in range(4):
        cage = wave_level(garment.rest, time)
        body = Pose(points + np.array([0.0, -0.113 + 0.002 * time, 0.0]), faces)
        frames.append(Frame(float(time), (GarmentFrame(cage, FABRIC, 200.0, limits=limit),), (body,)))
    return frames


def wave_level(rest: np.ndarray, time: int) -> np.ndarray:
    """A level sheet squeezed along x and waved."""
    return np.stack([0.93 * rest[:, 0], 0.004 * np.sin(20.0 * rest[:, 0] + 0.3 * time), rest[:, 2]], axis=1)


def crossings_of(telemetry: dict[str, Any]) -> int:
    contact = telemetry.get("contact", {})
    bodies = sum(body["after"]["crossings"] for body in contact.get("bodies", {}).values())
    return bodies + contact.get("cloth", {}).get("after", {}).get("crossings", 0)


@pytest.mark.parametrize("limit", [(0.003, None), (None, 0.001), (0.0, None)])
def test_limits_hold_beside_a_body(limit: tuple[float | None, float | None]) -> None:
    garment = replace(named(square(8)), colliders=(0,), flipped=True)
    frames = ball_frames(garment, limits(len(garment.rest), *limit))
    points, telemetry = solve([garment], frames, [Collider("/World/Ball", "mesh")])
    for frame, (x,), entry in zip(frames, points, telemetry, strict=True):
        assert "contact" in entry
        assert crossings_of(entry) == 0
        far, deep = away(garment, frame.garments[0].points, x)
        assert limit[0] is None or far.max() <= limit[0] + HELD
        assert limit[1] is None or deep.max() <= limit[1] + HELD


def test_contact_has_precedence_where_the_subdivided_cage_is_in_a_body() -> None:
    garment = replace(named(square(8)), colliders=(0,))
    points, faces = ball(0.1)
    cage = wave_level(garment.rest, 0)
    pose = Pose(points + np.array([0.0, -0.085, 0.0]), faces)
    limit = limits(len(garment.rest), 0.002)
    frame = Frame(0.0, (GarmentFrame(cage, FABRIC, GUIDE, limits=limit),), (pose,))
    (fine,), (telemetry,) = solve([garment], [frame], [Collider("/World/Ball", "mesh")])
    body = next(iter(telemetry["contact"]["bodies"].values()))
    assert body["before"]["inside"] > 0
    assert body["after"]["inside"] == 0
    assert body["after"]["crossings"] == 0
    smooth = level_of(garment).smooth_from_coarse @ cage
    around = np.linalg.norm(smooth - [0.0, -0.085, 0.0], axis=1) > 0.14
    assert away(garment, cage, fine[0])[0][around].max() <= 0.002 + HELD


def test_limits_hold_in_layers() -> None:
    below, above = named(square(8), "Below"), named(square(8), "Above")
    frames = []
    for time in range(4):
        cages = [
            wave_level(garment.rest, time) + np.array([0.0, 0.004 * k, 0.0]) for k, garment in enumerate((below, above))
        ]
        held = (limits(len(below.rest), 0.003), None)
        each = [GarmentFrame(cage, FABRIC, GUIDE, limits=limit) for cage, limit in zip(cages, held, strict=True)]
        frames.append(Frame(float(time), tuple(each)))
    points, telemetry = solve([below, above], frames)
    for frame, (x, y), entry in zip(frames, points, telemetry, strict=True):
        assert entry["together"] == [below.path, above.path]
        assert crossings_of(entry) == 0
        assert away(below, frame.garments[0].points, x)[0].max() <= 0.003 + HELD
        assert away(above, frame.garments[1].points, y)[0].max() > 0.003


def test_seams_stay_closed_under_the_least_limit_of_their_sides() -> None:
    """Subdivision rounds the corners at the ends of the seam apart: there the distance is from where they meet."""
    left, right = named(square(6), "Left"), named(square(6), "Right")
    size = np.ptp(left.rest[:, 0])
    right = replace(right, rest=right.rest + np.array([size, 0.0, 0.0]))
    left, right = sewn([left, right], left.rest, right.rest)
    held = (limits(len(left.rest), 0.001), limits(len(right.rest), 0.01))
    frames = [
        Frame(
            float(time),
            tuple(
                GarmentFrame(wave_level(garment.rest, time), FABRIC, GUIDE, limits=limit)
                for garment, limit in zip((left, right), held, strict=True)
            ),
        )
        for time in range(3)
    ]
    for frame, (x, y) in zip(frames, solve([left, right], frames)[0], strict=True):
        far = [away(g, f.points, p)[0] for g, f, p in zip((left, right), frame.garments, (x, y), strict=True)]
        inner = [np.abs(level_of(garment).rest[:, 2].numpy()) < 0.1 for garment in (left, right)]
        assert far[0][inner[0]].max() <= 0.001 + HELD
        assert far[1][inner[1]].max() <= 0.01 + HELD
        border = x[np.isclose(level_of(left).rest[:, 0].numpy(), level_of(left).rest[:, 0].numpy().max())]
        assert max(np.linalg.norm(y - point, axis=1).min() for point in border) < 1e-6


def test_faces_without_area_break_nothing() -> None:
    mesh, points = grid(6, 6, "triangles")
    rest = EDGE * points
    rest[8] = rest[9]  # Faces with two corners at one place.
    garment = garment_of(mesh, rest)
    cages = waved(rest)
    for cage, (x,) in zip(cages, moving(garment, cages, limits(len(rest), 0.003, 0.001)), strict=True):
        assert np.isfinite(x).all()
        level = level_of(garment)
        far = away(garment, cage, x)[0][(level.vertex_area > 0).numpy()]
        assert far.max() <= 0.003 + HELD


def test_force_is_minus_the_gradient_of_the_energy(sheet: tuple[Garment, list[np.ndarray]]) -> None:
    garment, _ = sheet
    level = build_levels([garment], refine_garments([garment], [1]), dtype=torch.float64)[-1]
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    count = level.vertex_count
    centre, normal = level.rest, torch.nn.functional.normalize(random(count, 3) - 0.5, dim=1)
    radius = 0.01 * random(count)
    radius[::5] = torch.inf
    term = Limit(level, 1.0 + random(count), centre=centre, normal=normal, radius=radius, backstop=0.01 * random(count))
    x = (centre + 0.02 * (random(count, 3) - 0.5)).requires_grad_()
    force = torch.zeros_like(x)
    energy = term.add_force(x.detach(), force)
    assert float(term.split(x.detach())[0].sum()) == pytest.approx(float(energy))
    gradient = torch.zeros_like(x)
    step = 1e-7
    for vertex in range(0, count, 7):
        for axis in range(3):
            ends = []
            for sign in (step, -step):
                moved = x.detach().clone()
                moved[vertex, axis] += sign
                ends.append(float(term.add_force(moved, torch.zeros_like(moved))))
            gradient[vertex, axis] = (ends[0] - ends[1]) / (2.0 * step)
            assert float(force[vertex, axis]) == pytest.approx(-float(gradient[vertex, axis]), rel=1e-4, abs=1e-9)


def shot_with(folder: Path, **values: float | dict[float, float]) -> str:
    stage = new_stage(folder / "s.usda")
    mesh = add_sheet(stage)
    for name, value in values.items():
        for time, each in value.items() if isinstance(value, dict) else [(None, value)]:
            author(mesh.GetPrim(), f"physgraph:{name}", each, time=time)
    return save(stage)


def test_attributes_are_read(tmp_path: Path) -> None:
    shot = open_shot(shot_with(tmp_path, maxDistance={1.0: 0.1, 2.0: 0.2, 3.0: 0.3}), overrides=["backstopScale=0.5"])
    frames = [shot.frame(time).garments[0].limits for time in (1.0, 3.0)]
    assert [frame.max_distance for frame in frames if frame is not None] == pytest.approx([0.1, 0.3])
    assert all(frame is not None and frame.backstop is None for frame in frames)
    assert frames[0] is not None
    np.testing.assert_array_equal(frames[0].backstop_scale, 0.5)
    assert not Limits.are_equal(frames[0], frames[1])


def test_without_a_value_there_are_no_limits(tmp_path: Path) -> None:
    shot = open_shot(shot_with(tmp_path), overrides=["maxDistanceScale=0"])
    assert shot.frame(1.0).garments[0].limits is None


@pytest.mark.parametrize("bad", [-0.01, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["maxDistance", "backstop"])
def test_bad_values_are_named_with_prim_time_and_remedy(tmp_path: Path, name: str, bad: float) -> None:
    shot = open_shot(shot_with(tmp_path, **{name: {1.0: 0.1, 2.0: bad}}))
    assert shot.frame(1.0).garments[0].limits is not None
    with pytest.raises(
        SchemaError,
        match=rf"<[\w/]+>\.physgraph:{name} at time code 2: .*must be finite and in \[0, 1000\] m, or left out",
    ):
        shot.frame(2.0)
