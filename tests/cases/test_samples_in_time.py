"""Frames without a garment, bodies and garments whose samples do not meet, velocities where the cloth jumps."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from layers import errors, write_layer
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from shots import CLOTH, refine
from stages import COLLIDER_API, add_sheet, author, new_stage, said, save, sheet_points, vec3

from physgraph_usd.errors import GarmentError, SchemaError
from physgraph_usd.shot.cuts import jumps
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.usd.check.validate import validate_layer
from physgraph_usd.usd.read.reader import open_shot

TIMES = (1.0, 2.0, 3.0, 4.0)
STEP = np.array([0.5, 0.0, 0.0])
"""Motion of a sheet of unit squares from sample to sample: 12 units a second."""


def block(stage: Usd.Stage, name: str, time: float) -> None:
    stage.GetRootLayer().SetTimeSample(name, time, Sdf.ValueBlock())


def sample_topology(mesh: UsdGeom.Mesh, name: str, odd: float) -> None:
    """Sample an array of a mesh's topology at all times, empty at one of them."""
    attribute = mesh.GetPrim().GetAttribute(name)
    value = attribute.Get()
    for time in TIMES:
        attribute.Set(Vt.IntArray() if time == odd else value, time)


def hide_by_block(mesh: UsdGeom.Mesh, time: float) -> None:
    block(mesh.GetPrim().GetStage(), f"{CLOTH}.points", time)


def hide_by_no_points(mesh: UsdGeom.Mesh, time: float) -> None:
    mesh.GetPointsAttr().Set(Vt.Vec3fArray(), time)


def hide_by_no_faces(mesh: UsdGeom.Mesh, time: float) -> None:
    for name in ("faceVertexCounts", "faceVertexIndices"):
        sample_topology(mesh, name, time)


def hide_by_scale(mesh: UsdGeom.Mesh, time: float) -> None:
    scale = UsdGeom.Xformable(mesh.GetPrim().GetParent()).AddScaleOp()
    for each in TIMES:
        scale.Set(Gf.Vec3f(0.0 if each == time else 1.0), each)


def hide_by_blocked_transform(mesh: UsdGeom.Mesh, time: float) -> None:
    move = UsdGeom.Xformable(mesh.GetPrim().GetParent()).AddTranslateOp()
    for each in TIMES:
        move.Set(Gf.Vec3d(each, 0.0, 0.0), each)
    block(mesh.GetPrim().GetStage(), str(move.GetAttr().GetPath()), time)


HIDES = {
    hide_by_block: "its points have no value",
    hide_by_no_points: "its points are empty",
    hide_by_no_faces: "its faceVertexCounts are empty",
    hide_by_scale: "it scales by 0, 0 and 0",
    hide_by_blocked_transform: "xformOp:translate of </World> has no value",
}


