"""The deformable-body proposal of UsdPhysics: moduli on the material, thickness on the mesh, in stage units."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdPhysics, UsdShade
from stages import add_sheet, author, new_stage, save

from physgraph_usd.errors import SchemaError
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.usd.lookup import parse_overrides
from physgraph_usd.usd.read.materials import Values, find_values
from physgraph_usd.usd.read.reader import Shot, open_shot
from physgraph_usd.usd.stage import read_units

CLOTH, MATERIAL = "/World/cloth", "/World/m"
YOUNGS, NU = 2e6, 0.25
"""In SI."""
UNITS = [(1.0, 1.0), (0.01, 0.001)]
"""Metres and kilograms per unit: SI, and cm with g."""


def cloth(folder: Path, *, metres: float = 1.0, kilograms: float = 1.0) -> Usd.Stage:
    """A sheet with a material bound; no schema of the proposal is installed."""
    stage = new_stage(folder / "s.usda", metres=metres)
    UsdPhysics.SetStageKilogramsPerUnit(stage, kilograms)
    mesh = add_sheet(stage, CLOTH)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(UsdShade.Material.Define(stage, MATERIAL))
    return stage


def on_material(stage: Usd.Stage, **values: float) -> None:
    for name, value in values.items():
        author(stage.GetPrimAtPath(MATERIAL), f"physics:{name}", value)


def thick(stage: Usd.Stage, values: list[float], element: str) -> None:
    author(stage.GetPrimAtPath(CLOTH), "physics:thicknesses", values, kind="float[]")
    author(stage.GetPrimAtPath(CLOTH), "physics:thicknesses:elementType", element, kind="token")


def apply_api(stage: Usd.Stage) -> None:
    schemas = Sdf.TokenListOp.Create(prependedItems=["PhysicsSurfaceDeformableMaterialAPI"])
    stage.GetPrimAtPath(MATERIAL).SetMetadata("apiSchemas", schemas)


def values(stage: Usd.Stage, *overrides: str) -> Values:
    return find_values(stage.GetPrimAtPath(CLOTH), read_units(stage)[0], parse_overrides(overrides))


def fabric(stage: Usd.Stage, *overrides: str) -> list[float]:
    """Stretch, shear, bend, mass per area, thickness in SI."""
    found = values(stage, *overrides).fabric(None)
    shear = np.nan if found.shear is None else found.shear
    return [found.stretch, shear, found.bend, found.density, found.thickness]


def expected(youngs: float, nu: float, h: float, density: float) -> list[float]:
    stretch, bend = youngs * h, youngs * h**3 / (12 * (1 - nu**2))
    return [stretch, youngs / (2 * (1 + nu)) * h, bend, density * h, h]


def opened(stage: Usd.Stage) -> Shot:
    return open_shot(save(stage))


@pytest.mark.parametrize(("metres", "kilograms"), UNITS)
def test_stiffnesses_follow_from_the_moduli_and_the_thickness(tmp_path: Path, metres: float, kilograms: float) -> None:
    stage = cloth(tmp_path, metres=metres, kilograms=kilograms)
    pascal, density = kilograms / metres, kilograms / metres**3
    on_material(stage, youngsModulus=YOUNGS / pascal, poissonsRatio=NU, density=300.0 / density)
    thick(stage, [0.002 / metres], "constant")
    np.testing.assert_allclose(fabric(stage), expected(YOUNGS, NU, 0.002, 300.0), rtol=1e-5)
    sources = values(stage).sources
    assert sources["thickness"] == f"<{CLOTH}>.physics:thicknesses"
    assert sources["density"] == f"<{MATERIAL}>.physics:density"
    assert sources["bendStiffness"] == f"<{MATERIAL}>.physics:youngsModulus, with the thickness"


@pytest.mark.parametrize(("metres", "kilograms"), UNITS)
def test_the_proposals_fallbacks_are_taken_for_its_materials(tmp_path: Path, metres: float, kilograms: float) -> None:
    stage = cloth(tmp_path, metres=metres, kilograms=kilograms)
    assert values(stage).fabric(None) == PRESETS["jersey"]
    apply_api(stage)
    on_material(stage, youngsModulus=-np.inf, surfaceBendStiffness=-np.inf, density=-np.inf)
    np.testing.assert_allclose(fabric(stage), expected(1e6, 0.3, 0.001, 1000.0), rtol=1e-5)
    assert "fallback of physics:youngsModulus" in values(stage).sources["bendStiffness"]
    assert MATERIAL in values(stage).sources["density"]


def test_what_is_ours_wins_and_its_thickness_counts(tmp_path: Path) -> None:
    stage = cloth(tmp_path)
    on_material(stage, youngsModulus=YOUNGS, poissonsRatio=NU, surfaceStretchStiffness=50.0)
    thick(stage, [0.002], "constant")
    assert fabric(stage)[0] == 50.0
    author(stage.GetPrimAtPath(MATERIAL), "physgraph:material:stretchStiffness", 60.0)
    author(stage.GetPrimAtPath("/World"), "physgraph:material:thickness", 0.003)
    found = fabric(stage)
    assert (found[0], found[4]) == (60.0, pytest.approx(0.003))
    assert found[2] == pytest.approx(expected(YOUNGS, NU, 0.003, 1.0)[2])
    assert fabric(stage, "bendStiffness=1e-3")[2] == 1e-3


def test_the_older_thickness_is_read_and_told(tmp_path: Path) -> None:
    stage = cloth(tmp_path, metres=0.01)
    on_material(stage, surfaceThickness=0.2)
    assert fabric(stage)[4] == pytest.approx(0.002)
    (notice,) = [each for each in opened(stage).warnings if "surfaceThickness" in each.message]
    assert notice.path == MATERIAL
    assert f"author physics:thicknesses on <{CLOTH}>" in notice.message
    thick(stage, [0.4], "constant")
    assert fabric(stage)[4] == pytest.approx(0.004)
    assert not [each for each in opened(stage).warnings if "surfaceThickness" in each.message]


@pytest.mark.parametrize("element", ["point", "face"])
def test_stiffness_follows_a_thickness_that_varies(tmp_path: Path, element: str) -> None:
    stage = cloth(tmp_path)
    on_material(stage, youngsModulus=YOUNGS, poissonsRatio=NU)
    count = {"point": 20, "face": 12}[element]
    thick(stage, [0.001] * (count - 1) + [0.002], element)
    shot = opened(stage)
    garment, found = shot.scene.garments[0], values(stage).fabric(None)
    thin, wide = expected(YOUNGS, NU, 0.001, 1.0), expected(YOUNGS, NU, 0.002, 1.0)  # the last point has the last face
    np.testing.assert_allclose(found.stretch * garment.stretch_scale[[0, -1]], [thin[0], wide[0]], rtol=1e-5)
    np.testing.assert_allclose(found.bend * garment.bend_scale[[0, -1]], [thin[2], wide[2]], rtol=1e-5)
    assert [each.path for each in shot.warnings if "from 1 to 2 mm" in each.message] == [CLOTH]
    on_material(stage, surfaceBendStiffness=1e-5)
    assert (opened(stage).scene.garments[0].bend_scale == 1.0).all()


@pytest.mark.parametrize(
    ("values_", "element"), [([0.001, 0.002], "constant"), ([0.001], "point"), ([0.001], ""), ([0.0], "constant")]
)
def test_a_thickness_that_fits_nothing_is_refused_by_name(tmp_path: Path, values_: list[float], element: str) -> None:
    stage = cloth(tmp_path)
    thick(stage, values_, element)
    with pytest.raises(SchemaError, match=rf"<{CLOTH}>\.physics:thicknesses"):
        values(stage)
