"""The table, the schema files and what USD makes of them agree, in a package of their own too."""

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade
from stages import author, sheet_shot, value_type

from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.usd.lookup import find_value
from physgraph_usd.usd.schema import (
    COLLIDER,
    COLLIDER_API,
    GARMENT,
    GARMENT_API,
    MATERIAL_API,
    PROPERTIES,
    Property,
    register,
    schema_path,
)
from physgraph_usd.usd.schema_files import attribute_table, schema_files
from physgraph_usd.version import __version__

TYPES = {GARMENT_API: UsdGeom.Mesh, COLLIDER_API: UsdGeom.Sphere, MATERIAL_API: UsdShade.Material}


@pytest.fixture(scope="module")
def prims() -> dict[str, Usd.Prim]:
    register()
    stage = Usd.Stage.CreateInMemory()
    made = {schema: kind.Define(stage, f"/{schema}").GetPrim() for schema, kind in TYPES.items()}
    for schema, prim in made.items():
        assert prim.CanApplyAPI(schema), schema
        prim.ApplyAPI(schema)
        assert prim.HasAPI(schema), schema
    made["stage"] = stage  # type: ignore[assignment]  keeps it alive
    return made


@pytest.mark.parametrize("name", ["generatedSchema.usda", "plugInfo.json", "schema.usda"])
def test_committed_files_are_what_the_table_gives(name: str) -> None:
    text = (schema_path() / name).read_text(encoding="utf-8")
    assert text == schema_files()[name], "run python -m physgraph_usd.usd.schema_files"


def test_the_documented_table_is_the_one_in_the_code() -> None:
    text = (Path(__file__).parents[1] / "docs" / "attributes.md").read_text(encoding="utf-8")
    assert attribute_table() in text, "paste what attribute_table() gives"


@pytest.mark.parametrize("row", PROPERTIES, ids=lambda row: f"{row.schema}.{row.name}")
def test_every_row_is_what_the_registered_schema_says(prims: dict[str, Usd.Prim], row: Property) -> None:
    prim = prims[row.schema]
    if row.type == "rel":
        assert prim.GetRelationship(row.name)
        return
    attribute = prim.GetAttribute(row.name)
    assert attribute.GetTypeName() == value_type(row.type)
    assert (attribute.GetVariability() == Sdf.VariabilityUniform) == row.uniform
    assert attribute.GetDocumentation().startswith(row.doc)
    assert not attribute.HasAuthoredValue()
    if row.interpolation:
        assert UsdGeom.Primvar(attribute).GetInterpolation() == row.interpolation
    assert (attribute.GetDisplayName(), attribute.GetDisplayGroup()) == (row.label, row.group)
    said = attribute.GetDocumentation()
    assert ("Default: " in said) == (row.fallback is not None)
    assert (f"Unit: {row.unit}" in said) == bool(row.unit)
    assert row.doc.endswith(".")
    assert said.endswith(".")


GIVERS = {"nobody": (), "a material": ("material",), "an ancestor": ("rig",), "the prim": ("cloth", "rig", "material")}
"""Who authors a value, the one that counts first."""


@pytest.mark.parametrize("givers", GIVERS.values(), ids=GIVERS)
def test_an_editor_shows_what_refining_takes_or_nothing(prims: dict[str, Usd.Prim], givers: tuple[str, ...]) -> None:
    stage = Usd.Stage.CreateInMemory()
    found = {
        "rig": UsdGeom.Xform.Define(stage, "/rig").GetPrim(),
        "cloth": UsdGeom.Mesh.Define(stage, "/rig/cloth").GetPrim(),
    }
    found["material"] = UsdShade.Material.Define(stage, "/m").GetPrim()
    UsdShade.MaterialBindingAPI.Apply(found["cloth"]).Bind(UsdShade.Material(found["material"]))
    for schema in (GARMENT_API, COLLIDER_API):
        found["cloth"].ApplyAPI(schema)
    rows = [
        row
        for row in (*GARMENT.values(), *COLLIDER.values())
        if row.type not in {"rel", "token"} and not row.interpolation
    ]
    for row in rows:
        for value, giver in enumerate(givers):
            author(found[giver], row.name, value != bool(row.fallback) if row.type == "bool" else value + 1.0)
        shown = found["cloth"].GetAttribute(row.name).Get()
        assert shown is None or shown == find_value(found["cloth"], row).at(None), row.name
        assert shown is not None or "cloth" not in givers, row.name


