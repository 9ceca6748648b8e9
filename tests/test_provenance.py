"""Where a layer comes from, the root that shows it, and variant selections, recorded and checked."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from layers import COAT, errors, grid, make_shot, open_over, vec3, write_layer, write_shot
from pxr import Sdf, Usd, UsdGeom, UsdUtils, Vt

from physgraph_usd.errors import UsageError
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.usd.check.rules import Problem
from physgraph_usd.usd.check.validate import validate_layer
from physgraph_usd.usd.provenance import asset_path, file_hashes, mute_refined, read_record, refined_layers, write_root
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.view import root_over


def test_a_usdz_shot_and_its_root(dressed: Path, tmp_path: Path) -> None:
    package = tmp_path / "shot.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(dressed), str(package))
    out = write_layer(package, tmp_path / "layers" / "out.usdc")
    root = write_root(tmp_path / "root.usda", layer=out, shot=package)
    stage = Usd.Stage.Open(str(root))
    assert len(UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr().Get(2.5)) == 63
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert stage.GetRootLayer().subLayerPaths == ["./layers/out.usdc", "./shot.usdz"]
    assert errors(out) == []


def test_the_root_repeats_what_only_a_root_says(dressed: Path, tmp_path: Path) -> None:
    layer = Sdf.Layer.FindOrOpen(str(dressed))
    layer.expressionVariables = {"SHOW": "x"}
    layer.Save()
    out = write_layer(dressed, tmp_path / "out.usdc")
    stage = Usd.Stage.Open(str(write_root(tmp_path / "root.usda", layer=out, shot=dressed)))
    assert stage.GetTimeCodesPerSecond() == 30.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1.0, 4.0)
    assert dict(stage.GetRootLayer().expressionVariables) == {"SHOW": "x"}
    with pytest.raises(UsageError, match="exists"):
        write_root(tmp_path / "root.usda", layer=out, shot=dressed)


def test_the_record_says_where_it_comes_from(dressed: Path, tmp_path: Path) -> None:
    shot = open_shot(str(dressed), level=1)
    hashes = file_hashes(shot.stage, tmp_path)
    assert hashes == {"./shot.usda": hashlib.sha256(dressed.read_bytes()).hexdigest()}
    given = {"version": "1", "inputs": hashes, "numbers": (1, 2), "mixed": [1.5, 2], "none": None, "flag": True}
    write_shot(shot, tmp_path / "out.usdc", times=(1.0,), provenance=given)
    record = read_record(Sdf.Layer.FindOrOpen(str(tmp_path / "out.usdc")))
    assert record is not None
    assert record["shot"] == "./shot.usda"
    assert list(record["garments"]) == [COAT]
    assert dict(record["inputs"]) == hashes
    assert list(record["numbers"]) == [1, 2]
    assert "none" not in record
    stage = open_over(dressed, tmp_path / "out.usdc")
    found = refined_layers(stage)
    assert [Path(layer.realPath).name for layer in found] == ["out.usdc"]


def test_a_refined_garment_is_refined_again_from_its_coarse_mesh(dressed: Path, tmp_path: Path) -> None:
    out = write_layer(dressed, tmp_path / "out.usdc")
    root = write_root(tmp_path / "root.usda", layer=out, shot=dressed)
    again = write_layer(root, tmp_path / "again.usdc")
    fine = [Usd.Stage.Open(str(write_root(tmp_path / f"{p.stem}.usda", layer=p, shot=dressed))) for p in (out, again)]
    counts = [len(UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr().Get(1.0)) for stage in fine]
    assert counts[0] == counts[1] > 20
    # An artist's change in the root outlives hiding the refined layer.
    stage = Usd.Stage.Open(str(root))
    stage.GetPrimAtPath(COAT).GetAttribute("physgraph:material:bendStiffness").Set(0.5)
    assert [Path(name).name for name in mute_refined(stage)] == ["out.usdc"]
    prim = stage.GetPrimAtPath(COAT)
    assert len(UsdGeom.Mesh(prim).GetPointsAttr().Get(1.0)) == 20
    assert prim.GetAttribute("physgraph:material:bendStiffness").Get() == 0.5


@pytest.mark.parametrize("entry", [1, "x", {"a": 1}, float("nan")])
def test_a_record_that_somebody_else_wrote_is_no_reason_to_fail(dressed: Path, entry: object) -> None:
    layer = Sdf.Layer.FindOrOpen(str(dressed))
    layer.customLayerData = {"physgraph": dict.fromkeys(["garments", "variants", "left_out"], entry)}
    layer.Save()
    assert refined_layers(Usd.Stage.Open(layer)) == []
    assert open_shot(str(dressed), level=1).scene.garments


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    """A coat whose ``cut`` on /World decides its mesh, and whose ``look`` decides nothing that refining reads."""
    stage = make_shot(tmp_path / "plain.usda")
    flat = Sdf.Layer.OpenAsAnonymous(str(tmp_path / "plain.usda"))
    mesh = flat.GetPrimAtPath(COAT)
    for name in ("points", "faceVertexCounts", "faceVertexIndices", "extent"):
        mesh.RemoveProperty(mesh.properties[name])
    flat.Export(str(tmp_path / "shot.usda"))
    stage = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    cut = stage.GetPrimAtPath("/World").GetVariantSets().AddVariantSet("cut")
    for name, size in (("short", (4, 3)), ("long", (4, 6)), ("tailed", (4, 6))):
        cut.AddVariant(name)
        cut.SetVariantSelection(name)
        with cut.GetVariantEditContext():
            author_sheet(UsdGeom.Mesh(stage.GetPrimAtPath(COAT)), size, height=0.3 if name == "tailed" else 0.0)
    cut.SetVariantSelection("short")
    look = stage.GetPrimAtPath(COAT).GetVariantSets().AddVariantSet("look")
    look.AddVariant("red")
    look.AddVariant("blue")
    look.SetVariantSelection("red")
    stage.GetRootLayer().Save()
    return tmp_path / "shot.usda"


def author_sheet(mesh: UsdGeom.Mesh, size: tuple[int, int], *, height: float) -> None:
    points, counts, indices = grid(*size)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(indices))
    for time in (1.0, 2.0):
        mesh.CreatePointsAttr().Set(vec3(points + np.array([0.0, 0.0, height * time])), time)


def selecting(shot: Path, prim: str, name: str, selection: str) -> Path:
    """A stage over the shot that selects another variant."""
    root = root_over(Sdf.Layer.FindOrOpen(str(shot)), ["./shot.usda"])
    Sdf.CreatePrimInLayer(root, prim).variantSelections[name] = selection
    path = shot.parent / f"{name}_{selection}.usda"
    root.Export(str(path))
    return path


def told(out: Path, shot: Path) -> list[Problem]:
    return [problem for problem in validate_layer(out, shot) if problem.rule == "same_variants"]


def test_selections_are_in_the_record_and_the_report(shot: Path, tmp_path: Path) -> None:
    out = write_layer(shot, tmp_path / "out.usdc")
    said = ["/World/rig/coat{look=red}", "/World{cut=short}"]
    record = read_record(Sdf.Layer.FindOrOpen(str(out)))
    assert record is not None
    assert sorted(record["variants"]) == said
    assert sorted(inspect_shot(shot)["variants"]) == said
    assert told(out, shot) == []


@pytest.mark.parametrize("selection", ["long", "tailed"])
def test_another_garment_is_an_error(shot: Path, tmp_path: Path, selection: str) -> None:
    """The layer shows the first one: what it authors at the prim's own path is stronger than any variant."""
    out = write_layer(shot, tmp_path / "out.usdc")
    other = selecting(shot, "/World", "cut", selection)
    stage = open_over(other, out)
    shown = UsdGeom.Mesh(stage.GetPrimAtPath(COAT)).GetPointsAttr().Get(1.0)
    assert len(shown) == 63, "the layer no longer shows the first one's garment"
    (problem,) = told(out, other)
    assert (problem.severity, problem.path) == ("error", "/World")
    assert f"was refined with cut=short and shows that; the shot has cut={selection} now" in problem.message
    assert COAT in problem.message


