"""What `auto` chooses, that it says so, and that what it chooses is what the named methods do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from cloth import frame_of, refiner_of, sheet, solved, wave
from folds import frame_with, named, refiner_with, square
from sheets import garment_of
from shots import refine

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.frame.problem import LONGER, LONGER_CUDA, Choice, Problem, choose
from physgraph_usd.solver.frame.solve import NEAR, STEPS, TOUCHING
from physgraph_usd.solver.integrate import METHODS


@dataclass
class Cold:
    """What the choice asks of a frame: how crowded its cage is and how far from rest."""

    finest: int
    crowding: float = 0.0
    crossed: bool = False
    remaining: float = 0.3
    warm: bool = False
    device: str = "cpu"
    unresolved: bool = False


def chosen(nested: bool | None, *given: Any, **options: Any) -> Choice:
    return choose(cast(Problem, Cold(*given, **options)), nested)


@pytest.mark.parametrize("nested", [True, False])
def test_a_method_that_says_how_is_taken_at_its_word(nested: bool):
    assert chosen(nested, 1, 1.0) == Choice(nested)
    assert chosen(nested, 1, warm=True) == Choice(False)


@pytest.mark.parametrize(
    ("subdivisions", "crowding", "nested"),
    [(0, 0.0, True), (1, 0.0, False), (1, 0.05, False), (1, 0.2, True), (2, 0.0, True)],
)
def test_the_finest_level_alone_where_one_coarse_level_has_nothing_to_draw_apart(
    subdivisions: int, crowding: float, nested: bool
):
    found = chosen(None, subdivisions, crowding)
    assert found.nested == nested
    assert found.steps == (1 if nested else LONGER)
    assert found.reason


def test_folds_that_the_cage_is_too_coarse_for_go_through_it():
    found = chosen(None, 1, unresolved=True)
    assert (found.nested, found.steps) == (True, 1)
    assert "too coarse" in found.reason
    assert not chosen(None, 1, unresolved=True, warm=True).nested


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("warm", [False, True])
@pytest.mark.parametrize("subdivisions", [0, 1, 2, 3])
def test_the_network_makes_the_steps_unless_the_cage_is_not_subdivided(device: str, warm: bool, subdivisions: int):
    options: dict[str, Any] = {"warm": warm, "device": device}
    for touch in ({}, {"crowding": 0.01}, {"crowding": 1.0, "crossed": True}):
        found = chosen(None, subdivisions, **options, **touch)
        assert found.learned == (subdivisions > 0)
        assert (found.touching < 1.0) == (found.learned and warm)
        assert not chosen(True, subdivisions, **options, **touch).learned


def test_a_warm_frame_is_done_early_only_near_rest(sample: Callable[[str], Path], tmp_path: Path):
    steps = []
    for name, frames in (("torus", (17.0, 20.0)), ("dancer", (20.0, 22.0))):
        report = refine(sample(name), tmp_path / f"{name}.usdc", level=1, steps=12, frames=frames)
        for frame in report.frames[1:]:
            rounds = frame["garments"][0]["levels"]
            steps.append(sum(each["steps"] for each in rounds))
            near = rounds[-1]["remaining_move"] < NEAR * RefineOptions().tolerance
            assert near or rounds[-1]["stopped"] == "stalled" or steps[-1] >= TOUCHING * 12
    assert min(steps) == STEPS
    assert max(steps) > TOUCHING * STEPS


@pytest.mark.slow
def test_layers_that_are_shaken_end_about_as_low_as_by_quasi_newton(sample: Callable[[str], Path], tmp_path: Path):
    """The network, whose steps are nearly all corrected there, ended at three to ten times the energy."""
    ends = []
    for who in ("auto", "quasi-newton"):
        report = refine(sample("layers"), tmp_path / f"{who}.usdc", integrator=who, level=2, frames=(6.0, 9.0))
        garments = report.frames[-1]["garments"]
        ends.append(sum(sum(each["energy_joules"]["output"].values()) for each in garments))
    assert ends[0] < 1.3 * ends[1]


@pytest.mark.parametrize("move", [0.02, 0.3])
def test_on_the_cpu_two_subdivisions_go_through_the_levels_however_near_rest(move: float):
    for subdivisions in (2, 3):
        assert chosen(None, subdivisions, remaining=move).nested
        assert not chosen(None, subdivisions, remaining=move, warm=True).nested


@pytest.mark.parametrize(("move", "crowding", "nested"), [(0.3, 0.0, False), (0.5, 0.0, True), (0.3, 0.5, True)])
def test_on_cuda_coarse_levels_serve_cages_far_from_rest(move: float, crowding: float, nested: bool):
    found = chosen(None, 2, crowding, remaining=move, device="cuda")
    assert (found.nested, found.learned) == (nested, True)
    assert found.steps == (1 if nested else LONGER_CUDA)
    crossed = chosen(None, 2, 1.0, crossed=True, remaining=move, device="cuda")
    assert (crossed.nested, crossed.learned) == (True, True)


def test_refine_leaves_it_open():
    assert RefineOptions().solve_settings().method.nested is None


@pytest.mark.parametrize(("level", "same", "steps"), [(1, "physgraph-flat", 12 * LONGER), (2, "physgraph", 12)])
def test_auto_is_what_it_chose_to_the_bit(level: int, same: str, steps: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(METHODS, "physgraph-flat", replace(METHODS["physgraph"], nested=False))
    mesh, rest = sheet(8, 6)
    own: dict[str, Any] = {"painted": {"raises_bending": False}}
    auto = solved(mesh, rest, wave(rest), level=level, integrator="auto", tolerance=0.0, **own)
    other = solved(mesh, rest, wave(rest), level=level, integrator=same, steps=steps, tolerance=0.0, **own)
    assert np.array_equal(auto.points[0], other.points[0])
    assert auto.telemetry[0]["chosen"].startswith("the finest level alone" if level == 1 else "level by level")
    assert "chosen" not in other.telemetry[0]
    assert sorted({each["level"] for each in auto.telemetry[0]["levels"]}) == ([1] if level == 1 else [0, 1, 2])


@pytest.mark.slow
def test_cloth_near_cloth_goes_through_the_cage_and_is_solved_as_if_never_asked():
    lower, upper = square(8), square(8)
    tilted = upper[1] + np.outer(0.3 * upper[1][:, 0] + 0.003, [0.0, 1.0, 0.0])
    garments = [named(lower, "A", raises_bending=False), named(upper, "B", raises_bending=False)]
    for place in (tilted, upper[1] + [0.0, 0.0005, 0.0]):
        auto, asked = (
            refiner_with(garments, integrator=name).solve(frame_with([lower[1], place]))
            for name in ("auto", "physgraph")
        )
        assert auto.telemetry[0]["chosen"].startswith("level by level: cloth crosses cloth")
        for one, other in zip(auto.points, asked.points, strict=True):
            np.testing.assert_array_equal(one, other)
    far = refiner_with(garments, integrator="auto").solve(frame_with([lower[1], upper[1] + [0.0, 0.02, 0.0]]))
    assert far.telemetry[0]["chosen"].startswith("the finest level alone")


def test_a_warm_frame_chooses_nothing():
    mesh, rest = sheet(8, 6)
    refiner = refiner_of([garment_of(mesh, rest)], times=(0.0, 1.0), integrator="auto")
    cold, warm = (refiner.solve(frame_of(wave(rest, phase=0.01 * t), t)) for t in (0.0, 1.0))
    assert "chosen" in cold.telemetry[0]
    assert warm.telemetry[0]["start"] == "warm"
    assert "chosen" not in warm.telemetry[0]
    assert warm.telemetry[0]["levels"][-1]["steps"] <= 12
