"""Frames that end with crossings, or above their cage's energy, are started anew."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from cloth import DOWN, FABRIC, GUIDE, settings_of
from folds import named, square

from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.frame import recovery
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.recovery import MOST_WAIT, RunawayError, solve_soundly
from physgraph_usd.solver.frame.solve import solve_frame
from physgraph_usd.solver.frame.values import FrameInput, Solved, State
from physgraph_usd.solver.level import refine_garments
from physgraph_usd.solver.scene import GarmentFrame


@pytest.fixture(scope="module")
def layers() -> tuple[Group, FrameInput, State]:
    """Two level sheets 2 cm apart, and what their frame leaves to the next."""
    garments = [named(square(6), name) for name in ("Upper", "Lower")]
    cages = [garments[0].rest + np.array([0.0, 0.02, 0.0]), garments[1].rest]
    settings = settings_of(contact=ContactSettings())
    chains = refine_garments(garments, [1, 1])
    group = Group.of(garments, chains, DOWN, settings, dtype=torch.float32, device="cpu")
    frame = FrameInput([GarmentFrame(cage, FABRIC, GUIDE) for cage in cages])
    return group, frame, solve_frame(group, frame, None).state


def crossings(solved: Solved) -> int:
    return solved.telemetry["contact"]["cloth"]["after"]["crossings"]


@pytest.mark.parametrize(("twist", "why"), [(3.0, "it kept "), (0.0, "it ended with ")])
def test_cloth_caught_on_the_wrong_side_is_started_anew(
    layers: tuple[Group, FrameInput, State], twist: float, why: str
):
    """The last frame had the lower sheet above the upper one, or twisted through it."""
    group, frame, state = layers
    assert state.fine is not None
    lower, lifted = group.levels[-1].spans[1], torch.zeros_like(state.fine)
    at = state.fine[lower]
    lifted[lower, 1] = (0.02 if twist else 0.04) + twist * at[:, 0] * at[:, 2]
    caught = replace(state, fine=state.fine + lifted, detail=state.detail + lifted.to(state.detail), clean=False)
    alone, mended = solve_frame(group, frame, caught), solve_soundly(group, frame, caught)
    assert (crossings(alone) > 0) == (twist > 0.0)
    assert crossings(mended) == 0
    assert mended.telemetry["start"].startswith(f"cold: started anew, since {why}")
    energies = [sum(each.telemetry["energy_joules"]["output"].values()) for each in (mended, alone)]
    assert energies[0] < 0.1 * energies[1]


def stand_in(monkeypatch: pytest.MonkeyPatch, warm: tuple[int, float], cold: tuple[int, float]) -> list[bool]:
    """Frames that end with given crossings and energies [J], by their start; whether each was warm."""
    made: list[bool] = []

    def solve(_group: Any, _frame: Any, last: State | None) -> Solved:
        made.append(last is not None)
        count, energy = cold if last is None else warm
        told = {"energy_joules": {"input": {"stretch": 1.0, "self_contact": 1.0}, "output": {"stretch": energy}}}
        told |= {"contact": {"cloth": {"after": {"crossings": count}}}, "start": "cold" if last is None else "warm"}
        nothing = torch.zeros(0, 3)
        return Solved([np.zeros((0, 3))], State(nothing, nothing, torch.zeros(0, 3, 3)), told, [])

    monkeypatch.setattr(recovery, "solve_frame", solve)
    return made


@pytest.mark.parametrize(
    ("warm", "cold", "shown"),
    [
        ((0, 0.5), (0, 0.1), "warm"),  # Sound: nothing is tried.
        ((0, 1.5), (0, 0.9), "cold: started anew"),
        ((0, 1.5), (0, 1.7), "warm"),
        ((0, 1.5), (3, 0.1), "warm"),
        ((9, 0.5), (3, 0.9), "cold: started anew"),
        ((9, 0.5), (9, 0.1), "warm"),
    ],
)
def test_the_better_of_two_starts_is_shown(
    layers: tuple[Group, FrameInput, State],
    monkeypatch: pytest.MonkeyPatch,
    warm: tuple[int, float],
    cold: tuple[int, float],
    shown: str,
):
    made = stand_in(monkeypatch, warm, cold)
    assert solve_soundly(*layers).telemetry["start"].startswith(shown)
    assert made == ([True] if warm == (0, 0.5) else [True, False])


def test_cloth_that_runs_away_from_any_start_is_told(
    layers: tuple[Group, FrameInput, State], monkeypatch: pytest.MonkeyPatch
):
    stand_in(monkeypatch, (0, 4.0), (0, 4.0))
    with pytest.raises(RunawayError, match="3 J more than its upsampled cage has, and a start from the cage ends no"):
        solve_soundly(*layers)


def test_starts_that_do_not_help_become_rare(layers: tuple[Group, FrameInput, State], monkeypatch: pytest.MonkeyPatch):
    made, (group, frame, state) = stand_in(monkeypatch, (9, 0.5), (9, 0.5)), layers
    for _ in range(2 * MOST_WAIT):
        state = solve_soundly(group, frame, state).state
    assert made.count(False) == 7  # The first, then after 2, 4, ..., 64 frames.
