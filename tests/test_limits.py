"""Values beyond the limits of their attributes are told, by inspect, tag and validate."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("pxr", reason="stages are read with usd-core")

from pxr import Sdf, Usd
from shots import CLOTH, cloth_shot

from physgraph_usd import RefineOptions, inspect_shot, refine_shot, validate_layer
from physgraph_usd.errors import UsageError
from physgraph_usd.usd.write.tag import tag

DENSITY = "physgraph:material:density"


def test_inspect_and_validate_name_attribute_value_and_limit(tmp_path: Path) -> None:
    shot, out = cloth_shot(tmp_path / "sheet.usda", size=(4, 3)), tmp_path / "out.usda"
    refine_shot(str(shot), str(out), RefineOptions(garments=(CLOTH,), frames=(1.0, 1.0), level=0))
    stage = Usd.Stage.Open(str(shot))
    attribute = stage.GetPrimAtPath(CLOTH).CreateAttribute(DENSITY, Sdf.ValueTypeNames.Float)

    def found(value: float) -> str:
        attribute.Set(value)
        stage.Save()
        refined = Sdf.Layer.FindOrOpen(str(out))
        over = refined.GetPrimAtPath(CLOTH)
        kept = over.attributes.get(DENSITY) or Sdf.AttributeSpec(over, DENSITY, Sdf.ValueTypeNames.Float)
        kept.default = value
        return "\n".join(str(each) for each in validate_layer(out, shot) if each.rule == "limits")

    assert found(0.2) == ""
    said = found(50.0)
    assert f"<{CLOTH}.{DENSITY}>: is 50 kg/m^2, beyond its soft limits 0.01 .. 2" in said
    assert f"{DENSITY} is 50 kg/m^2" in str(inspect_shot(str(shot), garments=(CLOTH,))["warnings"])
    assert "is -1 kg/m^2, beyond its hard limits 0.0001 .." in found(-1.0)
    assert f"{DENSITY} is -1" in inspect_shot(str(shot), garments=(CLOTH,))["problem"]


def test_tag_refuses_what_refining_would(tmp_path: Path) -> None:
    shot = cloth_shot(tmp_path / "sheet.usda", size=(4, 3))
    with pytest.raises(UsageError, match="density is -1"):
        tag(shot, tmp_path / "out.usda", garments=[CLOTH], values={CLOTH: {"density": -1.0}})
    assert not (tmp_path / "out.usda").exists()