class TestFramesWithoutTheGarment:
    @pytest.mark.parametrize("time", [1.0, 3.0])
    @pytest.mark.parametrize(("hide", "reason"), HIDES.items())
    def test_are_named_and_left_out(
        self, stage: Usd.Stage, hide: Callable[[UsdGeom.Mesh, float], None], reason: str, time: float
    ):
        hide(add_sheet(stage, times=TIMES), time)
        path, others = save(stage), tuple(each for each in TIMES if each != time)
        shot = open_shot(path)
        assert shot.scene.times == others
        assert f"<{CLOTH}>: is not there at time code {time:g}: " in said(shot)
        assert reason in said(shot)
        assert all(np.ptp(shot.frame(each).garments[0].points, axis=0).max() > 1.0 for each in others)
        alone = open_shot(path, frames=(others[0], others[0]))
        assert (alone.scene.times, "is not there" in said(alone)) == (others[:1], False)

    def test_of_a_shot_without_others_are_refused(self, stage: Usd.Stage):
        add_sheet(stage, times=TIMES[:1])
        block(stage, f"{CLOTH}.points", 1.0)
        with pytest.raises(GarmentError, match="at time code 1: its points have no value; it is there at no time code"):
            open_shot(save(stage))

    @pytest.mark.parametrize("hidden", [(1.0, 2.0), (3.0,)])
    def test_are_blocked_in_the_layer(self, stage: Usd.Stage, tmp_path: Path, hidden: tuple[float, ...]):
        add_sheet(stage, times=TIMES)
        for time in hidden:
            block(stage, f"{CLOTH}.points", time)
        shot = Path(save(stage))
        layer = Sdf.Layer.FindOrOpen(str(write_layer(shot, tmp_path / "fine.usdc", velocities=True, scheme="none")))
        for name in ("points", "normals", "extent", "velocities"):
            values = [layer.QueryTimeSample(f"{CLOTH}.{name}", time) for time in TIMES]
            gone = [time for time, value in zip(TIMES, values, strict=True) if isinstance(value, Sdf.ValueBlock)]
            alone = [] if name != "velocities" or hidden != (3.0,) else [4.0]
            assert (name, gone) == (name, sorted([*hidden, *alone]))
        assert errors(tmp_path / "fine.usdc", shot) == []

    def test_that_another_garment_has_are_solved_without_it(self, tmp_path: Path):
        """Of two sheets that lie on one another one is not there for a frame; the run is content."""
        stage = new_stage(tmp_path / "s.usda", metres=0.05)
        for name, height in (("cloth", 0.0), ("lining", 0.02)):
            mesh = add_sheet(stage, f"/World/{name}", times=TIMES)
            for time in TIMES:
                mesh.GetPointsAttr().Set(vec3(sheet_points(time) + np.array([0.0, 0.0, height])), time)
        block(stage, "/World/lining.points", 3.0)
        shot, out = Path(save(stage)), tmp_path / "fine.usdc"
        report = refine(shot, out, level=0)
        assert report.exit_code == 0
        assert [bool(frame["garments"][0].get("together")) for frame in report.frames] == [True, True, False, True]
        layer = Sdf.Layer.FindOrOpen(str(out))
        assert isinstance(layer.QueryTimeSample("/World/lining.points", 3.0), Sdf.ValueBlock)
        assert not any(problem.severity == "error" for problem in validate_layer(out, shot))


def show(prim: UsdGeom.Imageable, *, at: dict[float, bool]) -> None:
    """Make a prim visible or invisible from some time codes on."""
    attribute = prim.CreateVisibilityAttr()
    for time, is_visible in at.items():
        attribute.Set("inherited" if is_visible else "invisible", time)


class TestFramesInWhichItIsInvisible:
    @pytest.mark.parametrize("path", [CLOTH, "/World"])
    @pytest.mark.parametrize(("at", "expected"), [({0: False, 3: True}, (3.0, 4.0)), ({1: True, 3: False}, (1.0, 2.0))])
    def test_are_neither_solved_nor_warned_about(
        self, stage: Usd.Stage, tmp_path: Path, path: str, at: dict[float, bool], expected: tuple[float, ...]
    ):
        """There its points lie piled up at one place; it fits no rest shape to them and blocks them in the layer."""
        mesh = add_sheet(stage, times=TIMES, default=False)
        for time in {*TIMES} - {*expected}:
            mesh.GetPointsAttr().Set(vec3(1e-4 * sheet_points(time)), time)
        show(UsdGeom.Imageable(stage.GetPrimAtPath(path)), at=at)
        shot = open_shot(save(stage))
        assert shot.scene.times == expected
        assert not [line for line in said(shot).splitlines() if CLOTH in line]
        layer = Sdf.Layer.FindOrOpen(str(write_layer(Path(save(stage)), tmp_path / "fine.usdc")))
        values = {time: layer.QueryTimeSample(f"{CLOTH}.points", time) for time in TIMES}
        assert tuple(time for time, value in values.items() if not isinstance(value, Sdf.ValueBlock)) == expected
        assert errors(tmp_path / "fine.usdc", Path(save(stage))) == []

    def test_are_solved_beside_frames_that_lie_between_samples(self, stage: Usd.Stage):
        """Visible from 6 to 7, between samples at 1, 5, 9 and 13: the poses there are those of 5 and of 9."""
        add_sheet(stage, times=(1.0, 5.0, 9.0, 13.0))
        show(UsdGeom.Imageable(stage.GetPrimAtPath(CLOTH)), at={0: False, 6: True, 8: False})
        assert open_shot(save(stage)).scene.times == (5.0, 9.0)

    @pytest.mark.parametrize("at", [{0: False}, {0: False, 100: True}])
    def test_are_refined_where_no_other_is_left(self, stage: Usd.Stage, at: dict[float, bool]):
        """A hidden cage that is named, as those of simulations are, and one that is shown after the shot."""
        add_sheet(stage, times=TIMES)
        show(UsdGeom.Imageable(stage.GetPrimAtPath(CLOTH)), at=at)
        assert open_shot(save(stage)).scene.times == TIMES

    def test_leave_it_out_of_a_range_with_a_word(self, stage: Usd.Stage):
        add_sheet(stage, times=TIMES)
        add_sheet(stage, "/World/other", times=TIMES)
        show(UsdGeom.Imageable(stage.GetPrimAtPath(CLOTH)), at={0: False, 3: True})
        found = said(open_shot(save(stage), frames=(1.0, 2.0)))
        assert f"<{CLOTH}>: left out: it is invisible in the frame range; its time codes run from 3 to 4" in found


