"""Which garments are solved together; what touches nothing is as without contact; work grows with their number."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloth import Answer, sheet
from folds import Cloth, curved, flat, folded, frame_with, named, refiner_with, rolled, square, strip
from pxr import Gf, Usd, UsdGeom
from sheets import rotation
from shots import refine
from stages import add_sheet, new_stage

from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.contact.settings import ContactSettings

OFF = ContactSettings(cloth="off")
QUIET = {"flat": flat, "curved": curved, "half a turn": lambda points: curved(points, np.pi)}


@pytest.mark.parametrize("name", QUIET)
def test_where_nothing_touches_cloth_ends_as_low_as_without_contact(name: str):
    cloth = strip(12, 4)
    cage = QUIET[name](cloth[1])
    felt, off = (
        refiner_with([named(cloth)], level=1, contact=contact).solve(frame_with([cage])).telemetry[0]
        for contact in (ContactSettings(), OFF)
    )
    one, other = (sum(told["energy_joules"]["output"].values()) for told in (felt, off))
    start = sum(off["energy_joules"]["input"].values())
    assert one <= other + 0.01 * abs(start - other)
    assert felt["contact"]["cloth"]["after"]["crossings"] == 0
    assert "contact" not in off


class TestGarments:
    def solve(self, cages: list[np.ndarray], garments: list[Any], **options: Any) -> Answer:
        return refiner_with(garments, **options).solve(frame_with(cages))

    def apart(self, cages: list[np.ndarray], cloths: list[Cloth]) -> list[np.ndarray]:
        """Each solved by itself."""
        return [self.solve([cage], [named(cloth)]).points[0] for cage, cloth in zip(cages, cloths, strict=True)]

    def test_far_apart_they_are_solved_apart(self):
        cloths = [square(4), strip(8, 3)]
        cages = [curved(cloths[0][1]), folded(cloths[1][1]) + np.array([0.0, 2.0, 0.0])]
        together = self.solve(cages, [named(cloths[0], "A"), named(cloths[1], "B")])
        for number, alone in enumerate(self.apart(cages, cloths)):
            assert together.points[number].tobytes() == alone.tobytes()
            assert "together" not in together.telemetry[number]

    def test_excluded_from_one_another_they_are_solved_apart_even_when_they_cross(self):
        cloths = [square(4), square(4)]
        cages = [cloths[0][1], cloths[1][1] @ rotation(3).T]
        garments = [named(cloths[0], "A", apart_from=("/World/B",)), named(cloths[1], "B", apart_from=("/World/A",))]
        together = self.solve(cages, garments)
        for number, alone in enumerate(self.apart(cages, cloths)):
            assert together.points[number].tobytes() == alone.tobytes()
        near = self.solve(cages, [named(cloths[0], "A"), named(cloths[1], "B")])
        assert near.telemetry[0]["together"] == ["/World/A", "/World/B"]
        assert near.telemetry[0]["contact"]["cloth"]["before"]["between_garments"] > 0

    def test_excluded_from_one_another_but_both_near_a_third(self):
        """All three are solved together, and the two still do not feel one another."""
        cloth = square(4)
        cages = [cloth[1] + [0.0, 0.0004 * number, 0.0] for number in (0, 0.5, 40)]
        garments = [
            named(cloth, "A", apart_from=("/World/B",)),
            named(cloth, "B", apart_from=("/World/A",)),
            named(cloth, "C"),
        ]
        answer = self.solve(cages, garments)
        assert len(answer.telemetry[0]["together"]) == 3
        gap = np.abs(answer.points[0][:, 1] - answer.points[1][:, 1])
        assert gap.max() < 0.0004
        felt = self.solve(cages, [named(cloth, name) for name in "ABC"])
        assert np.abs(felt.points[0][:, 1] - felt.points[1][:, 1]).mean() > gap.mean()

    def test_near_ones_are_solved_together_only_in_frames_where_they_are(self):
        cloth = square(4)
        one = refiner_with([named(cloth, "A"), named(cloth, "B")], times=(1.0, 2.0, 3.0))
        parts = []
        for time, height in ((1.0, 2.0), (2.0, 0.002), (3.0, 2.0)):
            answer = one.solve(frame_with([cloth[1], cloth[1] + [0.0, height, 0.0]], time=time))
            parts.append("together" in answer.telemetry[0])
        assert parts == [False, True, False]

    def test_a_garment_that_does_not_feel_itself(self):
        cloth = strip(8, 3)
        cage = rolled(cloth[1], 0.0005)
        alone = self.solve([cage], [named(cloth, self_contact=False)])
        off = refiner_with([named(cloth)], contact=OFF).solve(frame_with([cage]))
        assert alone.points[0].tobytes() == off.points[0].tobytes()
        felt = self.solve([cage], [named(cloth)])
        assert felt.points[0].tobytes() != off.points[0].tobytes()


MESH, REST = sheet(2, 2)


def sheets(path: Path, count: int) -> Usd.Stage:
    """Sheets far from one another; the last is kept apart from the first."""
    stage = new_stage(path, metres=0.05)
    for index in range(count):
        mesh = add_sheet(stage, f"/World/g{index}", size=(1, 1), times=(1.0,), default=False)
        UsdGeom.XformCommonAPI(mesh).SetTranslate(Gf.Vec3d(10.0 * index, 0.0, 0.0))
    last = stage.GetPrimAtPath(f"/World/g{count - 1}")
    last.CreateRelationship("physgraph:contact:exclude").AddTarget("/World/g0")
    stage.Save()
    return stage


def test_a_warning_of_the_whole_shot_names_all_prims_in_the_report(tmp_path: Path):
    shot = tmp_path / "shot.usda"
    stage = sheets(shot, 5)
    stage.ClearMetadata("metersPerUnit")
    stage.Save()
    report = refine(shot, tmp_path / "fine.usdc")
    (said,) = [each for each in report.warnings if "measures" in each]
    assert said.startswith("</World/g0>, </World/g1>, </World/g2> and 2 more: measures ")
    assert report.warned[said] == [f"/World/g{index}" for index in range(5)]
    assert said in inspect_shot(shot, level=1)["warnings"]
