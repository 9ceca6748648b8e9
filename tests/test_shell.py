"""A shell written in place of a refined sheet is closed, as thick as asked, and carries the sheet's data."""

from pathlib import Path

import numpy as np
import pytest
from layers import COAT, dress_up, errors, make_shot, open_over
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from shots import CLOTH, EDGE, cloth_shot, refine

from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.usd.mesh.shell import Shell

THICKNESS = 2e-3
LATE = 4.0


def shelled(path: Path, thickness: float = THICKNESS) -> Path:
    stage = Usd.Stage.Open(str(path))
    attribute = stage.GetPrimAtPath(CLOTH).CreateAttribute("physgraph:shell:thickness", Sdf.ValueTypeNames.Float)
    attribute.Set(thickness)
    stage.Save()
    return path


def polygons(stage: Usd.Stage) -> tuple[PolygonMesh, np.ndarray]:
    """Faces and late positions of the refined cloth."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH))
    points = np.asarray(mesh.GetPointsAttr().Get(LATE), float)
    counts, indices = np.asarray(mesh.GetFaceVertexCountsAttr().Get()), mesh.GetFaceVertexIndicesAttr().Get()
    return PolygonMesh(counts, np.asarray(indices), len(points)), points


def volume(mesh: PolygonMesh, points: np.ndarray) -> float:
    """Signed volume inside a closed mesh, above zero where faces turn counterclockwise seen from outside."""
    a, b, c = points[mesh.triangulate(points).triangles].swapaxes(0, 1)
    return float(np.einsum("tx,tx->", a, np.cross(b, c)) / 6.0)


@pytest.mark.parametrize("how", ["plain", "mirrored", "left-handed"])
def test_it_is_closed_and_as_thick_as_asked(tmp_path: Path, how: str):
    shot = cloth_shot(tmp_path / "shot.usda")
    stage = Usd.Stage.Open(str(shot))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH))
    if how == "mirrored":
        mesh.AddTransformOp().Set(Gf.Matrix4d().SetScale(Gf.Vec3d(-1, 1, 1)))
    elif how == "left-handed":
        mesh.CreateOrientationAttr("leftHanded")
    stage.Save()
    refine(shot, tmp_path / "sheet.usda")
    refine(shelled(shot), tmp_path / "shell.usda")
    shell, points = polygons(open_over(shot, tmp_path / "shell.usda"))
    outer, inner = np.split(points, 2)
    np.testing.assert_allclose(EDGE * np.linalg.norm(outer - inner, axis=1), THICKNESS, rtol=1e-4)
    _, middle = polygons(open_over(shot, tmp_path / "sheet.usda"))
    np.testing.assert_allclose(0.5 * (outer + inner), middle, atol=1e-6)
    sides = np.stack([shell.indices, shell.indices[shell.next_corner]], axis=1)
    assert len(np.unique(sides, axis=0)) == len(sides)
    assert {*map(tuple, sides.tolist())} == {*map(tuple, sides[:, ::-1].tolist())}
    assert (volume(shell, points) > 0.0) == (how != "left-handed")
    assert not errors(tmp_path / "shell.usda", shot)


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_normals_of_its_polygons_point_outwards(tmp_path: Path, orientation: str):
    shot = cloth_shot(tmp_path / "shot.usda")
    stage = Usd.Stage.Open(str(shot))
    UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).CreateOrientationAttr(orientation)
    stage.Save()
    refine(shelled(shot), tmp_path / "shell.usda", scheme="none")
    stage = open_over(shot, tmp_path / "shell.usda")
    normals = np.asarray(UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetNormalsAttr().Get(LATE))
    outer, inner = np.split(polygons(stage)[1], 2)
    outwards = np.concatenate([outer - inner, inner - outer])
    assert np.einsum("vx,vx->v", normals, outwards).min() > 0.0


def test_uvs_and_subsets_are_the_sheets_on_both_sides_and_on_the_rims(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usda")
    stage = Usd.Stage.Open(str(shot))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH))
    corners = np.asarray(mesh.GetFaceVertexIndicesAttr().Get())
    points = np.asarray(mesh.GetPointsAttr().Get(Usd.TimeCode.Default()))
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    st.Set(Vt.Vec2fArray.FromNumpy(points[corners, :2].astype(np.float32)))
    UsdGeom.Subset.CreateGeomSubset(mesh, "half", "face", Vt.IntArray([0, 1, 2]))
    stage.Save()
    refine(shelled(shot), tmp_path / "shell.usda")
    stage = open_over(shot, tmp_path / "shell.usda")
    made, (shell, _) = stage.GetPrimAtPath(CLOTH), polygons(stage)
    uv = np.asarray(UsdGeom.PrimvarsAPI(made).GetPrimvar("st").ComputeFlattened())
    assert len(uv) == len(shell.indices)
    by_vertex: dict[int, set[tuple[float, ...]]] = {}
    for vertex, value in zip(shell.indices % (shell.vertex_count // 2), uv.round(5).tolist(), strict=True):
        by_vertex.setdefault(int(vertex), set()).add(tuple(value))
    assert {len(values) for values in by_vertex.values()} == {1}
    half = UsdGeom.Subset(made.GetChild("half")).GetIndicesAttr().Get()
    sheet = (shell.face_count - 2 * sum(np.array([6, 4]) * 2)) // 2
    assert sum(face < sheet for face in half) == sum(sheet <= face < 2 * sheet for face in half) == 12
    assert sum(face >= 2 * sheet for face in half) > 0


def test_seams_of_a_welded_mesh_have_no_rim():
    """Two squares side by side whose common edge is doubled: six open edges remain."""
    sheet = PolygonMesh(np.array([4, 4]), np.array([0, 1, 2, 3, 4, 5, 6, 7]), 8)
    welded = np.array([0, 1, 2, 3, 1, 4, 5, 2])
    assert Shell.of(sheet, welded).mesh.face_count == 2 * 2 + 6
    assert Shell.of(sheet, np.arange(8)).mesh.face_count == 2 * 2 + 8


def test_every_kind_of_primvar_fits_the_shell(tmp_path: Path):
    shot = tmp_path / "shot.usda"
    stage = make_shot(shot)
    dress_up(stage)
    stage.GetPrimAtPath(COAT).CreateAttribute("physgraph:shell:thickness", Sdf.ValueTypeNames.Float).Set(THICKNESS)
    stage.Save()
    refine(shot, tmp_path / "out.usda")
    assert not errors(tmp_path / "out.usda", shot)