def test_schemas_apply_only_where_they_belong(prims: dict[str, Usd.Prim]) -> None:
    xform = UsdGeom.Xform.Define(prims[GARMENT_API].GetStage(), "/x").GetPrim()
    for schema in TYPES:
        assert not xform.CanApplyAPI(schema)
    assert prims[GARMENT_API].CanApplyAPI(COLLIDER_API)
    assert not prims[COLLIDER_API].CanApplyAPI(GARMENT_API)


UNREGISTERED = """
from pxr import Usd, UsdGeom
stage = Usd.Stage.CreateInMemory()
UsdGeom.Mesh.Define(stage, "/a").GetPrim().GetAttribute("points").HasFallbackValue()
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.schema import register
register()
shot = open_shot({path!r})
prim = shot.stage.GetPrimAtPath("/World/cloth")
assert not prim.HasAPI("PhysGraphGarmentAPI"), "the schema was registered after all"
assert shot.scene.garments[0].level == 2
print(shot.frame(2.0).garments[0].fabric.bend)
"""


def test_garments_are_found_and_read_where_the_schemas_came_too_late(tmp_path: Path) -> None:
    code = UNREGISTERED.format(path=sheet_shot(tmp_path / "s.usda"))
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=Path(__file__).parents[1]
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == PRESETS["jersey"].bend


def test_the_table_needs_no_pxr() -> None:
    code = (
        "import sys; sys.modules['pxr'] = None\nfrom physgraph_usd.usd.schema import schema_path; print(schema_path())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=Path(__file__).parents[1]
    )
    assert done.stdout.strip() == str(schema_path()), done.stderr


ROOT = Path(__file__).parents[1]
LOOK = """
import sys
from pxr import Usd
registry = Usd.SchemaRegistry()
for name in ("PhysGraphGarmentAPI", "PhysGraphColliderAPI", "PhysGraphMaterialAPI"):
    assert registry.FindAppliedAPIPrimDefinition(name), name
garment = registry.FindAppliedAPIPrimDefinition("PhysGraphGarmentAPI")
assert garment.GetPropertyMetadata("physgraph:material:bendStiffness", "displayName") == "Bending Stiffness"
assert "torch" not in sys.modules
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh folder with what the wheel holds."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder]
    subprocess.run(command, check=True, cwd=ROOT / "schemas", capture_output=True)
    (wheel,) = folder.glob("physgraph_usd_schemas-*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "target")
    return folder / "target"


@pytest.mark.parametrize(
    ("imports", "by_environment"),
    [
        ("", True),
        ("import physgraph_usd_schemas", False),
        ("import physgraph_usd_schemas, physgraph_usd", False),
        ("import physgraph_usd, physgraph_usd_schemas", False),
        ("import physgraph_usd, physgraph_usd_schemas", True),
    ],
)
def test_usd_finds_the_schemas_once(installed: Path, tmp_path: Path, imports: str, *, by_environment: bool) -> None:
    paths = [installed, *([ROOT] if "physgraph_usd," in imports or ", physgraph_usd" in imports else [])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))}
    environment.pop("PXR_PLUGINPATH_NAME", None)
    if by_environment:
        environment["PXR_PLUGINPATH_NAME"] = str(installed / "physgraph_usd_schemas")
    done = subprocess.run(
        [sys.executable, "-c", imports + LOOK],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env=environment,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_it_has_the_version_of_the_whole_package() -> None:
    project = tomllib.loads((ROOT / "schemas" / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["version"] == __version__
    assert project["dependencies"] == []
