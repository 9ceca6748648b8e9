"""Shots of many small garments: the work grows with their number, not with its square, and so do the warnings."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloth import frame_of, sheet
from pxr import Gf, Usd, UsdGeom
from sheets import garment_of
from shots import refine
from stages import add_sheet, new_stage

from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.contact.broad_phase import TouchingGroups
from physgraph_usd.solver.scene import Garment, GarmentFrame
from physgraph_usd.usd.read.find import felt_by, find_colliders

MESH, REST = sheet(2, 2)
FEW, FACTOR = 40, 8


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


def calls(run: Callable[[], Any]) -> int:
    """How many calls of functions something makes: time that no other process disturbs."""
    count = 0

    def one(frame: object, event: str, argument: object) -> None:
        nonlocal count
        count += event.endswith("call")

    sys.setprofile(one)
    try:
        run()
    finally:
        sys.setprofile(None)
    return count


def linear(run: Callable[[int], Any]) -> bool:
    """Whether the calls made for many are at most as many times those for a few as there are more, and a half."""
    return calls(lambda: run(FACTOR * FEW)) < 1.5 * FACTOR * calls(lambda: run(FEW))


def scattered(count: int, spread: float) -> tuple[list[Garment], list[GarmentFrame]]:
    places = np.random.default_rng(3).uniform(0.0, spread, (count, 3))
    garments = [replace(garment_of(MESH, REST), path=f"/World/g{index}") for index in range(count)]
    return garments, [frame_of(REST + place).garments[0] for place in places]


@pytest.fixture(scope="module")
def stages(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Usd.Stage]:
    folder = tmp_path_factory.mktemp("many")
    return {count: sheets(folder / f"{count}.usda", count) for count in (FEW, FACTOR * FEW)}


@pytest.mark.parametrize("look", [find_colliders, felt_by])
def test_what_they_touch_is_looked_for_in_time_that_grows_with_their_number(
    stages: dict[int, Usd.Stage], look: Callable[..., Any]
):
    def run(count: int) -> None:
        look(stages[count], [stages[count].GetPrimAtPath(f"/World/g{index}") for index in range(count)])

    assert linear(run)


@pytest.mark.parametrize("spread", [0.5, 2.0, 8.0])
def test_those_that_meet_are_found_as_by_looking_at_every_pair(spread: float):
    garments, frames = scattered(40, spread)
    found = TouchingGroups(garments, together=True).of(frames)
    pairs = [
        (a, b)
        for a in range(40)
        for b in range(a + 1, 40)
        if len(TouchingGroups([garments[a], garments[b]], together=True).of([frames[a], frames[b]])) == 1
    ]
    assert found == joined(40, pairs)


def joined(count: int, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, ...]]:
    """Numbers in groups that pairs join, by their least."""
    parts = {index: {index} for index in range(count)}
    for a, b in pairs:
        both = parts[a] | parts[b]
        parts |= dict.fromkeys(both, both)
    return sorted({tuple(sorted(part)) for part in parts.values()})


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
