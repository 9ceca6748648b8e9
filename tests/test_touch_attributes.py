"""What a garment says of touching itself, other garments and colliders."""

from __future__ import annotations

from pathlib import Path

import pytest
from pxr import Usd
from stages import add_sheet, author, new_stage, save

from physgraph_usd.errors import SchemaError, UsageError
from physgraph_usd.scene import Garment
from physgraph_usd.usd.reader import open_shot

CLOTH = "/World/rig/cloth"


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    made = new_stage(tmp_path / "s.usda")
    add_sheet(made, CLOTH)
    return made


def garment(stage: Usd.Stage, *overrides: str) -> tuple[Garment, dict[str, str]]:
    shot = open_shot(save(stage), overrides=overrides)
    return shot.scene.garments[0], shot.sources[0].sources


class TestSelfContactAndLayer:
    def test_a_garment_feels_itself_and_has_no_layer_unless_it_says_so(self, stage: Usd.Stage):
        read, sources = garment(stage)
        assert (read.self_contact, read.layer) == (True, None)
        assert (sources["contact:selfCollision"], sources["contact:layer"]) == ("fallback", "fallback")

    @pytest.mark.parametrize("layer", [0, 3, -1])
    def test_both_are_read_with_their_source(self, stage: Usd.Stage, layer: int):
        prim = stage.GetPrimAtPath(CLOTH)
        author(prim, "physgraph:contact:selfCollision", False, kind="bool")
        author(prim, "physgraph:contact:layer", layer, kind="int")
        read, sources = garment(stage)
        assert (read.self_contact, read.layer) == (False, layer)
        assert sources["contact:layer"] == f"<{CLOTH}>.physgraph:contact:layer"

    def test_an_ancestor_gives_them_in_any_numeric_type(self, stage: Usd.Stage):
        author(stage.GetPrimAtPath("/World/rig"), "userProperties:physgraph:contact:layer", 2.0, kind="double")
        author(stage.GetPrimAtPath("/World/rig"), "userProperties:physgraph:contact:selfCollision", 0, kind="int")
        read, _ = garment(stage)
        assert (read.self_contact, read.layer) == (False, 2)
        assert type(read.layer) is int

    def test_set_goes_before_the_stage(self, stage: Usd.Stage):
        author(stage.GetPrimAtPath(CLOTH), "physgraph:contact:layer", 1, kind="int")
        read, sources = garment(stage, "layer=4", "selfCollision=off")
        assert (read.self_contact, read.layer) == (False, 4)
        assert sources["contact:layer"] == "--set"

    def test_a_layer_between_two_layers_is_refused(self, stage: Usd.Stage):
        author(stage.GetPrimAtPath("/World/rig"), "physgraph:contact:layer", 1.5)
        with pytest.raises(SchemaError, match="must be a whole number"):
            garment(stage)

    def test_auto_is_a_level_and_no_layer(self, stage: Usd.Stage):
        with pytest.raises(UsageError, match="layer=auto"):
            garment(stage, "layer=auto")
