"""Values of the wrong type or size, as `python -m tests.fuzz` found them: told or refused, never a traceback."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from fuzz.damage import replace
from layers import COAT, dress_up, errors, make_shot, write_layer
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, Vt
from stages import COLLIDER_API, add_sheet, author, new_stage, save, sheet_shot

from physgraph_usd.errors import GarmentError, LayerError, PhysGraphError, SchemaError, StageError
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.usd.check.validate import validate_layer
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.stage import LONGEST_REASON, in_brief, pxr_errors, read_units
from physgraph_usd.usd.write.primvars import to_numpy

CLOTH = "/World/cloth"


def retype(stage: Usd.Stage, path: str, kind: str, value: object) -> None:
    """Author an attribute with another type than its schema's."""
    replace(stage, Sdf.Path(path), kind, value)


class TestGravity:
    @pytest.mark.parametrize(
        ("name", "kind", "value"),
        [
            ("gravityMagnitude", "float3", Gf.Vec3f(1, 2, 3)),
            ("gravityMagnitude", "asset", Sdf.AssetPath("x")),
            ("gravityMagnitude", "float", float("nan")),
            ("gravityMagnitude", "float", float("inf")),
            ("gravityDirection", "timecode", Sdf.TimeCode(1.0)),
            ("gravityDirection", "vector3f", Gf.Vec3f(float("nan"), 0, 0)),
        ],
    )
    def test_what_is_none_is_told_and_the_earth_s_taken(self, tmp_path: Path, name: str, kind: str, value: object):
        stage = new_stage(tmp_path / "s.usda")
        UsdPhysics.Scene.Define(stage, "/World/physics")
        retype(stage, f"/World/physics.physics:{name}", kind, value)
        units, notices = read_units(stage)
        np.testing.assert_allclose(units.gravity, [0.0, -9.81, 0.0])
        assert [notice.path for notice in notices if name in notice.message] == ["/World/physics"]

    def test_a_negative_magnitude_is_the_earth_s_by_definition(self, tmp_path: Path):
        stage = new_stage(tmp_path / "s.usda")
        UsdPhysics.Scene.Define(stage, "/World/physics").CreateGravityMagnitudeAttr(-1.0)
        units, notices = read_units(stage)
        np.testing.assert_allclose(units.gravity, [0.0, -9.81, 0.0])
        assert notices == []


class TestMessages:
    def test_bytes_that_are_no_text_in_a_text_file(self, tmp_path: Path):
        shot = Path(sheet_shot(tmp_path / "s.usda"))
        shot.write_bytes(shot.read_bytes().replace(b"faceVertexCounts", b"face\xff\xfeCounts"))
        with pytest.raises(StageError, match=r"s\.usda"):
            open_shot(str(shot))

    def test_a_mistake_in_a_text_file_is_told_in_short_and_without_names_of_code(self, tmp_path: Path):
        shot = Path(sheet_shot(tmp_path / "s.usda", size=(40, 30)))
        for old, new in (("[(", "[("[:1]), ("point3f[]", "string"), ('"World"', '"World')):
            broken = tmp_path / "broken.usda"
            broken.write_text(shot.read_text().replace(old, new, 1))
            with pytest.raises(StageError, match=r"broken\.usda") as caught:
                open_shot(str(broken))
            assert "pxrInternal" not in str(caught.value)
            assert len(str(caught.value)) < 6 * LONGEST_REASON

    def test_the_place_of_a_mistake_is_kept(self):
        said = "a.usda:42:5: parse error matching pxrInternal::Sdf::List<one<'x'>> at 'rate = 24' in </A>"
        assert in_brief(said) == "a.usda:42:5: parse error at 'rate = 24' in </A>"

    def test_a_matrix_for_a_number_is_told_on_one_line(self, tmp_path: Path):
        stage = new_stage(tmp_path / "s.usda")
        mesh = add_sheet(stage, CLOTH)
        retype(stage, f"{mesh.GetPath()}.physgraph:material:density", "matrix4d", Gf.Matrix4d(1.0))
        with pytest.raises(SchemaError, match="a single number is needed") as caught:
            open_shot(save(stage)).frame(1.0)
        assert "\n" not in str(caught.value)

    def test_errors_of_usd_become_the_kind_that_was_asked_for(self):
        with pytest.raises(LayerError, match="cannot read x"), pxr_errors("cannot read x", LayerError):
            Tf.RaiseRuntimeError("broken")


