"""Notes: presets that names propose, with a command that works."""

from __future__ import annotations

import json
import math
import shlex
from dataclasses import asdict
from pathlib import Path

import pytest
from pxr import UsdGeom, UsdShade
from shots import run
from stages import add_sheet, author, new_stage, save

from physgraph_usd.errors import UsageError
from physgraph_usd.shot.findings.drawn import Shown
from physgraph_usd.shot.findings.table import Facts, texts
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.shot.report import RefineReport
from physgraph_usd.solver.fabric import NAMED, PRESETS, WORN
from physgraph_usd.solver.scene import GIVEN_UP
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.schema import GARMENT, fabric_values


def notes(shot: str, *garments: str) -> list[str]:
    return [each for each in inspect_shot(shot, level=0, garments=garments)["notes"] if "named like" in each]


@pytest.mark.parametrize(
    ("prim", "material", "preset"),
    [
        ("/World/LeatherBelt_geo1", "", "leather"),
        ("/World/raincoat/JEANS_low", "", "denim"),
        ("/World/coat/geo", "", "wool"),
        ("/World/cloth", "M_Silk", "silk"),
        ("/World/BeltGirl/char/shirt", "cottage", ""),
        ("/World/Coat", "M_Leather", "leather"),
        ("/World/Scarf", "M_Silk", "silk"),
        ("/World/fleeceHoodie", "", "rib"),
        ("/World/coat", "jersey_mat", ""),
    ],
)
def test_a_preset_is_proposed_by_the_nearest_name_that_says_what_it_is(
    tmp_path: Path, prim: str, material: str, preset: str
):
    stage = new_stage(tmp_path / "s.usda")
    mesh = add_sheet(stage, prim).GetPrim()
    if material:
        bound = UsdShade.Material.Define(stage, f"/World/{material}")
        UsdShade.MaterialBindingAPI.Apply(mesh).Bind(bound)
    said = notes(save(stage))
    assert len(said) == bool(preset)
    assert all(each.startswith(f"named like {preset}: <{prim}>") for each in said)
    if preset:
        author(mesh, "physgraph:material:density", 0.3)
        assert notes(save(stage)) == []  # It has a fabric of its own.


def test_a_subset_counts_where_it_is_most_of_a_garment_and_the_command_works(tmp_path: Path):
    stage = new_stage(tmp_path / "s.usda")
    for name, part in (("one", 4), ("two", 12)):
        mesh = add_sheet(stage, f"/World/{name}", tagged=False)
        UsdGeom.Subset.CreateGeomSubset(mesh, "denim", UsdGeom.Tokens.face, list(range(part)))
    (said,) = notes(save(stage), "/World/one", "/World/two")
    assert said == "named like denim: </World/two> (denim); --set /World/two.preset=denim refines it so"
    shot = open_shot(save(stage), garments=["/World/one", "/World/two"], overrides=["/World/two.preset=denim"])
    fabrics = [each.fabric for each in shot.frame(1.0).garments]
    assert [each.stretch for each in fabrics] == [PRESETS[name].stretch for name in ("jersey", "denim")]


@pytest.mark.parametrize("tagged", [True, False])
def test_the_command_gives_each_garment_the_fabric_that_its_names_say(tmp_path: Path, tagged: bool):
    """As printed, from a folder with a space in its name, it runs without a warning, and needs no other command."""
    (folder := tmp_path / "a shot").mkdir()
    stage = new_stage(folder / "s.usda")
    named = {"/World/Hoodie": "rib", "/World/Scarf_geo": "wool", "/World/top": "leather", "/World/skirt": "jersey"}
    for number, path in enumerate(named):
        sheet = add_sheet(stage, path, tagged=tagged, times=(1.0, 2.0))
        sheet.AddTranslateOp().Set((0.0, 0.0, 5.0 * number))
        if (mesh := sheet.GetPrim()).GetName() == "top":
            author(mesh, "physgraph:material:thickness", 2e-3)
            UsdShade.MaterialBindingAPI.Apply(mesh).Bind(UsdShade.Material.Define(stage, "/World/M_Leather"))
    found = inspect_shot(save(stage))
    words = shlex.split(found["command"])
    report = folder / "r.json"
    done = run(*words[1:], "--level", "0", "--report", report)
    assert (done.exit_code, done.stderr) == (0, "")
    written = {each["path"]: each["fabric"] for each in json.loads(report.read_text())["garments"]}
    for path, preset in named.items():
        wanted = {"stretch": PRESETS[preset].stretch, "bend": PRESETS[preset].bend, "density": PRESETS[preset].density}
        assert {name: written[path][name] for name in wanted} == pytest.approx(wanted)
        assert written[path]["thickness"] == pytest.approx(2e-3 if path == "/World/top" else 1e-3)


def test_a_preset_hides_what_another_has_authored(tmp_path: Path):
    stage = new_stage(tmp_path / "s.usda")
    mesh = add_sheet(stage).GetPrim()
    for name, value in fabric_values(PRESETS["denim"]).items():
        author(mesh, GARMENT[name].name, value)
    shot = save(stage)
    for overrides, preset in (([], "denim"), (["preset=jersey"], "jersey")):
        fabric = open_shot(shot, overrides=overrides).frame(1.0).garments[0].fabric
        assert asdict(fabric) == pytest.approx(asdict(PRESETS[preset]))
    with pytest.raises(UsageError, match=r"unknown preset 'jeans'; known presets: cotton, "):
        open_shot(shot, overrides=["/World/cloth.preset=jeans"])


def test_every_word_is_of_a_preset():
    assert {*NAMED.values(), *WORN.values()} <= set(PRESETS)


def test_cloth_that_is_not_solved_is_named_with_its_frames():
    frames = [
        {"time": time, "garments": [{"start": start}]}
        for time, start in ((1.0, "cold"), (2.0, GIVEN_UP), (3.0, GIVEN_UP))
    ]
    report = RefineReport("s", None, {}, garments=[{"path": "/dress"}], frames=frames)
    (note,) = texts("given_up", Facts(report=report))
    assert note.startswith("in 2 frames cloth is its subdivided cage")
    assert "</dress>, first at time code 2" in note
    report.frames = frames[:1]
    assert texts("given_up", Facts(report=report)) == []


@pytest.mark.parametrize(("offset", "remedy"), [(0.004, "--set /Coat.contact:offset=0.004 hides it"), (math.inf, "")])
def test_a_body_that_shows_through_has_an_offset_only_if_folds_stay(offset: float, remedy: str):
    """Far off, the cloth has no folds: a note never asks for what a warning then refuses."""
    (text,) = texts("shown", Facts(shown=[Shown("/Coat", "/Body", 1.0, 0.0075, offset)]))
    assert remedy in text
    assert ("--set" in text) == bool(remedy)
