"""Who gives a fabric value: --set, the prim, its ancestors, the bound materials, the fallback."""

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade
from stages import add_sheet, author, new_stage

from physgraph_usd.errors import SchemaError, UsageError
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.usd.lookup import check_overrides, parse_overrides
from physgraph_usd.usd.read.materials import Values, find_values
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.stage import read_units

BEND = "physgraph:material:bendStiffness"


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    made = new_stage(tmp_path / "s.usda", metres=0.01)
    UsdPhysics.SetStageKilogramsPerUnit(made, 0.001)
    add_sheet(made, "/World/rig/cloth")
    return made


def cloth(stage: Usd.Stage) -> Usd.Prim:
    return stage.GetPrimAtPath("/World/rig/cloth")


def bind(stage: Usd.Stage, name: str, purpose: str = "") -> Usd.Prim:
    material = UsdShade.Material.Define(stage, f"/World/{name}")
    binding = UsdShade.MaterialBindingAPI.Apply(cloth(stage))
    binding.Bind(material, materialPurpose=purpose or UsdShade.Tokens.allPurpose)
    return material.GetPrim()


def values(stage: Usd.Stage, *overrides: str) -> Values:
    return find_values(cloth(stage), read_units(stage)[0], parse_overrides(overrides))


def test_the_order_of_sources_from_weakest_to_strongest(stage: Usd.Stage) -> None:
    def bend(*overrides: str) -> tuple[float, str]:
        found = values(stage, *overrides).found["bendStiffness"]
        return round(float(found.at(None) or 0.0), 9), found.source

    assert bend() == (PRESETS["jersey"].bend, "fallback")
    shade = bind(stage, "shade")
    author(shade, "physics:surfaceBendStiffness", 1e7)
    assert bend() == (1.0, "</World/shade>.physics:surfaceBendStiffness")
    author(shade, BEND, 1e-5)
    assert bend() == (1e-5, f"</World/shade>.{BEND}")
    author(bind(stage, "physical", "physics"), BEND, 2e-5)
    assert bend() == (2e-5, f"</World/physical>.{BEND}")
    author(stage.GetPrimAtPath("/World"), BEND, 3e-5)
    author(stage.GetPrimAtPath("/World/rig"), BEND, 4e-5)
    assert bend() == (4e-5, f"</World/rig>.{BEND}")
    author(cloth(stage), BEND, 5e-5)
    assert bend() == (5e-5, f"</World/rig/cloth>.{BEND}")
    assert bend("bendStiffness=6e-5") == (6e-5, "--set")
    assert bend("</World/rig>.bendStiffness=7e-5", "bendStiffness=6e-5") == (7e-5, "--set")
    assert bend("/World/rig/cloth.physgraph:material:bendStiffness=8e-5", "</World>.bendStiffness=1")[0] == 8e-5
    assert bend("bendStiffness=1e-5", "bendStiffness=9e-5")[0] == 9e-5


def test_values_of_the_physics_proposal_are_converted_from_stage_units(stage: Usd.Stage) -> None:
    material = bind(stage, "m", "physics")
    m, kilograms = 0.01, 0.001
    author(material, "physics:surfaceStretchStiffness", 30.0 / kilograms)
    author(material, "physics:surfaceShearStiffness", 10.0 / kilograms)
    author(material, "physics:surfaceBendStiffness", 4e-6 / (kilograms * m**2))
    author(material, "physics:density", 200.0 * m**3 / kilograms)
    author(material, "physgraph:material:thickness", 0.002)
    fabric = values(stage).fabric(None)
    found = [fabric.stretch, fabric.shear, fabric.bend, fabric.density, fabric.thickness]
    np.testing.assert_allclose(found, [30.0, 10.0, 4e-6, 200.0 * 0.002, 0.002], rtol=1e-5)


@pytest.mark.parametrize("kind", ["int", "half", "float", "double", "int64", "uchar", "bool"])
def test_any_numeric_type_is_read(stage: Usd.Stage, kind: str) -> None:
    author(stage.GetPrimAtPath("/World/rig"), "physgraph:material:stretchStiffness", 1, kind=kind)
    assert values(stage).fabric(None).stretch == 1.0


def test_what_blender_exports_is_found(stage: Usd.Stage) -> None:
    author(stage.GetPrimAtPath("/World/rig"), f"userProperties:{BEND}", 5e-6, kind="double")
    assert values(stage).fabric(None).bend == 5e-6


