"""Painted multipliers and pins, as painters and exporters write them."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from stages import add_sheet, new_stage, save, value_type

from physgraph_usd.errors import GarmentError, SchemaError
from physgraph_usd.usd.read.garment import read_painted
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.schema import GARMENT, PROPERTIES, Property

RAMP = np.linspace(0.0, 1.0, 20)


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    made = new_stage(tmp_path / "s.usda")
    add_sheet(made, "/World/rig/cloth")
    return made


def paint(
    stage: Usd.Stage,
    name: str,
    values: object,
    *,
    how: str = "vertex",
    kind: str = "float[]",
    at: str = "/World/rig/cloth",
) -> UsdGeom.Primvar:
    prim = stage.GetPrimAtPath(at)
    made = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(f"physgraph:{name}", value_type(kind), how)
    made.Set(values)
    return made


def read(stage: Usd.Stage, name: str) -> np.ndarray:
    return read_painted(stage.GetPrimAtPath("/World/rig/cloth"), name, 20)[0]


def test_each_painted_value_reaches_its_own_field(stage: Usd.Stage) -> None:
    fields = {"stretchScale": 2, "bendScale": 3, "guideScale": 4, "detailScale": 5}
    for name, factor in fields.items():
        paint(stage, name, (factor * RAMP).tolist())
    paint(stage, "pin", RAMP.tolist())
    garment = open_shot(save(stage)).scene.garments[0]
    arrays = (garment.stretch_scale, garment.bend_scale, garment.guide_scale, garment.detail_scale)
    for array, factor in zip(arrays, fields.values(), strict=True):
        np.testing.assert_allclose(array, factor * RAMP, rtol=1e-6)
    np.testing.assert_allclose(garment.pin, RAMP, rtol=1e-6)


@pytest.mark.parametrize("at", ["/World/rig/cloth", "/World"])
def test_a_constant_holds_everywhere_and_is_inherited(stage: Usd.Stage, at: str) -> None:
    if at == "/World":
        stage.DefinePrim(at)
    paint(stage, "bendScale", [2.5], how="constant", at=at)
    np.testing.assert_array_equal(read(stage, "bendScale"), np.full(20, 2.5))


def test_set_replaces_a_map_by_one_value_nearest_prim_first(stage: Usd.Stage) -> None:
    paint(stage, "bendScale", RAMP.tolist())
    paint(stage, "stretchScale", RAMP.tolist())
    texts = ["bendScale=3", "/World/rig/cloth.bendScale=2.5"]
    garment = open_shot(save(stage), overrides=texts).scene.garments[0]
    np.testing.assert_array_equal(garment.bend_scale, np.full(20, 2.5))
    np.testing.assert_allclose(garment.stretch_scale, RAMP, rtol=1e-6)


def test_set_gather_acts_at_open_borders(stage: Usd.Stage) -> None:
    """The sheet is a grid of 5 x 4 points, row by row, of which 2 rows of 3 lie inside."""
    paint(stage, "gather", (100.0 * RAMP).tolist())
    garment = open_shot(save(stage), overrides=["/World/rig.gather=30"]).scene.garments[0]
    inside = np.zeros((4, 5), bool)
    inside[1:3, 1:4] = True
    assert garment.grain is not None
    np.testing.assert_allclose(garment.grain.gather, np.where(inside.ravel(), 0.0, 0.3))


def test_set_gather_refuses_cloth_without_borders(stage: Usd.Stage) -> None:
    cloth = UsdGeom.Mesh(stage.GetPrimAtPath("/World/rig/cloth"))
    cloth.GetPointsAttr().Clear()
    cloth.GetPointsAttr().Set([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
    cloth.GetFaceVertexCountsAttr().Set([3, 3, 3, 3])
    cloth.GetFaceVertexIndicesAttr().Set([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3])
    with pytest.raises(GarmentError, match=r"it has none.*paint primvars:physgraph:gather, or set weftEase"):
        open_shot(save(stage), overrides=["gather=30"])


@pytest.mark.parametrize(
    ("values", "how", "message"),
    [
        (RAMP[:-1].tolist(), "vertex", "19 values with vertex interpolation on 20 points"),
        (RAMP[:12].tolist(), "uniform", "12 values with uniform"),
        ([*RAMP[:-1], float("nan")], "vertex", r"bendScale\[19\].* is nan"),
        ([-1.0, *RAMP[1:]], "vertex", r"bendScale\[0\].* is -1; it must be finite and in \[0, 10000\]"),
        ([*RAMP[:-2], 1e24, 0.0], "vertex", r"bendScale\[18\].* is 1e\+24; it must be finite and in \[0, 10000\]"),
        ([1e38], "constant", r"bendScale\[0\].* is 1e\+38"),
    ],
)
def test_values_that_cannot_be_used_are_named(stage: Usd.Stage, values: list[float], how: str, message: str) -> None:
    paint(stage, "bendScale", values, how=how)
    with pytest.raises(SchemaError, match="</World/rig/cloth>.*" + message):
        open_shot(save(stage))


def test_the_name_that_an_exporter_makes_of_a_colon(stage: Usd.Stage) -> None:
    prim = stage.GetPrimAtPath("/World/rig/cloth")
    UsdGeom.PrimvarsAPI(prim).CreatePrimvar("physgraph_pin", value_type("float[]"), "vertex").Set(RAMP.tolist())
    np.testing.assert_allclose(read(stage, "pin"), RAMP, atol=1e-7)


LIMITED = [
    row for row in PROPERTIES if row.schema != "PhysGraphMaterialAPI" and row.type in {"float", "int", "float[]"}
]


def held(row: Property, number: float) -> object:
    """A number as the row's attribute holds it."""
    if row.type == "int":
        return int(number)
    return [float(np.float32(number))] if row.interpolation else float(np.float32(number))


@pytest.mark.parametrize("row", LIMITED, ids=lambda row: row.name)
def test_both_ends_of_each_limit_are_accepted_and_what_is_just_outside_is_named(tmp_path: Path, row: Property) -> None:
    for limit, outwards in ((row.minimum, -np.inf), (row.maximum, np.inf)):
        if limit is None:
            continue
        beyond = np.nextafter(np.float32(limit), np.float32(outwards))
        for number in (limit, limit + np.sign(outwards) if row.type == "int" else beyond):
            stage = new_stage(tmp_path / f"{limit}{number != limit}.usda")
            prim = add_sheet(stage, "/World/rig/cloth").GetPrim()
            if row.short != "pin":  # Cloth that nothing holds is refused as falling.
                pins = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("physgraph:pin", value_type("float[]"), "constant")
                pins.Set([1.0])
            prim = prim if row.name in {each.name for each in GARMENT.values()} else add_body(stage)
            attribute = prim.CreateAttribute(row.name, value_type(row.type))
            attribute.Set(held(row, number))
            if row.interpolation:
                UsdGeom.Primvar(attribute).SetInterpolation("constant")
            if number == limit or (row.short == "pin" and number > limit):
                open_shot(save(stage)).frame(1.0)
                continue
            with pytest.raises(SchemaError, match=f"<{prim.GetPath()}>.{row.name}.*it must be finite and in"):
                open_shot(save(stage)).frame(1.0)


def add_body(stage: Usd.Stage) -> Usd.Prim:
    body = UsdGeom.Sphere.Define(stage, "/World/ball").GetPrim()
    body.AddAppliedSchema("PhysGraphColliderAPI")
    return body
