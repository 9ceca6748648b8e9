"""Arrays that a mesh brings along: rest shapes per corner, numbers of points, those of other schemas, time samples."""

from pathlib import Path

import numpy as np
import pytest
from layers import COAT, dress_up, errors, make_shot, open_over, write_layer, write_shot
from pxr import Sdf, Usd, UsdGeom, Vt
from stages import add_sheet, said, save, sheet_points, vec3

from physgraph_usd.usd.read.reader import open_shot


def per_corner(mesh: UsdGeom.Mesh, *, apart: float) -> None:
    """A rest shape 1.1 times as large, a value per corner, the last one some way apart from its point's others."""
    values = 1.1 * sheet_points()[np.asarray(mesh.GetFaceVertexIndicesAttr().Get())]
    values[5] += np.float32(apart)
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("rest", Sdf.ValueTypeNames.Point3fArray, "faceVarying").Set(vec3(values))


@pytest.mark.parametrize(
    ("apart", "scale", "word"),
    [
        (0.0, 1.1, "; corners of a point agree, so it is the rest shape"),
        (0.1, 1.0, " and differs between corners of points["),
    ],
)
def test_a_rest_shape_per_corner_is_used_where_corners_of_a_point_agree(
    stage: Usd.Stage, apart: float, scale: float, word: str
):
    per_corner(add_sheet(stage), apart=apart)
    shot = open_shot(save(stage))
    np.testing.assert_allclose(shot.scene.garments[0].rest, scale * sheet_points(), rtol=1e-6)
    assert f"primvars:rest is per corner{word}" in said(shot)


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    """A left-handed coat with normals twice, ids, an order per point that is no id, and arrays of another schema."""
    stage = make_shot(tmp_path / "s.usda", orientation="leftHanded")
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    count, corners = len(mesh.GetPointsAttr().Get()), len(mesh.GetFaceVertexIndicesAttr().Get())
    make, types = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar, Sdf.ValueTypeNames
    mesh.CreateNormalsAttr([(0, 0, 1)] * count)
    normals = make("normals", types.Normal3fArray, "faceVarying")
    normals.Set([(0, 0, 1)])
    normals.SetIndices(Vt.IntArray([0] * corners))
    make("id", types.IntArray, "vertex").Set(list(range(count)))
    make("side", types.IntArray, "vertex").Set([point % 2 for point in range(count)])
    points = np.asarray(mesh.GetPointsAttr().Get())[np.asarray(mesh.GetFaceVertexIndicesAttr().Get())]
    make("st", types.TexCoord2fArray, "faceVarying").Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(points[:, :2])))
    mesh.GetPrim().CreateAttribute("other:springs", types.Int2Array).Set([(0, 1), (1, 2)])
    mesh.GetPrim().CreateAttribute("other:places", types.Point3fArray).Set([(0, 0, 0)] * count)
    stage.Save()
    return tmp_path / "s.usda"


def test_an_export_with_everything_twice_is_refined_without_what_no_longer_fits(exported: Path, tmp_path: Path):
    writer = write_shot(open_shot(str(exported), level=1), tmp_path / "fine.usdc")
    notices = "\n".join(map(str, writer.notices))
    for name in ("primvars:id", "other:springs", "other:places"):
        assert f"{name} " in notices
    assert "primvars:side" not in notices
    assert errors(tmp_path / "fine.usdc", exported) == []
    stage = open_over(exported, tmp_path / "fine.usdc")
    found = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(COAT))
    assert [found.GetPrimvar(name).HasAuthoredValue() for name in ("normals", "id", "side")] == [False, False, True]


def test_a_mesh_with_a_sample_of_every_array_in_every_frame_is_refined(tmp_path: Path):
    stage = make_shot(tmp_path / "s.usda")
    dress_up(stage)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(COAT))
    for prim in (mesh.GetPrim(), *mesh.GetPrim().GetChildren()):
        for attribute in prim.GetAuthoredAttributes():
            value = attribute.Get()
            if attribute.GetTypeName().isArray and attribute.GetName() != "points" and value is not None:
                for time in mesh.GetPointsAttr().GetTimeSamples():
                    attribute.Set(value, time)
    stage.Save()
    assert errors(write_layer(tmp_path / "s.usda", tmp_path / "fine.usdc"), tmp_path / "s.usda") == []


def test_negative_time_codes_are_a_range_and_a_prototype_of_instances_is_refined(stage: Usd.Stage, tmp_path: Path):
    crowd = UsdGeom.PointInstancer.Define(stage, "/World/crowd")
    add_sheet(stage, "/World/crowd/protos/coat", times=(-3.0, -2.0, -1.0, 0.0, 1.0))
    crowd.CreatePrototypesRel().SetTargets(["/World/crowd/protos/coat"])
    crowd.CreateProtoIndicesAttr([0, 0])
    crowd.CreatePositionsAttr([(0, 0, 0), (9, 0, 0)])
    shot = open_shot(save(stage), level=1, frames=(-3.0, -1.0))
    assert shot.scene.times == (-3.0, -2.0, -1.0)
    write_shot(shot, tmp_path / "fine.usdc")
    over = open_over(tmp_path / "s.usda", tmp_path / "fine.usdc")
    fine = UsdGeom.Mesh(over.GetPrimAtPath("/World/crowd/protos/coat"))
    assert len(fine.GetPointsAttr().Get(Usd.TimeCode(-2.0))) == 63
