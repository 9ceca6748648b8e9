"""Which frames start from the last one's detail: those whose cloth it does not tear."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cloth import frame_of, group_of, sheet, wave
from folds import frame_with, named, refiner_with, square

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.solve import solve_frame
from physgraph_usd.solver.frame.start import STILL, Start, start_of
from physgraph_usd.solver.frame.values import Cage, FrameInput, State
from physgraph_usd.solver.resolution import edge_strain
from physgraph_usd.usd.read.reader import open_shot

MESH, REST = sheet(8, 6)


def begun(group: Group, state: State, cage: Cage) -> Start:
    """Where a frame starts, with no body that has moved."""
    given = {"frames": group.moving_frames, "finest": group.levels[-1], "reset": group.settings.reset}
    return start_of(state, cage, **given, moved=0.0)


def said(group: Group, *, strain: float, squeeze: float = 0.0) -> tuple[str, float]:
    """Where a frame starts whose carried detail strains the cloth so much, and by how much it does.

    The detail of a solved frame is enlarged until the 99th percentile of the edges' strain is what is asked for.
    """
    frames = list(frame_of(wave(REST)).garments)
    state = solve_frame(group, FrameInput(frames), None).state
    cage = group.cage(frame_of(REST * np.array([1.0 - squeeze, 1.0, 1.0])).garments)
    world = torch.as_tensor(cage.world)
    low, high, found, here = 0.0, 1e4, "", 0.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        detailed = replace(state, coarse=world, detail=middle * state.detail)
        start = begun(group, detailed, cage)
        moved = group.moving_frames.predict(replace(detailed, coarse=cage.points), cage.points)[0]
        found, detail = start.why, moved if start.detailed is None else start.detailed
        here = edge_strain(group.levels[-1], detail)["p99"]
        low, high = (middle, high) if here < strain else (low, middle)
    return found, here


@pytest.mark.parametrize(
    ("strain", "squeeze", "start"),
    [(0.3, 0.0, "warm"), (0.45, 0.0, "warm"), (0.55, 0.0, "cold"), (0.65, 0.4, "warm"), (1.1, 0.6, "cold")],
)
def test_detail_that_tears_the_cloth_is_not_carried(strain: float, squeeze: float, start: str):
    """Half its length more is too much, or twice what the cage itself is strained by, and its whole length always."""
    found, here = said(group_of(MESH, REST, level=1), strain=strain, squeeze=squeeze)
    assert here == pytest.approx(strain, rel=0.02)
    assert found.startswith(start), found
    assert ("carried detail strains the cloth" in found) == (start == "cold")


@pytest.mark.parametrize(("moved", "still"), [(0.5, True), (0.9, True), (1.1, False), (40.0, False)])
def test_a_pose_is_held_while_its_cage_hardly_moves(moved: float, still: bool):
    group, points = group_of(MESH, REST, level=1), wave(REST)
    state = solve_frame(group, FrameInput(frame_of(points).garments), None).state
    edge = float(group.levels[0].spacing.mean())
    cage = group.cage(frame_of(points + np.array([0.0, moved * STILL * edge, 0.0])).garments)
    start = begun(group, state, cage)
    assert (start.why, start.held) == ("warm", int(still))


@pytest.mark.parametrize("contact", [ContactSettings(), ContactSettings("off", cloth="off")])
def test_what_rests_stays_until_it_is_moved_by_more_than_it_rested_with(contact: ContactSettings):
    """The cage is bent by ever more: until twice the tolerance is left, no step is made."""
    group = group_of(MESH, REST, steps=400, tolerance=1e-3, contact=contact, temporal="warm")
    state, made = solve_frame(group, FrameInput(frame_of(wave(REST)).garments), None).state, []
    for bend in np.linspace(0.0, 0.001, 15):
        points = wave(REST) + bend * np.sin(20.0 * REST[:, [0]]) * np.array([0.0, 1.0, 0.0])
        levels = solve_frame(group, FrameInput(frame_of(points).garments), state).telemetry["levels"]
        made.append((sum(level["steps"] for level in levels), levels[-1]["remaining_move"]))
    stayed = [left for steps, left in made if not steps]
    assert max(stayed) > 1.5e-3, made
    assert all(left < 2e-3 for left in stayed)
    assert all(left < 1e-3 for steps, left in made if steps)
    assert len(stayed) < len(made)


class TestTangledStart:
    """A warm start whose carried detail crosses where the cage does not."""

    def test_nothing_crosses_after_the_frame(self):
        """Two sheets: the upper one sinks to the lower one faster than its detail is told."""
        garments = [named(square(6), "A"), named(square(6), "B")]
        flat, solver = square(6)[1], refiner_with(garments, times=tuple(range(6)))
        for time, height in enumerate((0.03, 0.012, 0.002, 0.001, 0.001, 0.03)):
            upper = flat + 0.02 * (time + 1) * flat[:, :1] * [0.0, 1.0, 0.0] + [0.0037, height + 0.02 * time, 0.0051]
            told = solver.solve(frame_with([flat, upper], time=float(time))).telemetry[0]
            assert told["contact"]["cloth"]["before"]["crossings"] == 0
            assert told["contact"]["cloth"]["after"]["crossings"] == 0
            assert told["start"].startswith("warm") == (time > 0)

    def test_what_its_cage_took_through_other_cloth_does_not_hang_on_that(self):
        """A sheet is pulled up through a smaller one, which stays: its middle may not follow, its rim may."""
        small, large = square(4), square(12)
        garments = [named(small, "A", pin=np.ones(len(small[1]))), named(large, "B")]
        middle = np.concatenate([each[1] for each in (small, large)]).mean(axis=0)
        solver, strains, starts = refiner_with(garments, times=tuple(range(3))), [], []
        for time, height in enumerate((-0.02, 0.2, 0.21)):
            upper = large[1] - large[1].mean(axis=0) + middle + [0.003, height, 0.007]
            state = solver.solve(frame_with([small[1] - small[1].mean(axis=0) + middle, upper], time=float(time)))
            starts.append(state.telemetry[1]["start"])
            strains.append(state.telemetry[1]["strain"]["max"])
        assert starts[1].startswith("cold: started anew")
        assert max(strains) < 0.5

    def test_of_a_shot_crosses_less_than_its_input(self, tmp_path: Path):
        """Three frames of the T-shirt whose cages cross themselves."""
        shot = open_shot(str(write_sample("tshirt", tmp_path)))
        refiner = Refiner(shot.scene, RefineOptions().solve_settings(), levels=[2])
        told: list[Any] = [refiner.solve(shot.frame(float(time))).telemetry[0] for time in range(7, 10)]
        for each in told:
            cloth = each["contact"]["cloth"]
            assert cloth["after"]["crossings"] <= 0.2 * cloth["before"]["crossings"]
        assert [each["start"].split(":")[0] for each in told] == ["cold", "warm", "warm"]
