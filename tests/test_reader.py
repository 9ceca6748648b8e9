"""Reading a shot: what comes out is the stage's cloth, in metres, at the stage's own times."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom
from stages import (
    COLLIDER_API,
    KINDS,
    add_sheet,
    affine,
    author,
    instanced_shot,
    new_stage,
    said,
    save,
    set_matrix,
    set_spline,
    sheet_faces,
    sheet_points,
    sheet_shot,
    vec3,
)

from physgraph_usd.errors import GarmentError, StageError, UsageError
from physgraph_usd.usd.read.reader import Shot, open_shot


def world(shot: Shot, time: float | None, index: int = 0) -> np.ndarray:
    return shot.frame(time).garments[index].points


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_face_is_read_as_authored(tmp_path: Path, kind: str) -> None:
    shot = open_shot(sheet_shot(tmp_path / "s.usda", kind=kind))
    counts, indices = sheet_faces(kind)
    mesh = shot.scene.garments[0].mesh
    np.testing.assert_array_equal(mesh.counts, counts)
    np.testing.assert_array_equal(mesh.indices, indices)
    np.testing.assert_array_equal(shot.sources[0].kept_faces, np.arange(len(counts)))
    assert shot.scene.times == (1.0, 2.0, 3.0)
    for time in shot.scene.times:
        np.testing.assert_array_equal(world(shot, time), sheet_points(time).astype(np.float64))


def test_holes_are_left_out_and_face_order_kept(stage: Usd.Stage) -> None:
    add_sheet(stage, kind="mixed").CreateHoleIndicesAttr([3, 0, 99])
    shot = open_shot(save(stage))
    counts, indices = sheet_faces("mixed")
    kept = np.setdiff1d(np.arange(len(counts)), [0, 3])
    np.testing.assert_array_equal(shot.sources[0].kept_faces, kept)
    starts = np.concatenate([[0], np.cumsum(counts)])
    expected = np.concatenate([indices[starts[face] : starts[face + 1]] for face in kept])
    np.testing.assert_array_equal(shot.scene.garments[0].mesh.indices, expected)
    assert "1 holeIndices name no face" in said(shot)


NESTED = [affine(np.diag([1.0, 2.0, 0.5]), (1, 2, 3)), affine([[0, -1, 0], [1, 0, 0], [0, 0, 1]])]
MIRROR = affine(np.diag([-1.0, 1.0, 1.0]))
PLACES = {"nested": NESTED, "both": [NESTED[0], MIRROR, NESTED[1]]}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_s6_transforms_and_handedness_equal_the_baked_cloth(stage: Usd.Stage, place: str, orientation: str) -> None:
    path, total = "/World", np.eye(4)
    for number, matrix in enumerate(PLACES[place]):
        path += f"/x{number}"
        set_matrix(UsdGeom.Xform.Define(stage, path).GetPrim(), matrix)
        total = total @ matrix
    add_sheet(stage, path + "/cloth").CreateOrientationAttr(orientation)
    shot = open_shot(save(stage))
    for time in shot.scene.times:
        expected = sheet_points(time) @ total[:3, :3].T + total[:3, 3]
        np.testing.assert_allclose(world(shot, time), expected, atol=1e-6)
    mirrored = np.linalg.det(total) < 0
    assert shot.scene.garments[0].flipped == ((orientation == "leftHanded") != mirrored)
    np.testing.assert_allclose(shot.to_metres(0, 1.0), total, atol=1e-12)


def test_animated_and_mirrored_parents_are_followed_at_each_time(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda", metres=0.01)
    rig = UsdGeom.Xform.Define(stage, "/World/rig").GetPrim()
    matrices = {time: affine(np.diag([-1.0, 1.0 + time, 2.0]), (time, 0, 0)) for time in (1.0, 2.5, 4.0)}
    for time, matrix in matrices.items():
        set_matrix(rig, matrix, time)
    add_sheet(stage, "/World/rig/cloth", times=(1.0, 2.0))
    shot = open_shot(save(stage))
    assert shot.scene.times == (1.0, 2.0, 2.5, 4.0)
    assert shot.scene.garments[0].flipped
    for time, matrix in matrices.items():
        held = sheet_points(min(time, 2.0))
        np.testing.assert_allclose(world(shot, time), 0.01 * (held @ matrix[:3, :3].T + matrix[:3, 3]), atol=1e-6)


def test_unauthored_units_are_centimetres_with_the_size_told(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda", metres=None)
    add_sheet(stage)
    shot = open_shot(save(stage))
    assert shot.metres_per_unit == 0.01
    assert "metersPerUnit is not authored; 0.01" in said(shot)
    assert "measures 0.04 x 0.03 x" in said(shot)


@pytest.mark.parametrize(("scale", "warned"), [(1.0, True), (0.01, False)])
def test_a_layer_in_other_units_is_told_unless_a_scale_corrects_it(tmp_path: Path, scale: float, warned: bool) -> None:
    asset = new_stage(tmp_path / "asset.usda", metres=0.01)
    add_sheet(asset)
    save(asset)
    stage = new_stage(tmp_path / "shot.usda", metres=1.0)
    prim = stage.DefinePrim("/World/char", "Xform")
    prim.GetReferences().AddReference("./asset.usda")
    set_matrix(prim, affine(scale * np.eye(3)))
    assert ("asset.usda@ has 0.01 m per unit" in said(open_shot(save(stage)))) == warned


def test_a_reset_transform_stack_ends_the_chain(stage: Usd.Stage) -> None:
    rig = UsdGeom.Xform.Define(stage, "/World/rig").GetPrim()
    set_matrix(rig, affine(np.eye(3), (5, 0, 0)), 9.0)
    UsdGeom.Xformable(add_sheet(stage, "/World/rig/cloth")).SetResetXformStack(True)
    shot = open_shot(save(stage))
    assert shot.scene.times == (1.0, 2.0, 3.0)
    np.testing.assert_array_equal(world(shot, 2.0), sheet_points(2.0))


def test_s32_instances_are_read_through_and_their_roots_told(tmp_path: Path) -> None:
    shot = open_shot(instanced_shot(tmp_path))
    assert [garment.path for garment in shot.scene.garments] == ["/World/one/cloth", "/World/two/cloth"]
    assert [source.instance_roots for source in shot.sources] == [(Sdf.Path("/World/one"),), (Sdf.Path("/World/two"),)]
    np.testing.assert_allclose(world(shot, 2.0, 1) - world(shot, 2.0, 0), [[10.0, 0.0, 0.0]] * 20, atol=1e-9)


def test_variants_payloads_and_references_are_followed(tmp_path: Path) -> None:
    sheet_shot(tmp_path / "asset.usda")
    stage = new_stage(tmp_path / "shot.usda")
    prim = stage.DefinePrim("/World/char", "Xform")
    variants = prim.GetVariantSets().AddVariantSet("res")
    for name in ("low", "none"):
        variants.AddVariant(name)
    variants.SetVariantSelection("low")
    with variants.GetVariantEditContext():
        prim.GetPayloads().AddPayload("./asset.usda")
    assert open_shot(save(stage)).scene.garments[0].path == "/World/char/cloth"


def test_s32_inactive_and_disabled_garments_do_not_count_and_invisible_ones_do(stage: Usd.Stage) -> None:
    for name in ("seen", "hidden", "off", "gone"):
        add_sheet(stage, f"/World/{name}")
    UsdGeom.Imageable(stage.GetPrimAtPath("/World/hidden")).MakeInvisible()
    stage.GetPrimAtPath("/World/gone").SetActive(False)
    author(stage.GetPrimAtPath("/World/off"), "physgraph:enabled", False, kind="bool")
    path = save(stage)
    shot = open_shot(path)
    assert [garment.path for garment in shot.scene.garments] == ["/World/seen", "/World/hidden"]
    assert "</World/off>: left out: it is disabled" in said(shot)
    assert len(open_shot(path, skip_invisible=True).scene.garments) == 1
    with pytest.raises(StageError, match=r"gone.*inactive"):
        open_shot(path, garments=["/World/gone"])


def test_s32_topology_that_varies_is_refused_with_prim_and_time(stage: Usd.Stage) -> None:
    indices = add_sheet(stage).GetFaceVertexIndicesAttr()
    same = sheet_faces()[1]
    for time in (1.0, 2.0):
        indices.Set(same.tolist(), time)
    assert len(open_shot(save(stage)).scene.times) == 3
    indices.Set(same[::-1].tolist(), 3.0)
    path = save(stage)
    with pytest.raises(GarmentError, match=r"</World/cloth> at time code 3: faceVertexIndices changes.*--frames"):
        open_shot(path)
    assert open_shot(path, frames=(1.0, 2.0)).scene.times == (1.0, 2.0)


def test_s32_a_number_of_points_that_varies_is_refused_with_prim_and_time(stage: Usd.Stage) -> None:
    add_sheet(stage).GetPointsAttr().Set(vec3(sheet_points(2.0)[:-1]), 2.0)
    shot = open_shot(save(stage))
    shot.frame(1.0)
    with pytest.raises(
        GarmentError, match=r"</World/cloth> at time code 2: the number of points changes from 20 to 19"
    ):
        shot.frame(2.0)


def test_singular_matrices_are_refused_with_prim_and_time(stage: Usd.Stage) -> None:
    add_sheet(stage)
    set_matrix(stage.GetPrimAtPath("/World"), np.diag([1.0, 0.0, 1.0, 1.0]), None)
    with pytest.raises(GarmentError, match=r"</World/cloth> at time code 1: .* singular.*scale other than zero"):
        open_shot(save(stage))


def test_level_comes_from_the_option_the_override_and_the_schema(stage: Usd.Stage) -> None:
    author(add_sheet(stage).GetPrim(), "physgraph:refine:level", -1, kind="int")
    path = save(stage)
    assert open_shot(path).scene.garments[0].level == -1
    shot = open_shot(path, level=3)
    assert (shot.scene.garments[0].level, shot.sources[0].sources["refine:level"]) == (3, "--level")
    assert open_shot(path, level=3, overrides=["level=auto"]).scene.garments[0].level == -1
    for wrong in (6, -2):
        with pytest.raises(UsageError, match=r"\[-1, 5\]"):
            open_shot(path, level=wrong)


def test_values_that_change_are_read_at_each_time(stage: Usd.Stage) -> None:
    prim = add_sheet(stage).GetPrim()
    for time, value in ((1.0, 1e-6), (3.0, 3e-6)):
        author(prim, "physgraph:material:bendStiffness", value, time=time)
    author(prim, "physgraph:refine:detail", 0.5)
    shot = open_shot(save(stage))
    bends = [shot.frame(time).garments[0].fabric.bend for time in shot.scene.times]
    np.testing.assert_allclose(bends, [1e-6, 2e-6, 3e-6], rtol=1e-6)
    assert shot.frame(2.0).garments[0].detail == 0.5
    assert shot.sources[0].animated == {"bendStiffness"}


def test_frames_do_not_depend_on_the_order_in_which_they_are_read(stage: Usd.Stage) -> None:
    points = sheet_points(2.0)
    points[7] = np.nan
    add_sheet(stage).GetPointsAttr().Set(vec3(points), 2.0)
    path = save(stage)
    forward, backward = open_shot(path), open_shot(path)
    one = {time: world(forward, time) for time in (1.0, 2.0, 3.0)}
    two = {time: world(backward, time) for time in (3.0, 2.0, 1.0)}
    for time, expected in one.items():
        np.testing.assert_array_equal(two[time], expected)
    assert len([notice for notice in forward.warnings if notice.time == 2.0]) == 1
    forward.frame(2.0)
    assert len([notice for notice in forward.warnings if notice.time == 2.0]) == 1


def test_the_file_is_not_touched(tmp_path: Path) -> None:
    path = instanced_shot(tmp_path, skinned=True)
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    with contextlib.closing(open_shot(path)) as shot:
        shot.frame(2.0)
        assert not shot.stage.GetRootLayer().dirty
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_gravity_of_a_physics_scene(tmp_path: Path) -> None:
    from pxr import UsdPhysics

    stage = new_stage(tmp_path / "s.usda", metres=0.01)
    add_sheet(stage)
    scene = UsdPhysics.Scene.Define(stage, "/World/physics")
    scene.CreateGravityDirectionAttr(Gf.Vec3f(2, 0, 0))
    scene.CreateGravityMagnitudeAttr(162.0)
    np.testing.assert_allclose(open_shot(save(stage)).scene.gravity, [1.62, 0, 0], rtol=1e-6)


def test_s31_times_are_the_union_of_authored_samples_and_nothing_else(stage: Usd.Stage) -> None:
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(8)
    rig = UsdGeom.Xform.Define(stage, "/World/rig").GetPrim()
    for time in (1.0, 1.25, 8.0):
        set_matrix(rig, np.eye(4), time)
    add_sheet(stage, "/World/rig/cloth", times=(1.0, 2.0, 7.0, 8.0))
    add_sheet(stage, "/World/still", times=())
    add_sheet(stage, "/World/prop", times=(3.0, 4.0), tagged=False)
    path = save(stage)
    shot = open_shot(path)
    assert shot.scene.times == (1.0, 1.25, 2.0, 7.0, 8.0)
    assert shot.sources[1].times == ()
    assert open_shot(path, frames=(2.0, 7.5)).scene.times == (2.0, 7.0)


def turning_sheet(path: Path, *, end: float | None = 9.0) -> tuple[Usd.Stage, Usd.Attribute]:
    """A still sheet below a rotation about z without value, in a shot from 1 to an end."""
    stage = new_stage(path)
    add_sheet(stage, times=())
    if end is not None:
        stage.SetStartTimeCode(1.0)
        stage.SetEndTimeCode(end)
    turn = UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddRotateZOp(UsdGeom.XformOp.PrecisionDouble)
    return stage, turn.GetAttr()


def turned(angle: float) -> np.ndarray:
    """The points of the sheet, turned about z by an angle in degrees."""
    x, y, z = sheet_points().T.astype(np.float64)
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)


@pytest.mark.parametrize(
    ("knots", "options", "times"),
    [
        ({1.5: 0.0, 4.0: 50.0}, {}, (1.5, 2.0, 3.0, 4.0)),
        ({1.0: 0.0, 5.0: 20.0}, {"post": "Linear"}, tuple(range(1, 10))),
        ({1.0: 0.0, 5.0: 20.0}, {"post": "LoopOscillate"}, tuple(range(1, 10))),
        ({1.0: 0.0, 5.0: 20.0}, {"post": "LoopRepeat"}, tuple(range(1, 10))),
        ({1.0: 0.0, 2.0: 10.0, 3.0: 0.0}, {"loops": 2}, tuple(range(1, 8))),
    ],
)
def test_a_transform_on_a_spline_is_solved_as_far_as_it_moves(tmp_path: Path, knots, options, times) -> None:
    stage, attribute = turning_sheet(tmp_path / "s.usda")
    set_spline(attribute, knots, **options)
    angles = [attribute.Get(time) for time in times]
    assert np.ptp(angles) > 5.0
    shot = open_shot(save(stage))
    assert shot.scene.times == times
    for time, angle in zip(times, angles, strict=True):
        np.testing.assert_allclose(world(shot, time), turned(angle), atol=1e-6)


def test_a_spline_that_holds_or_a_shot_without_an_end_has_no_time_codes_after_its_last_knot(tmp_path: Path) -> None:
    for name, post, end in (("held", "Held", 9.0), ("endless", "Linear", None)):
        stage, attribute = turning_sheet(tmp_path / f"{name}.usda", end=end)
        set_spline(attribute, {1.0: 0.0, 5.0: 20.0}, post=post)
        assert open_shot(save(stage)).scene.times == (1.0, 2.0, 3.0, 4.0, 5.0)


def test_a_gap_in_a_spline_is_named_and_left_out(tmp_path: Path) -> None:
    stage, attribute = turning_sheet(tmp_path / "s.usda")
    set_spline(attribute, {1.0: 0.0, 4.0: 20.0, 7.0: 20.0, 9.0: 0.0}, gaps=(4.0,))
    gap = tuple(time for time in map(float, range(1, 10)) if attribute.Get(time) is None)
    assert {5.0, 6.0} <= {*gap}
    shot = open_shot(save(stage))
    assert shot.scene.times == tuple(time for time in map(float, range(1, 10)) if time not in gap)
    assert shot.sources[0].absent == gap
    assert "rotateZ of </World> has no value" in said(shot)


def test_a_body_in_a_gap_of_a_spline_is_left_out_there(tmp_path: Path) -> None:
    stage, _ = turning_sheet(tmp_path / "s.usda")
    add_sheet(stage, "/World/body", times=(), tagged=False).GetPrim().AddAppliedSchema(COLLIDER_API)
    lift = UsdGeom.Xformable(stage.GetPrimAtPath("/World/body")).AddRotateZOp(UsdGeom.XformOp.PrecisionDouble)
    set_spline(lift.GetAttr(), {1.0: 0.0, 4.0: 20.0, 7.0: 20.0}, gaps=(4.0,), post="Linear")
    shot = open_shot(save(stage))
    assert shot.scene.times == tuple(map(float, range(1, 10)))
    left_out = {time for time in shot.scene.times if shot.frame(time).colliders[0] is None}
    assert {5.0, 6.0} <= left_out <= {4.0, 5.0, 6.0}


def test_a_shot_without_samples_has_one_default_frame(tmp_path: Path) -> None:
    shot = open_shot(sheet_shot(tmp_path / "s.usda", times=()))
    assert shot.scene.times == ()
    np.testing.assert_array_equal(world(shot, None), sheet_points())


@pytest.mark.parametrize(("offset", "scale"), [(10.0, 1.0), (0.0, 25 / 24), (-3.5, 2.0)])
def test_s32_layer_offsets_are_composed(tmp_path: Path, offset: float, scale: float) -> None:
    sheet_shot(tmp_path / "anim.usda")
    root = Sdf.Layer.CreateNew(str(tmp_path / "shot.usda"))
    root.timeCodesPerSecond = 24.0
    root.pseudoRoot.SetInfo("metersPerUnit", 1.0)
    root.subLayerPaths.append("./anim.usda")
    root.subLayerOffsets[0] = Sdf.LayerOffset(offset, scale)
    root.Save()
    shot = open_shot(root.realPath)
    np.testing.assert_allclose(shot.scene.times, offset + scale * np.array([1.0, 2.0, 3.0]), atol=1e-9)
    np.testing.assert_allclose(world(shot, shot.scene.times[1]), sheet_points(2.0), atol=1e-6)


def test_garments_outside_the_frame_range_are_left_out(stage: Usd.Stage) -> None:
    add_sheet(stage, "/World/early")
    add_sheet(stage, "/World/late", times=(10.0, 11.0))
    path = save(stage)
    shot = open_shot(path, frames=(9.0, 20.0))
    assert [garment.path for garment in shot.scene.garments] == ["/World/late"]
    assert "its time codes run from 1 to 3" in said(shot)
    with pytest.raises(StageError, match=r"frames 4:5; its 5 samples run from 1 to 11.*--frames 1:11"):
        open_shot(path, frames=(4.0, 5.0))


@pytest.mark.parametrize("frames", [(5.0, 1.0), (float("nan"), 2.0), (1.0, float("inf"))])
def test_a_range_that_is_none_is_refused(tmp_path: Path, frames: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match="no range"):
        open_shot(sheet_shot(tmp_path / "s.usda"), frames=frames)


def test_samples_in_falling_order_are_those_in_rising_order(stage: Usd.Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """As USD before 26 gives them below a layer offset of negative scale; of equal neighbours none is dropped."""
    points = add_sheet(stage, times=(1.0, 5.0, 9.0)).GetPointsAttr()
    points.Set(points.Get(5.0), 9.0)
    rising = Usd.Attribute.GetTimeSamples
    monkeypatch.setattr(Usd.Attribute, "GetTimeSamples", lambda attribute: rising(attribute)[::-1])
    assert open_shot(save(stage)).scene.times == (1.0, 5.0, 9.0)
