"""Tagging a shot in a new layer."""

from pathlib import Path

import pytest
from layers import COAT, TIMES, make_shot
from pxr import Usd, UsdGeom

from physgraph_usd.errors import StageError, UsageError
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.write.tag import tag


@pytest.fixture
def untagged(tmp_path: Path) -> Path:
    path = tmp_path / "shot.usda"
    stage = make_shot(path)
    stage.GetPrimAtPath(COAT).RemoveAppliedSchema("PhysGraphGarmentAPI")
    UsdGeom.Sphere.Define(stage, "/World/ball")
    stage.Save()
    return path


def schemas(stage: Usd.Stage, path: str) -> list[str]:
    return list(stage.GetPrimAtPath(path).GetPrimTypeInfo().GetAppliedAPISchemas())


def test_a_tagged_shot_can_be_refined_as_it_is(untagged: Path, tmp_path: Path) -> None:
    before = untagged.read_bytes()
    out = tag(untagged, tmp_path / "tagged.usda", garments=[COAT], colliders=["/World/ball"])
    stage = Usd.Stage.Open(str(out))
    assert schemas(stage, COAT) == ["PhysGraphGarmentAPI"]
    assert schemas(stage, "/World/ball") == ["PhysGraphColliderAPI"]
    assert stage.GetTimeCodesPerSecond() == 30.0
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert open_shot(str(out)).scene.times == TIMES
    assert untagged.read_bytes() == before


def test_a_preset_is_authored_on_garments_only(untagged: Path, tmp_path: Path) -> None:
    out = tag(untagged, tmp_path / "tagged.usda", garments=[COAT], colliders=["/World/ball"], preset="denim")
    stage = Usd.Stage.Open(str(out))
    attribute = stage.GetPrimAtPath(COAT).GetAttribute("physgraph:material:bendStiffness")
    assert attribute.Get() == pytest.approx(PRESETS["denim"].bend)
    assert not stage.GetPrimAtPath("/World/ball").GetAttribute("physgraph:material:bendStiffness").HasAuthoredValue()


def test_a_preset_replaces_all_of_another_one(untagged: Path, tmp_path: Path) -> None:
    """Denim differs between warp and weft and has a shear stiffness, jersey has neither."""
    denim = tag(untagged, tmp_path / "denim.usda", garments=[COAT], preset="denim")
    again = tag(denim, tmp_path / "jersey.usda", preset="jersey")
    alone = tag(untagged, tmp_path / "alone.usda", garments=[COAT], preset="jersey")
    fabrics = [open_shot(str(file)).frame(TIMES[0]).garments[0].fabric for file in (denim, again, alone)]
    assert fabrics[0] != fabrics[2]
    assert fabrics[1] == fabrics[2]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"garments": [COAT], "side": "front"}, "a side is for colliders; name one"),
        ({"colliders": ["/World/ball"], "side": "up"}, "unknown side 'up'; known sides: auto, winding, start"),
    ],
)
def test_what_is_for_nothing_that_was_named_is_refused(
    untagged: Path, tmp_path: Path, given: dict, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        tag(untagged, tmp_path / "a.usda", **given)


def test_wrong_requests_name_the_choices(untagged: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing to tag"):
        tag(untagged, tmp_path / "a.usda")
    with pytest.raises(UsageError, match=r"unknown preset 'tweed'; known presets: .*denim"):
        tag(untagged, tmp_path / "a.usda", garments=[COAT], preset="tweed")
    with pytest.raises(StageError, match=COAT):
        tag(untagged, tmp_path / "a.usda", garments=["/World/nothing"])
    with pytest.raises(UsageError, match="density is -1"):
        tag(untagged, tmp_path / "a.usda", garments=[COAT], values={COAT: {"density": -1.0}})
    with pytest.raises(UsageError, match="never edited"):
        tag(untagged, untagged, garments=[COAT], overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["shot.usda"]


def test_a_prim_in_an_instance_is_refused(untagged: Path, tmp_path: Path) -> None:
    path = tmp_path / "set.usda"
    stage = Usd.Stage.CreateNew(str(path))
    prim = stage.DefinePrim("/Set/copy")
    prim.GetReferences().AddReference("shot.usda")
    prim.SetInstanceable(True)
    stage.Save()
    with pytest.raises(StageError, match="instance"):
        tag(path, tmp_path / "tagged.usda", garments=["/Set/copy/rig/coat"])
