"""A run that begins in the middle of a shot, where its cage crosses itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from physgraph_usd.errors import StageError
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.solver.frame.lead_in import lead_in
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.usd.read.reader import Shot, open_shot


@pytest.fixture(scope="module")
def skirt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample("skirt", tmp_path_factory.mktemp("skirt"))


def test_nothing_crosses_in_frames_whose_cages_cross(skirt: Path, tmp_path: Path):
    """Without the earlier frames a contour stays that the cage by itself does not get rid of."""
    options = RefineOptions(frames=(36.0, 40.0), level=1)
    entries: list[Any] = [each["garments"][0] for each in refine_shot(skirt, tmp_path / "a.usdc", options).frames]
    crossings = [entry["contact"]["cloth"] for entry in entries]
    assert all(each["before"]["crossings"] > 100 and each["after"]["crossings"] == 0 for each in crossings)
    assert entries[0]["start"].startswith("cold: the cage walked here from time code ")
    assert all(entry["start"] == "warm" for entry in entries[1:])


@pytest.mark.slow
def test_one_frame_is_as_low_in_energy_as_in_the_whole_shot(skirt: Path, tmp_path: Path):
    """Nearly: the cage by itself leaves 0.2 to 0.4 J more."""
    energies = {}
    for first in (26.0, 36.0):
        options = RefineOptions(frames=(first, 38.0), level=1)
        told: Any = refine_shot(skirt, tmp_path / f"{first:g}.usdc", options).frames[-1]["garments"][0]
        energies[first] = sum(told["energy_joules"]["output"].values())
    assert energies[36.0] < energies[26.0] + 1e-2


class TestWhereNothingIsToBeWalked:
    def cages(self, shot: Shot, **options: Any) -> Refiner:
        return Refiner(shot.scene, RefineOptions(**options).solve_settings(), levels=[0])

    def test_at_the_first_frame_of_the_shot(self, skirt: Path):
        shot = open_shot(str(skirt))
        assert lead_in(self.cages(shot), shot.frame, shot.times_until(1.0)) is None

    def test_where_the_cage_does_not_cross(self, tmp_path: Path):
        shot = open_shot(str(write_sample("hood", tmp_path)))
        assert lead_in(self.cages(shot), shot.frame, shot.times_until(shot.scene.times[3])) is None

    def test_where_cloth_does_not_touch_cloth(self, skirt: Path):
        shot = open_shot(str(skirt))
        cages = self.cages(shot, self_contact="off")
        assert lead_in(cages, shot.frame, shot.times_until(36.0)) is None


@pytest.mark.parametrize(
    ("broken", "begun"), [(32.0, 28.0), *(pytest.param(each, 32.0, marks=pytest.mark.slow) for each in (None, 34.0))]
)
def test_a_frame_that_cannot_be_read_is_passed_over(skirt: Path, broken: float | None, begun: float):
    shot = open_shot(str(skirt), frames=(36.0, 40.0))
    cages = Refiner(shot.scene, RefineOptions().solve_settings(), levels=[0])

    def read(time: float | None) -> Any:
        if time == broken:
            raise StageError("this time code is broken")
        return shot.frame(time)

    found = lead_in(cages, read, shot.times_until(36.0))
    assert found is not None
    assert found[1] == begun