@pytest.mark.parametrize("name", ["physics:restShapePoints", "primvars:rest", "primvars:Pref"])
@pytest.mark.parametrize(("kind", "value"), [("float", 0.5), ("asset", Sdf.AssetPath("x")), ("int", 3)])
def test_a_rest_shape_that_is_no_array_is_refused_by_name(tmp_path: Path, name: str, kind: str, value: object):
    stage = new_stage(tmp_path / "s.usda")
    add_sheet(stage, CLOTH)
    retype(stage, f"{CLOTH}.{name}", kind, value)
    with pytest.raises(GarmentError, match=f"<{CLOTH}>.*{name}.*not an array of positions"):
        open_shot(save(stage))


class TestPlacement:
    @pytest.mark.parametrize("scale", [1e150, 1e-150])
    def test_a_scale_that_is_no_length_is_refused(self, tmp_path: Path, scale: float):
        stage = new_stage(tmp_path / "s.usda")
        matrix = Gf.Matrix4d(1.0).SetScale(scale)
        add_sheet(stage, CLOTH, times=(1.0,), size=(3, 2)).AddTransformOp().Set(matrix)
        with pytest.raises(GarmentError, match=f"scales by {scale:.3g}".replace("+", r"\+")):
            open_shot(save(stage))

    def test_infinite_default_points_are_repaired_with_a_word(self, tmp_path: Path):
        """The product with the placement warned: infinity times zero."""
        stage = new_stage(tmp_path / "s.usda")
        points = add_sheet(stage, CLOTH, times=(1.0, 2.0), size=(3, 2)).GetPointsAttr()
        broken = np.array(points.Get(1.0))
        broken[3] = np.inf
        points.Set(Vt.Vec3fArray.FromNumpy(broken))
        shot = open_shot(save(stage))
        assert [str(each) for each in shot.warnings if "default points have NaN or infinite" in str(each)]
        assert np.isfinite(shot.scene.garments[0].rest).all()


class TestBodies:
    @pytest.mark.parametrize("kind", ["Plane", "Sphere", "Mesh"])
    def test_a_scale_whose_cube_is_no_number(self, tmp_path: Path, kind: str):
        stage = new_stage(tmp_path / "s.usda")
        add_sheet(stage, CLOTH, times=(1.0,), size=(3, 2))
        if kind == "Mesh":
            add_sheet(stage, "/World/body", times=(1.0,), size=(3, 2), tagged=False)
        body = UsdGeom.Xformable(stage.DefinePrim("/World/body", kind))
        body.GetPrim().AddAppliedSchema(COLLIDER_API)
        author(body.GetPrim(), "physgraph:collider:side", "front")
        body.AddTransformOp().Set(Gf.Matrix4d(1.0).SetScale(1e150))
        pose = open_shot(save(stage)).frame(1.0).colliders[0]
        assert pose is None or not np.isinf(pose.corners()).any()

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
    def test_a_shape_without_a_size_or_an_axis_is_left_out_with_a_word(
        self, tmp_path: Path, name: str, kind: str, value: object
    ):
        stage = new_stage(tmp_path / "s.usda")
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

    @pytest.mark.parametrize(("kind", "value"), [("float3", Gf.Vec3f(0.0)), ("bool", True), ("string", "x")])
    def test_indices_of_another_type(self, dressed: Usd.Stage, tmp_path: Path, kind: str, value: object):
        retype(dressed, f"{COAT}.primvars:st:indices", kind, value)
        assert written(dressed, tmp_path) == []

    @pytest.mark.parametrize("size", [0, -1, 2**30])
    def test_element_sizes_that_are_none(self, dressed: Usd.Stage, tmp_path: Path, size: int):
        dressed.GetPrimAtPath(COAT).GetAttribute("primvars:label").SetMetadata("elementSize", size)
        assert written(dressed, tmp_path) == []

    def test_an_interpolation_that_usd_does_not_know(self, dressed: Usd.Stage, tmp_path: Path):
        dressed.GetPrimAtPath(COAT).GetAttribute("primvars:heat").SetMetadata("interpolation", "nonsense")
        assert written(dressed, tmp_path) == []

    def test_a_painted_value_that_is_one_number(self, dressed: Usd.Stage, tmp_path: Path):
        retype(dressed, f"{COAT}.primvars:physgraph:pin", "int", 0)
        dressed.GetPrimAtPath(COAT).GetAttribute("primvars:physgraph:pin").SetMetadata("interpolation", "vertex")
        with pytest.raises(PhysGraphError, match="primvars:physgraph:pin"):
            written(dressed, tmp_path)

    @pytest.mark.parametrize(
        ("kind", "value"), [("asset", Sdf.AssetPath("x")), ("float[]", Vt.FloatArray([0.5])), ("string", "all")]
    )
    def test_a_subset_without_indices(self, dressed: Usd.Stage, tmp_path: Path, kind: str, value: object):
        retype(dressed, f"{COAT}/front.indices", kind, value)
        assert not [fault for fault in written(dressed, tmp_path) if "TypeMismatch" not in fault]

    def test_a_subset_of_edges_of_odd_number(self, dressed: Usd.Stage, tmp_path: Path):
        subset = UsdGeom.Subset.Define(dressed, f"{COAT}/seam")
        subset.CreateElementTypeAttr().Set("edge")
        subset.CreateIndicesAttr().Set(Vt.IntArray([0, 1, 2]))
        written(dressed, tmp_path)

    @pytest.mark.parametrize(
        ("kind", "value"),
        [
            ("double3[]", Vt.Vec3dArray([Gf.Vec3d(0.0)] * 2)),
            ("string", "soft"),
            ("float", 0.5),
            ("uchar[]", Vt.UCharArray([1])),
        ],
    )
    def test_a_box_of_another_type_is_left_alone(self, dressed: Usd.Stage, tmp_path: Path, kind: str, value: object):
        retype(dressed, "/World.extentsHint", kind, value)
        assert written(dressed, tmp_path) == []

    def test_a_box_under_a_placement_without_an_inverse(self, dressed: Usd.Stage, tmp_path: Path):
        world = dressed.GetPrimAtPath("/World")
        retype(dressed, "/World.extentsHint", "float3[]", Vt.Vec3fArray([Gf.Vec3f(0.0)] * 2))
        UsdGeom.Xformable(world).AddTransformOp().Set(Gf.Matrix4d(0.0))
        UsdGeom.Xformable(dressed.GetPrimAtPath("/World/rig")).SetResetXformStack(True)
        assert written(dressed, tmp_path) == []

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

    def test_subsets_that_overlap_at_one_time_as_the_shot_s_do(self, dressed: Usd.Stage, tmp_path: Path):
        subset = UsdGeom.Subset.Get(dressed, f"{COAT}/back")
        every = Vt.IntArray.FromNumpy(np.arange(12, dtype=np.int32))
        subset.GetIndicesAttr().Set(every, 1.0)
        assert not [fault for fault in written(dressed, tmp_path) if "usdGeomValidators" in fault]