def test_the_same_mesh_under_another_look_is_a_warning(shot: Path, tmp_path: Path) -> None:
    out = write_layer(shot, tmp_path / "out.usdc")
    (problem,) = told(out, selecting(shot, COAT, "look", "blue"))
    assert (problem.severity, problem.path) == ("warning", COAT)
    assert "look=red" in problem.message
    assert "look=blue" in problem.message


def test_variants_of_bodies_count_too(shot: Path, tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(shot))
    ball = UsdGeom.Sphere.Define(stage, "/World/ball").GetPrim()
    ball.AddAppliedSchema("PhysGraphColliderAPI")
    sizes = ball.GetVariantSets().AddVariantSet("size")
    for name in ("small", "large"):
        sizes.AddVariant(name)
    sizes.SetVariantSelection("small")
    stage.Save()
    out = write_layer(shot, tmp_path / "out.usdc")
    assert [p.path for p in told(out, selecting(shot, "/World/ball", "size", "large"))] == ["/World/ball"]


def test_paths_from_a_linked_folder_lead_to_the_file_by_the_links_name_too(tmp_path: Path) -> None:
    shot, real, link = tmp_path / "show" / "shot.usda", tmp_path / "disk" / "publish" / "v1", tmp_path / "show" / "link"
    real.mkdir(parents=True)
    shot.parent.mkdir()
    shot.touch()
    link.symlink_to(real)
    (real / "cloth.usdc").touch()
    assert asset_path(shot, shot.parent) == "./shot.usda"
    assert asset_path(link / "cloth.usdc", link) == "./cloth.usdc"
    assert asset_path(shot, link) == shot.resolve().as_posix()