@pytest.mark.parametrize(("kind", "value"), [("string", "soft"), ("float2", (1, 2)), ("float[]", [1.0])])
def test_what_is_no_number_is_refused_by_name(stage: Usd.Stage, kind: str, value: object) -> None:
    author(stage.GetPrimAtPath("/World/rig"), BEND, value, kind=kind)
    with pytest.raises(SchemaError, match=re.escape(f"</World/rig>.{BEND}") + ".*single number"):
        values(stage).fabric(None)


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_what_is_out_of_limits_is_refused_by_name(stage: Usd.Stage, value: float) -> None:
    author(cloth(stage), BEND, value)
    with pytest.raises(SchemaError, match=r"must be finite and in \[0, 100000\] N m"):
        values(stage).fabric(None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bendStiffness", "cannot read 'bendStiffness'"),
        (
            "bendStifness=1",
            "unknown attribute 'bendStifness'; did you mean bendStiffness\\? known attributes: backstop, ",
        ),
        ("physgraph:material:bendingStiffness=1", "did you mean bendStiffness"),
        (
            "stiffness=4",
            "may mean stretchStiffness, weftStretchStiffness, shearStiffness, bendStiffness, weftBendStiffness",
        ),
        ("offset=0.1", "may mean contact:offset, collider:offset; write one"),
        (
            "contact:layer=2",
            "physgraph:contact:layer is no attribute any more: the order of layers is found .*leave it",
        ),
        ("</World/rig/cloth>.physgraph:contact:layer=2", "is no attribute any more"),
        ("layer=2", "is no attribute any more"),
        ("side=left", "must be one of auto, winding, start, front, back"),
        ("bendStiffness=soft", "cannot use"),
        ("bendStiffness=-1", r"must be finite and in \[0, 100000\]"),
        ("level=1.5", "whole number"),
        ("colliders=/World", "not a single number"),
        ("gather=0.3", "it is in percent; write gather=30 for 0.3 times the length"),
        ("gather=500", r"must be finite and in \[-50, 400\] %"),
        ("</World.bendStiffness=1", "cannot read|unknown|no such garment"),
    ],
)
def test_overrides_that_cannot_be_used_say_why(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        check_overrides(parse_overrides([text]), [])


def told(stage: Usd.Stage) -> list[str]:
    stage.GetRootLayer().Save()
    with contextlib.closing(open_shot(stage.GetRootLayer().realPath)) as shot:
        return [str(notice) for notice in shot.warnings]


def test_misspelt_attributes_are_named_with_the_nearest_that_exists(stage: Usd.Stage) -> None:
    assert told(stage) == []
    material = bind(stage, "m")
    author(material, "physgraph:material:bendingStiffness", 1.0)
    author(cloth(stage), "physgraph:guide:stifness", 1.0)
    author(stage.GetPrimAtPath("/World"), "userProperties:physgraph:material:densty", 1.0)
    author(cloth(stage), "primvars:physgraph:bendscale", [1.0], kind="float[]")
    author(cloth(stage), "physgraph:colour", 1.0)
    ball = UsdGeom.Sphere.Define(stage, "/World/ball").GetPrim()
    ball.AddAppliedSchema("PhysGraphColliderAPI")
    author(ball, "physgraph:collider:offsets", 0.01)
    said = "is no attribute that refining reads;"
    assert sorted(told(stage)) == [
        f"</World/ball>: physgraph:collider:offsets {said} did you mean physgraph:collider:offset?",
        f"</World/m>: physgraph:material:bendingStiffness {said} did you mean physgraph:material:bendStiffness?",
        f"</World/rig/cloth>: physgraph:colour {said} docs/attributes.md lists all",
        f"</World/rig/cloth>: physgraph:guide:stifness {said} did you mean physgraph:guide:stiffness?",
        f"</World/rig/cloth>: primvars:physgraph:bendscale {said} did you mean primvars:physgraph:bendScale?",
        f"</World>: userProperties:physgraph:material:densty {said} did you mean physgraph:material:density?",
    ]


@pytest.mark.parametrize("name", ["physgraph:contact:layer", "userProperties:physgraph:contact:layer"])
def test_a_retired_attribute_is_told_with_what_replaced_it(stage: Usd.Stage, name: str) -> None:
    author(cloth(stage), name, 1, kind="int")
    instead = "the order of layers is found in the animation, not authored; it can be removed"
    assert told(stage) == [f"</World/rig/cloth>: {name} is no attribute any more: {instead}"]


def test_a_connection_is_followed_one_step(stage: Usd.Stage) -> None:
    material = bind(stage, "m")
    shared = author(material, "inputs:bend", 3e-5)
    density = author(material, "inputs:weight", 0.4)
    author(material, BEND, 1e-5).SetConnections([shared.GetPath()])
    material.CreateAttribute("physgraph:material:density", Sdf.ValueTypeNames.Float).SetConnections([density.GetPath()])
    found = values(stage)
    assert found.found["bendStiffness"].source == "</World/m>.inputs:bend"
    fabric = found.fabric(None)
    assert (fabric.bend, fabric.density) == (pytest.approx(3e-5), pytest.approx(0.4))
    assert told(stage) == []
