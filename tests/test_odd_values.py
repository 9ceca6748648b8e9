"""Values of the wrong type or size, as `python -m tests.fuzz` found them: told or refused, never a traceback."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from fuzz.damage import VALUES, replace
from layers import COAT, dress_up, errors, make_shot, write_layer
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt
from shots import refine
from stages import (
    COLLIDER_API,
    add_sheet,
    add_skeleton,
    bind_skin,
    new_stage,
    said,
    save,
    sheet_points,
    sheet_shot,
    vec3,
)

from physgraph_usd.errors import GarmentError, StageError
from physgraph_usd.usd.check.validate import validate_layer
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.read.survey import survey
from physgraph_usd.usd.stage import LONGEST_REASON, read_units

CLOTH = "/World/cloth"


def retype(stage: Usd.Stage, path: str, kind: str, value: object) -> None:
    replace(stage, Sdf.Path(path), kind, value)


@pytest.mark.parametrize(
    ("name", "kind", "value"),
    [
        ("gravityMagnitude", "float3", Gf.Vec3f(1, 2, 3)),
        ("gravityMagnitude", "float", float("nan")),
        ("gravityDirection", "timecode", Sdf.TimeCode(1.0)),
        ("gravityDirection", "vector3f", Gf.Vec3f(float("nan"), 0, 0)),
    ],
)
def test_gravity_that_is_none_is_told_and_the_earth_s_taken(stage: Usd.Stage, name: str, kind: str, value: object):
    UsdPhysics.Scene.Define(stage, "/World/physics")
    retype(stage, f"/World/physics.physics:{name}", kind, value)
    units, notices = read_units(stage)
    np.testing.assert_allclose(units.gravity, [0.0, -9.81, 0.0])
    assert [notice.path for notice in notices if name in notice.message] == ["/World/physics"]


def test_a_mistake_in_a_text_file_is_told_in_short_and_without_names_of_code(tmp_path: Path):
    shot = Path(sheet_shot(tmp_path / "s.usda", size=(40, 30)))
    for old, new in (("[(", "[("[:1]), ("point3f[]", "string"), ('"World"', '"World')):
        broken = tmp_path / "broken.usda"
        broken.write_text(shot.read_text().replace(old, new, 1))
        with pytest.raises(StageError, match=r"broken\.usda") as caught:
            open_shot(str(broken))
        assert "pxrInternal" not in str(caught.value)
        assert len(str(caught.value)) < 6 * LONGEST_REASON


@pytest.mark.parametrize("name", ["physics:restShapePoints", "primvars:rest"])
@pytest.mark.parametrize(("kind", "value"), [("float", 0.5), ("asset", Sdf.AssetPath("x"))])
def test_a_rest_shape_that_is_no_array_is_refused_by_name(stage: Usd.Stage, name: str, kind: str, value: object):
    add_sheet(stage, CLOTH)
    retype(stage, f"{CLOTH}.{name}", kind, value)
    with pytest.raises(GarmentError, match=f"<{CLOTH}>.*{name}.*not an array of positions"):
        open_shot(save(stage))


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("faceVertexIndices", "int"),
        ("faceVertexIndices", "float[]"),
        ("faceVertexCounts", "string[]"),
        ("points", "string[]"),
        ("points", "matrix4d"),
    ],
)
def test_a_body_whose_points_or_faces_are_of_another_type_is_left_out_by_name(
    stage: Usd.Stage, tmp_path: Path, name: str, kind: str
):
    add_sheet(stage, CLOTH)
    add_sheet(stage, "/World/floor", tagged=False).GetPrim().AddAppliedSchema(COLLIDER_API)
    retype(stage, f"/World/floor.{name}", kind, VALUES[kind])
    report = refine(Path(save(stage)), tmp_path / "fine.usdc", level=1, steps=1)
    assert any("its points and faces do not fit together" in str(each) for each in report.warnings)


@pytest.mark.parametrize(
    ("name", "kind", "value"),
    [
        ("radius", "float2[]", Vt.Vec2fArray([Gf.Vec2f(0, 1)])),
        ("radius", "string", "big"),
        ("radius", "double", float("nan")),
        ("radius", "double", -1.0),
        ("height", "double", float("inf")),
        ("axis", "token", "W"),
    ],
)
def test_a_body_without_a_size_or_an_axis_is_left_out_with_a_word(
    stage: Usd.Stage, name: str, kind: str, value: object
):
    add_sheet(stage, CLOTH)
    stage.DefinePrim("/World/post", "Capsule").AddAppliedSchema(COLLIDER_API)
    retype(stage, f"/World/post.{name}", kind, value)
    shot = open_shot(save(stage))
    assert shot.frame(1.0).colliders == (None,)
    assert any("left out here: its sizes or its axis" in notice.message for notice in shot.warnings)


@pytest.fixture
def dressed(tmp_path: Path) -> Usd.Stage:
    stage = make_shot(tmp_path / "shot.usda")
    dress_up(stage)
    return stage


def written(stage: Usd.Stage, tmp_path: Path) -> list[str]:
    """Faults of the layer written for a stage; it is saved first."""
    shot = Path(save(stage))
    out = write_layer(shot, tmp_path / "out.usdc")
    return errors(out, shot)


class TestWritten:
    """What cannot be refined is hidden or left alone, and the layer is valid."""

    def test_a_partition_that_is_none_in_the_shot_is_told_not_refused(self, dressed: Usd.Stage, tmp_path: Path):
        UsdGeom.Subset.Get(dressed, f"{COAT}/back").GetIndicesAttr().Set(Vt.IntArray([8, 9]))
        assert written(dressed, tmp_path) == []
        told = [str(problem) for problem in validate_layer(tmp_path / "out.usdc", tmp_path / "shot.usda")]
        assert any("is a partition, but names" in line and "so it is in the shot" in line for line in told)

    @pytest.mark.parametrize("mode", ["over", "sibling"])
    def test_a_family_of_faces_that_are_left_out(self, dressed: Usd.Stage, tmp_path: Path, mode: str):
        mesh = UsdGeom.Mesh(dressed.GetPrimAtPath(COAT))
        mesh.GetFaceVertexCountsAttr().Set([2, 4])
        mesh.GetFaceVertexIndicesAttr().Set([0, 1, 5, 6, 11, 10])
        dressed.RemovePrim(f"{COAT}/back")
        UsdGeom.Subset.Get(dressed, f"{COAT}/front").GetIndicesAttr().Set([0])
        UsdGeom.Subset.SetFamilyType(UsdGeom.Imageable(mesh), "materialBind", "nonOverlapping")
        shot = Path(save(dressed))
        assert errors(write_layer(shot, tmp_path / "out.usdc", mode=mode), shot) == []


def test_a_subset_whose_family_is_no_name_is_of_none(tmp_path: Path):
    stage = Usd.Stage.Open(sheet_shot(tmp_path / "s.usda"))
    subset = UsdGeom.Subset.Define(stage, "/World/cloth/trim")
    subset.CreateIndicesAttr([0])
    retype(stage, "/World/cloth/trim.familyName", "float", 1.0)
    refine(Path(save(stage)), tmp_path / "fine.usda")
    assert not errors(tmp_path / "fine.usda", tmp_path / "s.usda")


def test_texture_coordinates_that_are_not_finite_give_no_grain(tmp_path: Path):
    stage = Usd.Stage.Open(sheet_shot(tmp_path / "s.usda"))
    uv = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/cloth")).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex"
    )
    uv.Set(Vt.Vec2fArray([(float("inf"), 0.0)] * 20))
    with closing(open_shot(save(stage))) as shot:
        assert shot.sources[0].sources["grain"] == "the rest shape, downwards"


def test_a_reference_to_a_name_with_a_null_byte_is_told(tmp_path: Path):
    shot = Path(sheet_shot(tmp_path / "s.usda"))
    text = shot.read_text().replace('def Xform "World"', 'def Xform "World" (prepend references = @./a\0b.usda@)', 1)
    shot.write_text(text)
    with pytest.raises(StageError, match="Could not open asset"):
        refine(shot, tmp_path / "fine.usda")


def skinned_with_points(path: Path, kind: str, value: object, *, blend: bool) -> str:
    """A sheet on a skeleton, with a blend shape if wanted, whose points are a value of another type."""
    stage, offsets = new_stage(path), 0.1 * np.ones_like(sheet_points())
    add_skeleton(stage, "/World/rig", (1.0, 2.0), blend=blend)
    mesh = add_sheet(stage, "/World/rig/cloth", times=())
    bind_skin(mesh, "/World/rig", joints=[0] * len(offsets), blend=offsets if blend else None)
    retype(stage, "/World/rig/cloth.points", kind, value)
    return save(stage)


@pytest.mark.parametrize("blend", [False, True], ids=["joints", "shape"])
def test_points_in_double_precision_are_not_skinned_with_a_word(tmp_path: Path, blend: bool):
    value = Vt.Vec3dArray.FromNumpy(sheet_points().astype(np.float64))
    with closing(open_shot(skinned_with_points(tmp_path / "s.usda", "double3[]", value, blend=blend))) as shot:
        assert "</World/rig/cloth>: is not skinned and stays in its bind pose, because its points are of" in said(shot)
        np.testing.assert_array_equal(shot.frame(None).garments[0].points, sheet_points())


@pytest.mark.parametrize("kind", ["float", "matrix4d", "string[]"])
@pytest.mark.parametrize("blend", [False, True], ids=["joints", "shape"])
def test_points_of_a_skinned_mesh_that_are_no_positions_are_refused_by_type(tmp_path: Path, kind: str, blend: bool):
    shot = skinned_with_points(tmp_path / "s.usda", kind, VALUES[kind], blend=blend)
    with pytest.raises(GarmentError, match=r"</World/rig/cloth>.*points is a .*author point3f\[\]"):
        open_shot(shot)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("points", "float"), ("points", "string[]"), ("uVertexCount", "string"), ("vVertexCount", "int[]")],
)
def test_a_surface_that_is_not_read_may_have_values_of_another_type(
    stage: Usd.Stage, tmp_path: Path, name: str, kind: str
):
    add_sheet(stage, CLOTH)
    patch = UsdGeom.NurbsPatch.Define(stage, "/World/patch")
    patch.CreatePointsAttr(vec3(sheet_points()))
    patch.CreateUVertexCountAttr(5)
    patch.CreateVVertexCountAttr(4)
    retype(stage, f"/World/patch.{name}", kind, VALUES[kind])
    report = refine(Path(save(stage)), tmp_path / "fine.usdc", level=1, steps=1)
    assert not report.failed


def test_a_transform_in_units_that_are_no_length_overflows_no_volume(tmp_path: Path):
    """Warnings are errors in tests, and NumPy warns of a determinant that overflows."""
    stage = new_stage(tmp_path / "s.usda", metres=1e300)
    add_sheet(stage, CLOTH)
    assert [mesh.path for mesh in survey(save(stage)).meshes] == [CLOTH]