class TestValuesOfAnotherTime:
    @pytest.mark.parametrize("name", ["points", "xformOp:translate", "xformOp:scale"])
    def test_are_no_pose_of_a_body(self, stage: Usd.Stage, name: str):
        add_sheet(stage, times=TIMES)
        body = add_sheet(stage, "/World/floor", times=TIMES, tagged=False, default=False)
        body.GetPrim().AddAppliedSchema(COLLIDER_API)
        ops = {"xformOp:translate": body.AddTranslateOp(), "xformOp:scale": body.AddScaleOp()}
        for time in TIMES if name in ops else ():
            ops[name].Set(Gf.Vec3d(1.0) if name == "xformOp:translate" else Gf.Vec3f(float(time != 3.0)), time)
        if name != "xformOp:scale":
            block(stage, f"/World/floor.{name}", 3.0)
        shot = open_shot(save(stage))
        assert [shot.frame(time).colliders[0] is None for time in TIMES] == [False, False, True, False]
        assert "</World/floor> at time code 3: this collider is left out here: " in said(shot)

    def test_are_no_value_of_an_attribute(self, stage: Usd.Stage):
        mesh = add_sheet(stage, times=TIMES)
        for time in TIMES:
            author(mesh.GetPrim(), "physgraph:guide:stiffness", 1000.0 * time, time=time)
            author(mesh.GetPrim(), "physgraph:refine:level", round(time), kind="int", time=time)
        block(stage, f"{CLOTH}.physgraph:guide:stiffness", 3.0)
        shot = open_shot(save(stage))
        assert shot.frame(2.0).garments[0].guide == 2000.0
        assert "physgraph:refine:level changes in time; its first sample is used throughout" in said(shot)
        with pytest.raises(SchemaError, match="guide:stiffness at time code 3 is blocked"):
            shot.frame(3.0)


class TestSamplesOfBodies:
    @pytest.mark.parametrize(
        ("times", "message"),
        [
            (
                (11.0, 12.0),
                "run from 11 to 12, those of </World/cloth> from 1 to 4, and share no time; it stands still",
            ),
            ((0.5, 1.5, 4.5), "share no time; its poses are interpolated"),
            ((1.0, 2.0), "it stands still after 2"),
            ((0.0, 1.0, 4.0), ""),
        ],
    )
    def test_that_miss_the_garments_are_named(self, stage: Usd.Stage, times: tuple[float, ...], message: str):
        add_sheet(stage, times=TIMES)
        body = add_sheet(stage, "/World/floor", times=times, tagged=False)
        body.GetPrim().AddAppliedSchema(COLLIDER_API)
        warnings = [each for each in inspect_shot(save(stage))["warnings"] if "</World/floor>: its samples" in each]
        assert [message in each for each in warnings] == [True] * bool(message)
        assert all(each.endswith("export its samples at the time codes from 1 to 4") for each in warnings)

    @pytest.mark.parametrize(
        ("frames", "message"),
        [
            ((1.0, 3.0), ""),
            ((2.0, 6.0), "from 0 to 4, those of </World/cloth> from 1 to 6; it stands still after 4; export its"),
        ],
    )
    def test_a_frame_range_cuts_no_samples_off_in_words(
        self, stage: Usd.Stage, frames: tuple[float, float], message: str
    ):
        """Whether a body stands still is asked of the frames refined, and told with all samples of the garment."""
        add_sheet(stage, times=range(1, 7))
        add_sheet(stage, "/World/floor", times=range(5), tagged=False).GetPrim().AddAppliedSchema(COLLIDER_API)
        warnings = [
            each
            for each in inspect_shot(save(stage), frames=frames)["warnings"]
            if "</World/floor>: its samples" in each
        ]
        assert [message in each for each in warnings] == [True] * bool(message)

    def test_that_a_file_of_another_rate_moves_are_named(self, tmp_path: Path):
        for name, rate in (("cloth", 25.0), ("floor", None)):
            part = new_stage(tmp_path / f"{name}.usda", rate=rate or 24.0)
            mesh = add_sheet(part, f"/World/{name}", times=(1001.0, 1002.0), tagged=name == "cloth")
            mesh.GetPrim().AddAppliedSchema(COLLIDER_API) if rate is None else None
            save(part)
        root = Sdf.Layer.CreateNew(str(tmp_path / "root.usda"))
        root.subLayerPaths[:] = ["./cloth.usda", "./floor.usda"]
        root.Save()
        found = said(open_shot(root.realPath))
        assert "cloth.usda@ has 25 time codes per second, @root.usda@ has no rate, which counts as 24" in found
        assert (
            "</World/floor>: its samples run from 1001 to 1002, those of </World/cloth> from 960.96 to 961.92" in found
        )


