"""Notes: presets that names propose, with a command that works."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from pxr import UsdGeom, UsdShade
from shots import run
from stages import add_sheet, author, new_stage, save

from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.usd.read.reader import open_shot


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
    _, _, command = said.partition("to refine it so: ")
    words = shlex.split(command)
    assert "named like denim: </World/two> (denim)" in said
    assert words[0] == "physgraph-usd"
    assert run(*words[1:]).exit_code == 0
    fabric = open_shot(words[words.index("-o") + 1]).frame(1.0).garments[0].fabric
    assert fabric.stretch == PRESETS["denim"].stretch
