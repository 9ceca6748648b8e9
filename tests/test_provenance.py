"""Where a layer comes from, and the root that shows it."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from layers import COAT, errors, open_over, write_layer, write_shot
from pxr import Sdf, Usd, UsdGeom, UsdUtils

from physgraph_usd.errors import UsageError
from physgraph_usd.usd.provenance import file_hashes, mute_refined, read_record, refined_layers, write_root
from physgraph_usd.usd.read.reader import open_shot


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
