"""Which frames start from the last one's detail: those whose cloth it does not tear."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cloth import frame_of, group_of, sheet, wave
from folds import EDGE, contact_of, levels_of, named, square

from benchmarks.contact_shots import run
from physgraph_usd import attempts
from physgraph_usd.contact.settings import ContactSettings
from physgraph_usd.group import Group
from physgraph_usd.options import RefineOptions
from physgraph_usd.pipeline import Refiner
from physgraph_usd.resolution import edge_strain
from physgraph_usd.samples import write_sample
from physgraph_usd.start import STILL
from physgraph_usd.usd.reader import open_shot

MESH, REST = sheet(8, 6)


def said(group: Group, *, strain: float, squeeze: float = 0.0) -> tuple[str, float]:
    """Where a frame starts whose carried detail strains the cloth so much, and by how much it does.

    The detail of a solved frame is enlarged until the 99th percentile of the edges' strain is what is asked for.
    """
    frames = list(frame_of(wave(REST)).garments)
    kept = group.solve(frames, None, at=None).carried
    cage = REST * np.array([1.0 - squeeze, 1.0, 1.0])
    world = torch.as_tensor(cage)
    coarse = group._tensor(cage - cage.mean(axis=0))
    low, high, found, here = 0.0, 1e4, "", 0.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        detailed = replace(kept, coarse=world, detail=middle * kept.detail)
        start = group._start(detailed, coarse, cage)
        moved = group._frames.predict(replace(detailed, coarse=coarse), coarse)[0]
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
    kept = group.solve(list(frame_of(points).garments), None, at=None).carried
    edge = float(group.levels[0].spacing.mean())
    cage = points + np.array([0.0, moved * STILL * edge, 0.0])
    start = group._start(kept, group._tensor(cage - cage.mean(axis=0)), cage)
    assert (start.why, start.still) == ("warm", still)


@pytest.mark.parametrize("contact", [ContactSettings(), ContactSettings("off", cloth="off")])
def test_what_rests_stays_until_it_is_moved_by_more_than_it_rested_with(contact: ContactSettings):
    """The cage is bent by ever more: until twice the tolerance is left, no step is made."""
    made = []
    for bend in np.linspace(0.0, 0.004, 30):
        group, points = group_of(MESH, REST, steps=400, tolerance=1e-3, contact=contact, temporal="warm"), wave(REST)
        kept = group.solve(list(frame_of(points).garments), None, at=None).carried
        points = points + bend * np.sin(20.0 * REST[:, [0]]) * np.array([0.0, 1.0, 0.0])
        (level,) = group.solve(list(frame_of(points).garments), kept, at=None).telemetry["levels"]
        made.append((level["steps"], level["remaining_move"]))
    stayed = [left for steps, left in made if not steps]
    assert max(stayed) > 1.5e-3, made
    assert all(left < 2e-3 for left in stayed)
    assert all(left < 1e-3 for steps, left in made if steps)
    assert len(stayed) < len(made)


class TestTangledStart:
    """A warm start that crosses itself."""

    def test_starts_anew_round_what_crosses_and_nowhere_else(self):
        """Two sheets: a corner of the upper one's carried detail hangs through the lower one."""
        garments = [named(square(8), "A"), named(square(8), "B")]
        levels = levels_of(*garments)
        level, cage = levels[-1], levels[0].rest.clone()
        cage[len(cage) // 2 :, 1] += 0.004
        contact = contact_of(levels, garments, cage, cloth_stiffness=1e5)
        cold = level.base.apply(cage) + torch.tensor([0.0, 0.0, 0.001])
        plain = level.base.apply(cage)
        cloth = contact.at(level).cloth
        assert cloth is not None
        assert not cloth.look(plain).crossings.count
        hung = plain.clone()
        corner = (plain[:, 0] > 0.17) & (plain[:, 2] > 0.17) & (level.vertex_garment == 1)
        hung[corner, 1] -= 0.008
        assert cloth.look(hung).crossings.count
        mixed = contact.mixed(hung, cold)
        assert not cloth.look(mixed).crossings.count
        far = (hung[:, [0, 2]] - 0.2).norm(dim=1) > 2.0 * 8 * 0.5 * EDGE
        assert torch.equal(mixed[far], hung[far])
        assert torch.equal(mixed[corner], cold[corner])
        assert 0 < int(far.sum()) < len(far)

    def test_of_a_shot_goes_through_the_levels(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        """Two frames of the T-shirt whose cages cross themselves; from the last detail alone they stay crossed."""
        shot = open_shot(str(write_sample("tshirt", tmp_path)))

        def left() -> tuple[list[str], list[int]]:
            refiner = Refiner(shot.scene, RefineOptions().solve_settings(), levels=[2])
            told: list[Any] = [refiner.solve(shot.frame(float(time))).telemetry[0] for time in range(7, 10)]
            starts = [str(each["start"]) + str(sorted({level["level"] for level in each["levels"]})) for each in told]
            return starts[1:], [each["contact"]["cloth"]["after"]["crossings"] for each in told[1:]]

        starts, crossing = left()
        assert starts == ["warm: from the coarse levels round what crossed[0, 1, 2]"] * 2
        monkeypatch.setattr(attempts, "TANGLED", np.inf)
        starts, more = left()
        assert starts == ["warm[2]"] * 2
        assert sum(crossing) < 0.2 * sum(more)

    def test_of_a_shot_jumps_less_than_one_that_starts_anew(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        """Ten frames of the skirt whose cage crosses itself; as few of its crossings are left."""
        shot = open_shot(str(write_sample("skirt", tmp_path)))
        ours = run(shot, 35, 10, level=1, settings=ContactSettings())
        monkeypatch.setattr(attempts, "TANGLED", 0.0)
        monkeypatch.setattr(attempts, "BETTER", np.inf)
        anew = run(shot, 35, 10, level=1, settings=ContactSettings())
        assert 0 < ours.jumps < 0.75 * anew.jumps
        assert ours.cloth[1] < 0.1 * ours.cloth[0]
