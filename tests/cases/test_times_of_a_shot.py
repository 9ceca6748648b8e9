"""Time codes at which cloth is solved: between sparse keys, at the samples of bodies, about jumps, rounded."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from layers import errors, open_over
from pxr import Gf, Usd, UsdGeom
from shots import CLOTH, EDGE, fine, refine, sample_times
from stages import (
    COLLIDER_API,
    add_sheet,
    add_skeleton,
    bind_skin,
    loop_shot,
    new_stage,
    said,
    save,
    sheet_points,
    skinned_points,
    vec3,
)

from physgraph_usd.errors import AbsentError
from physgraph_usd.shot.report import RefineReport
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.times import motion_of

SIZE = (6, 6)
RADIUS = 1.0
"""Radius of the ball that pushes into the middle of a sheet of unit squares."""


def flat(stage: Usd.Stage, path: str = CLOTH, *, times: Sequence[float] = ()) -> UsdGeom.Mesh:
    """A sheet without waves that stands still, at its samples too."""
    mesh = add_sheet(stage, path, times=(), size=SIZE)
    points = vec3(sheet_points(None, SIZE) * np.array([1.0, 1.0, 0.0]))
    for time in (None, *times):
        mesh.GetPointsAttr().Set(points, Usd.TimeCode.Default() if time is None else time)
    return mesh


def add_ball(stage: Usd.Stage, path: str, places: Mapping[float, Sequence[float]]) -> UsdGeom.Sphere:
    """A ball that pushes cloth, with its centre at some times."""
    ball = UsdGeom.Sphere.Define(stage, path)
    ball.CreateRadiusAttr(RADIUS)
    ball.GetPrim().AddAppliedSchema(COLLIDER_API)
    for time, place in places.items():
        UsdGeom.XformCommonAPI(ball).SetTranslate(Gf.Vec3d(*map(float, place)), time)
    return ball


def depth(shot: Path, layer: Path, time: float, centre: Sequence[float]) -> float:
    """Depth of a refined sheet inside a ball about a centre [EDGE] at a time code, in the composed stage [m]."""
    return EDGE * RADIUS - float(np.linalg.norm(fine(shot, layer, time) - EDGE * np.asarray(centre), axis=1).min())


def refined(stage: Usd.Stage, tmp_path: Path, **options: object) -> tuple[Path, Path, RefineReport]:
    """The saved shot, a sound layer and the report."""
    shot, out = Path(save(stage)), tmp_path / "fine.usdc"
    report = refine(shot, out, **options)
    assert report.exit_code == 0
    assert errors(out, shot) == []
    return shot, out, report


def turn(prim: Usd.Prim, kind: str, degrees: dict[float, float]) -> None:
    """Turn a prim about x by a rotation of Euler angles, or by a quaternion."""
    xform = UsdGeom.Xformable(prim)
    op = xform.AddRotateXOp() if kind == "rotate" else xform.AddOrientOp()
    for time, angle in degrees.items():
        half = np.deg2rad(angle) / 2.0
        quat = Gf.Quatf(float(np.cos(half)), float(np.sin(half)), 0.0, 0.0)
        op.Set(angle if kind == "rotate" else quat, time)


class TestBetweenSparseKeys:
    def test_skinned_cloth_moves_on_the_arcs_of_its_skeleton(self, tmp_path: Path):
        """Keys at 1 and 13 turn half of a sheet by 69 degrees: the chord is 17% of the radius off."""
        stage = new_stage(tmp_path / "s.usda", metres=EDGE)
        joints = [int(x > 2) for x in sheet_points(None, SIZE)[:, 0]]
        add_skeleton(stage, "/World/rig", (1.0, 13.0))
        mesh = add_sheet(stage, "/World/rig/cloth", times=(), size=SIZE)
        bind_skin(mesh, "/World/rig", joints=joints)
        shot, out, _ = refined(stage, tmp_path, frames=(6.0, 8.0), steps=3)
        assert sample_times(out, "/World/rig/cloth") == (6.0, 7.0, 8.0)
        cage = skinned_points(sheet_points(None, SIZE), joints, 7.0)
        away = fine(shot, out, 7.0, prim="/World/rig/cloth")[: len(cage)] - EDGE * cage
        end = sheet_points(None, SIZE)[:, 0] == SIZE[0]
        assert np.median(np.linalg.norm(away[end], axis=1)) < 0.2 * EDGE

    @pytest.mark.parametrize(("turned", "kind"), [("/World/rig", "rotate"), ("/World/arm", "orient")])
    def test_cloth_meets_bodies_where_an_ancestor_of_either_turns(self, tmp_path: Path, turned: str, kind: str):
        """The ball is in the cloth half-way along the arc, at neither key."""
        stage = new_stage(tmp_path / "s.usda", metres=EDGE)
        rig, arm = (UsdGeom.Xform.Define(stage, path).GetPrim() for path in ("/World/rig", "/World/arm"))
        flat(stage, "/World/rig/cloth", times=() if turned == "/World/rig" else (1.0, 5.0))
        turn(rig if turned == "/World/rig" else arm, kind, {1.0: -60.0, 5.0: 60.0})
        add_ball(stage, "/World/arm/ball", {1.0: (3.0, 3.0, 0.7)})
        shot, out, report = refined(stage, tmp_path, steps=3)
        assert [frame["time"] for frame in report.frames] == [1.0, 2.0, 3.0, 4.0, 5.0]
        points = fine(shot, out, 3.0, prim="/World/rig/cloth")
        assert np.linalg.norm(points - EDGE * np.array([3.0, 3.0, 0.7]), axis=1).min() > 0.99 * EDGE * RADIUS

    def test_nothing_is_added_where_nothing_turns_or_a_key_is_a_stray_one(self, stage: Usd.Stage):
        rig = UsdGeom.Xform.Define(stage, "/World/rig").GetPrim()
        turn(rig, "rotate", {-1e6: 10.0, 1.0: 30.0, 5.0: 30.0, 7.0: 40.0})
        add_sheet(stage, "/World/rig/cloth", times=(1.5, 5.0, 5.5, 6.5))
        assert open_shot(save(stage)).scene.times == (-1e6, 1.0, 1.5, 5.0, 5.5, 6.5, 7.0)

    def test_frames_of_a_stage_in_seconds_are_its_frames(self, tmp_path: Path):
        stage = new_stage(tmp_path / "s.usda", rate=1.0)
        stage.SetFramesPerSecond(25.0)
        turn(UsdGeom.Xform.Define(stage, "/World/rig").GetPrim(), "rotate", {1.0: 0.0, 1.2: 30.0})
        add_sheet(stage, "/World/rig/cloth", times=())
        np.testing.assert_allclose(open_shot(save(stage)).scene.times, 1.0 + np.arange(6) / 25.0, atol=1e-9)


class TestSamplesOfBodies:
    THROUGH = {1.0 + k: (3.0, 3.0, height) for k, height in enumerate((-4.0, -0.9, -0.6, -0.9, -4.0))}  # noqa: RUF012

    def test_between_those_of_the_cloth_are_solved(self, tmp_path: Path):
        stage = new_stage(tmp_path / "s.usda", metres=EDGE)
        flat(stage, times=(1.0, 5.0))
        add_ball(stage, "/World/ball", self.THROUGH)
        shot, out, report = refined(stage, tmp_path)
        assert sample_times(out) == (1.0, 2.0, 3.0, 4.0, 5.0)
        assert max(depth(shot, out, time, place) for time, place in self.THROUGH.items()) < 0.01 * EDGE
        assert not any("ball" in warning for warning in report.warnings)

    def test_are_those_of_cloth_that_stands_still(self, tmp_path: Path):
        stage = new_stage(tmp_path / "s.usda", metres=EDGE)
        flat(stage)
        flat(stage, "/World/far").AddTranslateOp().Set((50.0, 0.0, 0.0))
        add_ball(stage, "/World/ball", self.THROUGH | {2.5: (3.0, 3.0, -0.7)})
        shot, out, report = refined(stage, tmp_path)
        assert [frame["time"] for frame in report.frames] == [1.0, 2.0, 2.5, 3.0, 4.0, 5.0]
        assert max(depth(shot, out, time, place) for time, place in self.THROUGH.items()) < 0.01 * EDGE
        assert sample_times(out, "/World/far") == ()
        assert sample_times(refine_range(shot, tmp_path, (2.0, 3.0))) == (2.0, 2.5, 3.0)

    def test_of_bodies_apart_from_the_cloth_or_with_one_sample_do_not_count(self, stage: Usd.Stage):
        cloth = flat(stage).GetPrim()
        add_ball(stage, "/World/ball", self.THROUGH)
        add_ball(stage, "/World/still", {3.0: (3.0, 3.0, -4.0)})
        cloth.CreateRelationship("physgraph:contact:exclude").SetTargets(["/World/ball"])
        assert open_shot(save(stage)).scene.times == ()

    def test_that_change_their_size_count(self, stage: Usd.Stage):
        flat(stage)
        ball = add_ball(stage, "/World/ball", {1.0: (3.0, 3.0, -4.0)})
        for time in (2.0, 7.0):
            ball.GetRadiusAttr().Set(time / 2.0, time)
        assert open_shot(save(stage)).scene.times == (1.0, 2.0, 7.0)

    FINE = (1.0, 1.25, 2.0, 2.25, 3.0)

    def test_that_are_not_solved_get_one_word(self, stage: Usd.Stage):
        flat(stage, times=(1.0, 2.0, 3.0))
        add_ball(stage, "/World/ball", {time: (3.0, 3.0, -4.0 - time**2) for time in self.FINE})
        shot = open_shot(save(stage))
        assert shot.scene.times == (1.0, 2.0, 3.0)
        word = "</World/ball>: has 2 samples at time codes at which </World/cloth> is not solved, the first at 1.25"
        assert said(shot).count(word) == 1

    @pytest.mark.parametrize("bend", [0.0, 0.01])
    def test_that_are_not_solved_get_no_word_where_the_body_moves_straight(self, stage: Usd.Stage, bend: float):
        flat(stage, times=(1.0, 2.0, 3.0))
        add_ball(stage, "/World/ball", {time: (3.0, 3.0, -4.0 - time) for time in self.FINE})
        floor = add_sheet(stage, "/World/floor", times=(), tagged=False)
        floor.GetPrim().AddAppliedSchema(COLLIDER_API)
        for time in self.FINE:
            low = sheet_points() - np.array([0.0, 0.0, 5.0 + time + bend * (time == 2.25)])
            floor.GetPointsAttr().Set(vec3(low), time)
        assert ("not solved" in said(open_shot(save(stage)))) == bool(bend)


def refine_range(shot: Path, folder: Path, frames: tuple[float, float]) -> Path:
    out = folder / f"range{frames[0]:g}.usdc"
    refine(shot, out, frames=frames)
    return out


@pytest.mark.parametrize(
    ("rates", "length"),
    [((96.0, 24.0), 4.0), ((120.0, 30.0), 4.0), ((48.0, 24.0), 2.0), ((96.0, None), 1.0), ((25.0, 24.0), 1.0)],
)
def test_whole_frames_are_those_of_frames_per_second(tmp_path: Path, rates, length: float) -> None:
    stage = new_stage(tmp_path / "s.usda", rate=rates[0])
    stage.GetRootLayer().ClearFramesPerSecond()
    if rates[1] is not None:
        stage.SetFramesPerSecond(rates[1])
    stage.SetStartTimeCode(1.0)
    add_sheet(stage, times=())
    turn = UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddRotateZOp()
    for time, angle in ((1.0, 0.0), (25.0, 90.0)):
        turn.Set(angle, time)
    assert open_shot(save(stage)).scene.times == tuple(np.arange(1.0, 25.5, length))


class TestJumps:
    def test_have_both_sides_and_show_the_pose_after_at_the_whole_frame(self, tmp_path: Path):
        """A clip in a loop: the sheet goes back by 3 of its squares at 3 and 6."""
        shot, out = Path(loop_shot(tmp_path, size=SIZE, metres=EDGE)), tmp_path / "fine.usdc"
        report = refine(shot, out, velocities=True)
        assert report.exit_code == 0
        assert errors(out, shot) == []
        times = sample_times(out)
        assert [round(time, 3) for time in times] == [0.0, 1.0, 2.0, 3.0, 3.0, 4.0, 5.0, 6.0, 6.0, 7.0, 8.0]
        stage = Usd.Stage.Open(str(shot))
        cage = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr()
        for time in (*times, 2.5, 2.999):
            away = fine(shot, out, time)[: len(sheet_points(None, SIZE))] - EDGE * np.asarray(cage.Get(time))
            assert np.linalg.norm(away, axis=1).max() < 0.3 * EDGE
        composed = open_over(shot, out)
        speeds = UsdGeom.Mesh(composed.GetPrimAtPath(CLOTH)).GetVelocitiesAttr()
        assert all(np.isclose(np.mean(speeds.Get(time), axis=0)[0], 24.0, atol=2.0) for time in times)

    def test_of_bodies_are_known_to_cloth_that_stands_still(self, tmp_path: Path):
        stage = new_stage(tmp_path / "s.usda", metres=EDGE)
        flat(stage)
        places = {1.0: (3.0, 3.0, -0.8), 2.9999: (3.0, 3.0, -0.6), 3.0: (3.0, 3.0, -9.0), 4.0: (3.0, 3.0, -9.5)}
        add_ball(stage, "/World/ball", places)
        shot, out, _ = refined(stage, tmp_path)
        assert max(depth(shot, out, time, place) for time, place in places.items()) < 0.01 * EDGE
        assert np.abs(fine(shot, out, 3.0)[:, 2]).max() < 0.2 * EDGE < np.abs(fine(shot, out, 2.9)[:, 2]).max()

    def test_that_are_none_have_one_side(self, stage: Usd.Stage):
        mesh = add_sheet(stage, times=(1.0, 2.0, 3.0))
        mesh.GetPointsAttr().Set(mesh.GetPointsAttr().Get(2.0), 2.0 - 1e-8)
        assert open_shot(save(stage)).scene.times == (1.0, 2.0, 3.0)


class TestRoundedTimes:
    FLOATS = (1000.99997, 1002.0, 1003.00003, 1003.99997)

    @pytest.fixture
    def shot(self, tmp_path: Path) -> Path:
        """Cloth at float seconds below a transform at whole frames."""
        stage = new_stage(tmp_path / "s.usda", metres=EDGE)
        rig = UsdGeom.Xform.Define(stage, "/World/rig")
        for number, time in enumerate(self.FLOATS):
            UsdGeom.XformCommonAPI(rig).SetTranslate((float(number), 0.0, 0.0), round(time))
        add_sheet(stage, "/World/rig/cloth", times=self.FLOATS)
        return Path(save(stage))

    def test_are_whole_ones(self, shot: Path, tmp_path: Path):
        refine(shot, tmp_path / "fine.usdc")
        assert sample_times(tmp_path / "fine.usdc", "/World/rig/cloth") == self.FLOATS
        assert errors(tmp_path / "fine.usdc", shot) == []

    @pytest.mark.parametrize(("first", "last"), [(1, 1), (1, 2), (2, 3), (3, 4), (4, 4)])
    def test_lie_in_ranges_that_name_the_frame(self, shot: Path, first: int, last: int):
        times = open_shot(str(shot), frames=(1000.0 + first, 1000.0 + last)).scene.times
        assert times == self.FLOATS[first - 1 : last]

    def test_are_told_apart_in_messages(self, shot: Path):
        with pytest.raises(AbsentError, match=r"frames 1004.002:1005; its 4 samples run from 1000.99997 to 1003.9"):
            open_shot(str(shot), frames=(1004.002, 1005.0))


def test_cloth_that_stands_still_is_solved_where_a_prototype_moves(tmp_path: Path):
    stage = new_stage(tmp_path / "shot.usda")
    flat(stage)
    rocks = UsdGeom.PointInstancer.Define(stage, "/World/rocks")
    add_ball(stage, "/World/rocks/ball", {1.0: (0.0, 0.0, 0.0), 2.0: (0.0, 0.01, 0.0), 3.0: (0.0, 0.0, 0.0)})
    rocks.CreatePrototypesRel().SetTargets(["/World/rocks/ball"])
    rocks.CreateProtoIndicesAttr([0])
    rocks.CreatePositionsAttr([(0.0, 0.0, 0.0)])
    shot = open_shot(save(stage), colliders=("/World/rocks",))
    assert shot.scene.times == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("body", ["/World/field", "/World/field/rocks/ball"])
def test_cloth_that_stands_still_is_solved_where_a_nested_instancer_moves(tmp_path: Path, body: str):
    """Also where one shape of it is named, and as the pages and the validator see its time codes."""
    stage = new_stage(tmp_path / "shot.usda")
    flat(stage)
    field, rocks = (UsdGeom.PointInstancer.Define(stage, path) for path in ("/World/field", "/World/field/rocks"))
    add_ball(stage, "/World/field/rocks/ball", {1.0: (0.0, 0.0, 0.0)})
    for instancer, prototype in ((field, "/World/field/rocks"), (rocks, "/World/field/rocks/ball")):
        instancer.CreatePrototypesRel().SetTargets([prototype])
        instancer.CreateProtoIndicesAttr([0])
        instancer.CreatePositionsAttr([(0.0, 0.0, 0.0)])
    for time, height in ((1.0, 0.0), (2.0, 0.01), (3.0, 0.0)):
        rocks.GetPositionsAttr().Set([(0.0, height, 0.0)], time)
    assert motion_of(field.GetPrim()).times == (1.0, 2.0, 3.0)
    shot = open_shot(save(stage), colliders=(body,))
    assert shot.scene.times == (1.0, 2.0, 3.0)
    poses = [pose for time in shot.scene.times for pose in shot.frame(time).colliders if pose is not None]
    assert [pose.points[:, 1].mean() for pose in poses] == pytest.approx([0.0, 0.01, 0.0], abs=1e-6)


class TestLoops:
    ROUND, BACK = (0, 1, 2, 3, 4, 5, 0), (0, 1, 2, 3, 2, 1, 0)

    def shot(self, path: Path, phases: Sequence[int]) -> Path:
        """A sheet over which a wave travels, by phases in sixths of its length."""
        stage = new_stage(path, metres=EDGE)
        attribute = add_sheet(stage, CLOTH, times=(), size=SIZE).GetPointsAttr()
        for number, phase in enumerate(phases):
            attribute.Set(vec3(sheet_points(2 * np.pi / 0.7 * phase / 6, SIZE)), float(number))
        return Path(save(stage))

    @pytest.mark.parametrize(("phases", "temporal"), [(ROUND, "tether"), (ROUND, "off"), (BACK, "tether")])
    def test_that_do_not_close_get_a_word_with_a_remedy_that_closes_them(self, tmp_path: Path, phases, temporal: str):
        shot, out = self.shot(tmp_path / "s.usda", phases), tmp_path / "fine.usdc"
        report = refine(shot, out, overrides=("rest:weftEase=12",), temporal=temporal)
        first, last = (fine(shot, out, time) for time in (0.0, 6.0))
        is_open = phases is self.ROUND and temporal != "off"
        assert any("--temporal off closes it" in warning for warning in report.warnings) == is_open
        if temporal == "off":
            np.testing.assert_array_equal(first, last)
        else:
            assert np.percentile(np.linalg.norm(last - first, axis=1), 99) > 0.05 * EDGE
