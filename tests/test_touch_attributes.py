"""What a garment says of touching itself, other garments and colliders."""

from pathlib import Path

import pytest
from pxr import Usd, UsdGeom
from stages import COLLIDER_API, add_sheet, new_stage, save

from physgraph_usd.cli.printing import outline
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.usd.read.reader import Shot, open_shot

CLOTH = "/World/rig/cloth"


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    made = new_stage(tmp_path / "s.usda")
    add_sheet(made, CLOTH)
    return made


def test_a_garment_feels_itself_unless_it_says_otherwise(stage: Usd.Stage):
    shot = open_shot(save(stage))
    assert shot.scene.garments[0].self_contact
    assert shot.sources[0].sources["contact:selfCollision"] == "fallback"


class TestExclusion:
    @pytest.fixture
    def dressed(self, stage: Usd.Stage) -> Usd.Stage:
        """A cloth and a belt, a body with a torso and two hands, all in one place."""
        add_sheet(stage, "/World/belt")
        for name in ("torso", "hands/left", "hands/right"):
            UsdGeom.Sphere.Define(stage, f"/World/body/{name}").GetPrim().AddAppliedSchema(COLLIDER_API)
        return stage

    def exclude(self, stage: Usd.Stage, *targets: str, by: str = CLOTH) -> None:
        stage.GetPrimAtPath(by).CreateRelationship("physgraph:contact:exclude").SetTargets(list(targets))

    def felt(self, shot: Shot) -> list[list[str]]:
        paths = [collider.path.removeprefix("/World/body/") for collider in shot.scene.colliders]
        return [[paths[index] for index in garment.colliders] for garment in shot.scene.garments]

    def test_a_collider_is_excluded_for_one_garment_only(self, dressed: Usd.Stage):
        self.exclude(dressed, "/World/body/hands/left")
        shot = open_shot(save(dressed))
        assert self.felt(shot) == [["torso", "hands/right"], ["torso", "hands/left", "hands/right"]]
        said = f"<{CLOTH}>.physgraph:contact:exclude"
        assert shot.sources[0].apart_from == {"/World/body/hands/left": said}
        assert shot.sources[1].apart_from == {}

    @pytest.mark.parametrize("target", ["/World/body/hands", "/World/body.collection:hands"])
    def test_everything_below_an_ancestor_or_in_a_collection_is_excluded(self, dressed: Usd.Stage, target: str):
        body = dressed.GetPrimAtPath("/World/body")
        Usd.CollectionAPI.Apply(body, "hands").IncludePath("/World/body/hands")
        self.exclude(dressed, target)
        shot = open_shot(save(dressed))
        assert self.felt(shot)[0] == ["torso"]
        by = f"<{CLOTH}>.physgraph:contact:exclude = <{target}>"
        assert set(shot.sources[0].apart_from.values()) == {by}

    def test_it_goes_before_what_includes(self, dressed: Usd.Stage):
        self.exclude(dressed, "/World/body/hands")
        dressed.GetPrimAtPath(CLOTH).CreateRelationship("physgraph:colliders").SetTargets(["/World/body"])
        shot = save(dressed)
        assert self.felt(open_shot(shot))[0] == ["torso"]
        assert self.felt(open_shot(shot, colliders=["/World/body/*"]))[0] == ["torso"]

    def test_garments_are_apart_when_either_says_so(self, dressed: Usd.Stage):
        self.exclude(dressed, CLOTH, by="/World/belt")
        shot = open_shot(save(dressed))
        assert [garment.apart_from for garment in shot.scene.garments] == [("/World/belt",), (CLOTH,)]
        said = "</World/belt>.physgraph:contact:exclude"
        assert [source.apart_from for source in shot.sources] == [{"/World/belt": said}, {CLOTH: said}]

    def test_a_target_that_is_not_there_is_told_and_stops_nothing(self, dressed: Usd.Stage):
        self.exclude(dressed, "/World/body/tail", "/World/body/torso")
        shot = open_shot(save(dressed))
        assert self.felt(shot)[0] == ["hands/left", "hands/right"]
        told = [str(notice) for notice in shot.warnings if "excludes nothing" in str(notice)]
        assert len(told) == 1
        assert "</World/body/tail>" in told[0]

    def test_inspect_and_report_tell_what_is_excluded_and_by_what(self, dressed: Usd.Stage):
        self.exclude(dressed, "/World/body", "/World/belt")
        found = inspect_shot(save(dressed))
        cloth, belt = found["garments"]
        assert set(cloth["apart_from"]) == {f"/World/body/{n}" for n in ("torso", "hands/left", "hands/right")} | {
            "/World/belt"
        }
        assert cloth["apart_from"]["/World/body/torso"] == f"<{CLOTH}>.physgraph:contact:exclude = </World/body>"
        assert (cloth["colliders"], len(belt["colliders"])) == ([], 3)
        assert "\n".join(outline(found)).count("physgraph:contact:exclude") == 5