def moving(stage: Usd.Stage, *, cut: float = 9.0) -> UsdGeom.Mesh:
    """A sheet that moves by `STEP` from sample to sample, and by 100 units more at a cut."""
    mesh = add_sheet(stage, times=())
    for time in TIMES:
        points = sheet_points(0.0) + STEP * time + np.array([0.0, 100.0 * (time >= cut), 0.0])
        mesh.GetPointsAttr().Set(vec3(points), time)
    return mesh


def velocities(layer: Path) -> dict[float, list[float] | None]:
    """Mean velocity in a layer at each sample, None where it is blocked."""
    name, found = f"{CLOTH}.velocities", Sdf.Layer.FindOrOpen(str(layer))
    values = {time: found.QueryTimeSample(name, time) for time in found.ListTimeSamplesForPath(name)}
    return {
        time: None if isinstance(value, Sdf.ValueBlock) else np.asarray(value).mean(axis=0).round(2).tolist()
        for time, value in values.items()
    }


class TestVelocities:
    RIGHT = [12.0, 0.0, 0.0]  # noqa: RUF012

    def test_are_never_taken_across_a_cut(self, stage: Usd.Stage, tmp_path: Path):
        mesh = moving(stage, cut=3.0)
        mesh.CreateVelocitiesAttr([self.RIGHT] * len(mesh.GetPointsAttr().Get(1.0)))
        shot, out = Path(save(stage)), tmp_path / "fine.usdc"
        assert jumps(open_shot(str(shot)), 0) == {3.0}
        refine(shot, out, level=0, temporal="off")
        found = velocities(out)
        assert tuple(found) == TIMES
        assert all(np.allclose(each, self.RIGHT, atol=0.3) for each in found.values() if each is not None)
        assert None not in found.values()

    @pytest.mark.parametrize("samples", [(None,), (2.0, 4.0)])
    def test_of_a_frame_alone_are_the_shots_own(
        self, stage: Usd.Stage, tmp_path: Path, samples: tuple[float | None, ...]
    ):
        mesh = moving(stage)
        own = Vt.Vec3fArray([self.RIGHT] * len(mesh.GetPointsAttr().Get(1.0)))
        for time in samples:
            mesh.CreateVelocitiesAttr().Set(own, Usd.TimeCode.Default() if time is None else time)
        save(stage)
        shot = open_shot(str(tmp_path / "s.usda"), frames=(3.0, 3.0))
        assert shot.sources[0].velocities
        refine(tmp_path / "s.usda", tmp_path / "fine.usdc", frames=(3.0, 3.0), level=1)
        assert velocities(tmp_path / "fine.usdc") == {3.0: self.RIGHT}

    def test_of_a_frame_alone_are_blocked_with_a_word_where_the_shot_has_none(self, stage: Usd.Stage, tmp_path: Path):
        mesh = moving(stage)
        mesh.CreateVelocitiesAttr().Set([self.RIGHT] * len(mesh.GetPointsAttr().Get(1.0)), 4.0)
        shot = Path(save(stage))
        report = refine(shot, tmp_path / "fine.usdc", frames=(3.0, 3.0), level=0)
        assert velocities(tmp_path / "fine.usdc") == {3.0: None}
        assert any("its velocities are blocked at time code 3: " in warning for warning in report.warnings)
