"""A stage through Blender's import, edit and export keeps what it says of cloth."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
from blender import NEEDS_BLENDER
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade
from stages import add_sheet, author, new_stage

from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.fabric import PRESETS

ADDON = Path(__file__).parents[1] / "plugins" / "blender"
TRIP = Path(__file__).with_name("blender_round_trip.py")
MATERIAL = "physgraph:material:"

pytestmark = NEEDS_BLENDER


def make_shot(path: Path) -> Path:
    """Coats whose values come from the prim, an ancestor, a material and two of the purpose physics; a body."""
    stage = new_stage(path, metres=0.01)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 0.001)
    for name in ("Denim", "Silk", "Voile"):
        add_sheet(stage, f"/World/{name}Rig/{name}").GetPrim().AddAppliedSchema("PhysGraphGarmentAPI")
    denim, silk, voile = (stage.GetPrimAtPath(f"/World/{name}Rig/{name}") for name in ("Denim", "Silk", "Voile"))
    author(denim, MATERIAL + "bendStiffness", PRESETS["denim"].bend)
    author(denim, "physgraph:refine:level", 1, kind="int")
    author(denim, "physgraph:contact:selfCollision", False, kind="bool")
    author(denim.GetParent(), MATERIAL + "thickness", 0.002)
    for time in (1.0, 2.0):
        author(denim, "physgraph:guide:stiffness", 100.0 * time, time=time)
    look = UsdShade.Material.Define(stage, "/World/Looks/Blue")
    author(look.GetPrim(), MATERIAL + "stretchStiffness", 490.0)
    UsdShade.MaterialBindingAPI.Apply(denim).Bind(look)
    cloth = UsdShade.Material.Define(stage, "/World/Looks/Cloth")
    cloth.GetPrim().AddAppliedSchema("PhysicsSurfaceDeformableMaterialAPI")
    values = {"surfaceStretchStiffness": 100.0 / 1e-3, "surfaceBendStiffness": 1.5e-6 / (1e-3 * 1e-4)}
    for name, value in (values | {"density": 83.0 * 1e-6 / 1e-3}).items():
        author(cloth.GetPrim(), f"physics:{name}", value)
    UsdShade.MaterialBindingAPI.Apply(silk).Bind(cloth, materialPurpose="physics")
    namesake = UsdShade.Material.Define(stage, "/World/VoileRig/Looks/Cloth")
    author(namesake.GetPrim(), "physics:surfaceStretchStiffness", 40.0 / 1e-3)
    author(namesake.GetPrim(), "physics:surfaceBendStiffness", 0.4e-6 / (1e-3 * 1e-4))
    UsdShade.MaterialBindingAPI.Apply(voile).Bind(namesake, materialPurpose="physics")
    body = UsdGeom.Mesh.Define(stage, "/World/Body")
    body.CreatePointsAttr([(0, 0, -90), (100, 0, -90), (0, 100, -90)])
    body.CreateFaceVertexCountsAttr([3])
    body.CreateFaceVertexIndicesAttr([0, 1, 2])
    body.GetPrim().AddAppliedSchema("PhysGraphColliderAPI")
    author(body.GetPrim(), "physgraph:collider:offset", 0.004)
    denim.CreateRelationship("physgraph:colliders", False).SetTargets([body.GetPath()])
    UsdGeom.PrimvarsAPI(silk).CreatePrimvar("physgraph:bendScale", Sdf.ValueTypeNames.FloatArray, "constant").Set([3.0])
    stage.Save()
    return path


def trip(shot: Path, **edits: dict[str, object]) -> tuple[Path, dict[str, Any]]:
    """The file that Blender exports of a shot, and the custom properties that an artist had there."""
    extensions = shot.parent / "extensions" / "user_default"
    extensions.mkdir(parents=True)
    (extensions / "physgraph_usd").symlink_to(ADDON)
    out = shot.with_name("out.usda")
    files = map(str, (TRIP, extensions.parent, shot, out))
    line = [os.environ["PHYSGRAPH_BPY_PYTHON"], *files, json.dumps(edits)]
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
    ran = subprocess.run(line, check=False, capture_output=True, text=True, timeout=100, env=environment)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "Traceback" not in ran.stdout + ran.stderr
    return out, json.loads(Path(f"{out}.json").read_text())


def garments(shot: Path) -> dict[str, dict[str, Any]]:
    """What refining takes for each garment, by the name of its prim."""
    return {garment["path"].rsplit("/", 1)[1]: garment for garment in inspect_shot(shot)["garments"]}


@pytest.fixture(scope="module")
def untouched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, dict[str, Any]]:
    shot = make_shot(tmp_path_factory.mktemp("trip") / "in.usda")
    return shot, *trip(shot)


def test_every_stiffness_is_what_it_was(untouched: tuple[Path, Path, dict[str, Any]]) -> None:
    before, after = garments(untouched[0]), garments(untouched[1])
    assert set(before) == set(after) == {"Denim", "Silk", "Voile"}, "found by their schema, on the export too"
    for name, garment in before.items():
        values = {key: value for key, value in garment["fabric"].items() if value is not None}
        assert {key: after[name]["fabric"][key] for key in values} == pytest.approx(values, rel=1e-5)
        fallbacks = {key for key, source in garment["sources"].items() if source == "fallback"}
        assert {key for key, source in after[name]["sources"].items() if source == "fallback"} == fallbacks
        assert after[name]["level"] == garment["level"]
    bends = [after[name]["fabric"]["bend"] for name in ("Silk", "Voile")]
    assert bends == pytest.approx([1.5e-6, 0.4e-6]), "of two materials of one name"
    assert after["Denim"]["sources"]["stretchStiffness"].endswith(f"{MATERIAL}stretchStiffness")


def test_bodies_samples_and_words_are_kept(untouched: tuple[Path, Path, dict[str, Any]]) -> None:
    stage = Usd.Stage.Open(str(untouched[1]))
    meshes = {prim.GetName(): prim for prim in stage.Traverse() if UsdGeom.Mesh(prim)}
    denim, body = meshes["Denim"], meshes["Body"]
    assert "PhysGraphColliderAPI" in body.GetPrimTypeInfo().GetAppliedAPISchemas()
    assert body.GetAttribute("physgraph:collider:offset").Get() == pytest.approx(0.004)
    assert denim.GetRelationship("physgraph:colliders").GetTargets() == [body.GetPath()]
    assert denim.GetAttribute("physgraph:contact:selfCollision").Get() is False
    guide = denim.GetAttribute("physgraph:guide:stiffness")
    assert [guide.Get(time) for time in guide.GetTimeSamples()] == [100.0, 200.0]
    assert UsdGeom.PrimvarsAPI(meshes["Silk"]).GetPrimvar("physgraph:bendScale").Get() == [3.0]
    assert "physgraph_authored" not in untouched[1].read_text()


def test_the_artist_sees_and_edits_them(tmp_path: Path) -> None:
    edits = {
        "Denim": {MATERIAL + "bendStiffness": 3e-4, MATERIAL + "thickness": None},
        "Silk": {MATERIAL + "bendStiffness": 2e-6},
        "Blue": {MATERIAL + "stretchStiffness": 77.0},
    }
    out, seen = trip(make_shot(tmp_path / "in.usda"), **edits)
    assert seen["Denim"][MATERIAL + "bendStiffness"] == pytest.approx(PRESETS["denim"].bend)
    assert seen["Blue"] == {MATERIAL + "stretchStiffness": 490.0}
    found = garments(out)
    expected = {"bend": 3e-4, "stretch": 77.0, "thickness": PRESETS["jersey"].thickness}
    assert {key: found["Denim"]["fabric"][key] for key in expected} == pytest.approx(expected)
    assert found["Silk"]["fabric"]["bend"] == pytest.approx(2e-6), "the object's own before the material's"
