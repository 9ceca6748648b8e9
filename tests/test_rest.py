"""Where the rest shape comes from, in which size, and when it is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, UsdGeom
from stages import add_sheet, affine, author, new_stage, save, set_matrix, sheet_points, vec3

from physgraph_usd.errors import GarmentError
from physgraph_usd.usd.read.reader import Shot, open_shot

FLAT = sheet_points() * [1.0, 1.0, 0.0]


def source(shot: Shot) -> str:
    return shot.sources[0].sources["rest"]


def primvar(mesh: UsdGeom.Mesh, name: str, values: np.ndarray) -> UsdGeom.Primvar:
    made = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, Sdf.ValueTypeNames.Point3fArray, "vertex")
    made.Set(vec3(values))
    return made


def test_the_order_of_rest_shapes_from_weakest_to_strongest(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda")
    mesh = add_sheet(stage, default=False, times=(5.0, 6.0))

    def rest(**options) -> tuple[str, np.ndarray]:
        shot = open_shot(save(stage), **options)
        return source(shot), shot.scene.garments[0].rest

    name, points = rest()
    assert name == "fitted to the shot: median edge lengths of 2 time codes, from the points at 5"
    np.testing.assert_array_equal(rest(frames=(6.0, 6.0))[1], points)
    mesh.GetPointsAttr().Set(vec3(sheet_points()))
    name, points = rest()
    assert name == "default points"
    np.testing.assert_allclose(points, sheet_points())
    for number, attribute in enumerate(("Pref", "rest"), start=1):
        primvar(mesh, attribute, FLAT * (1 + 0.1 * number))
        name, points = rest()
        assert name == f"</World/cloth>.primvars:{attribute}"
        np.testing.assert_allclose(points, FLAT * (1 + 0.1 * number), rtol=1e-6)
    author(mesh.GetPrim(), "physics:restShapePoints", vec3(FLAT), kind="point3f[]")
    name, points = rest()
    assert name == "</World/cloth>.physics:restShapePoints"
    np.testing.assert_allclose(points, FLAT)
    name, points = rest(rest_frame=6.0)
    assert name == "points at time code 6 (--rest)"
    np.testing.assert_allclose(points, sheet_points(6.0))


def test_the_rest_shape_has_the_size_that_the_cloth_has_in_the_world(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda", metres=0.01)
    matrix = affine(np.diag([2.0, 1.0, 0.5]), (7, 0, 0))
    set_matrix(stage.GetPrimAtPath("/World"), matrix, 1.0)
    add_sheet(stage)
    expected = 0.01 * (sheet_points() @ matrix[:3, :3].T + matrix[:3, 3])
    np.testing.assert_allclose(open_shot(save(stage)).scene.garments[0].rest, expected, atol=1e-9)


def test_s16_a_rest_shape_of_another_topology_is_refused(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda")
    primvar(add_sheet(stage), "rest", FLAT[:-1])
    with pytest.raises(GarmentError, match=r"</World/cloth>: primvars:rest has 19 values, the mesh has 20 points; "):
        open_shot(save(stage))


@pytest.mark.parametrize("where", ["rest", "default"])
def test_s16_a_rest_edge_without_length_is_told_with_its_indices(tmp_path: Path, where: str) -> None:
    stage = new_stage(tmp_path / "s.usda")
    mesh, points = add_sheet(stage), FLAT.copy()
    points[6] = points[7]
    if where == "rest":
        primvar(mesh, "rest", points)
    else:
        mesh.GetPointsAttr().Set(vec3(points))
    said = [str(notice) for notice in open_shot(save(stage)).warnings]
    assert any("</World/cloth>: 1 edge has no length in" in each and "points[6] and points[7]" in each for each in said)


def test_a_rest_shape_that_is_not_finite_is_refused_with_its_index(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda")
    points = FLAT.copy()
    points[4, 1] = np.nan
    primvar(add_sheet(stage), "Pref", points)
    with pytest.raises(GarmentError, match=r"</World/cloth>.primvars:Pref\[4\] is NaN"):
        open_shot(save(stage))


def test_a_rest_shape_of_another_size_is_told(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda")
    primvar(add_sheet(stage), "rest", 100 * FLAT)
    assert any("times as long as the animation's" in notice.message for notice in open_shot(save(stage)).warnings)


@pytest.mark.parametrize(
    ("value", "bent", "renamed"),
    [
        ("restShape", True, None),
        ("restShapeDefault", True, "restShape"),
        (None, False, None),
    ],
)
def test_hinges_rest_flat_or_bent(tmp_path: Path, value: str | None, bent: bool, renamed: str | None) -> None:
    stage = new_stage(tmp_path / "s.usda")
    mesh = add_sheet(stage)
    if value:
        author(mesh.GetPrim(), "physics:restBendAnglesDefault", value, kind="token")
    shot = open_shot(save(stage))
    assert shot.scene.garments[0].bent_rest == bent
    told = [notice for notice in shot.warnings if "restBendAnglesDefault" in notice.message]
    assert [(notice.path, f"author {renamed!r}" in notice.message) for notice in told] == (
        [(str(mesh.GetPath()), True)] if renamed else []
    )