def test_values_that_are_no_array_cannot_be_carried():
    with pytest.raises(ValueError, match="is a int, no array"):
        to_numpy(3)


def test_validating_over_a_shot_that_cannot_be_read_is_a_layer_error(dressed: Usd.Stage, tmp_path: Path):
    out = write_layer(Path(save(dressed)), tmp_path / "out.usdc")
    (tmp_path / "circle.usda").write_text("#usda 1.0\n(\n    subLayers = [@./broken.usda@]\n)\n")
    (tmp_path / "broken.usda").write_text("#usda 1.0\ndef {")
    with pytest.raises(PhysGraphError):
        assert validate_layer(out, tmp_path / "broken.usda")


def test_a_painted_value_that_is_no_array_is_validated(tmp_path: Path):
    """It has one element; counting those of it was a traceback."""
    shot = sheet_shot(tmp_path / "shot.usda")
    stage = Usd.Stage.Open(shot)
    retype(stage, f"{CLOTH}.primvars:physgraph:detailScale", "double", 1.0)
    UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(CLOTH)).GetPrimvar("physgraph:detailScale").SetInterpolation("constant")
    stage.Save()
    refine_shot(shot, tmp_path / "fine.usdc", RefineOptions(level=1, steps=2))
    assert not [each for each in validate_layer(tmp_path / "fine.usdc") if each.severity == "error"]


@pytest.mark.parametrize("count", [1, 2])
def test_a_mesh_without_edges_is_no_traceback(tmp_path: Path, count: int):
    """Faces all of whose corners are one vertex."""
    shot = sheet_shot(tmp_path / "shot.usda")
    stage = Usd.Stage.Open(shot)
    mesh = UsdGeom.Mesh.Get(stage, CLOTH)
    mesh.GetFaceVertexCountsAttr().Set([3] * count)
    mesh.GetFaceVertexIndicesAttr().Set([0] * 3 * count)
    stage.Save()
    with suppress(PhysGraphError):
        refine_shot(shot, tmp_path / "fine.usdc", RefineOptions(level=1, steps=2, dry_run=True))
