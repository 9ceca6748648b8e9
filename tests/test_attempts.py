"""From which start a frame's result comes: what is tried, and what is taken."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import pytest
import torch
from cloth import frame_of, group_of, sheet, wave

from physgraph_usd.attempts import best_of
from physgraph_usd.contact.settings import ContactSettings
from physgraph_usd.detail import Carried, Solved

INPUT = 100
"""Crossings of the input."""
MESH, REST = sheet(8, 6)


def carried(mark: float) -> Carried:
    """A kept detail that can be told from others."""
    return Carried(torch.full((1, 3), mark), torch.zeros((1, 3)), torch.eye(3).unsqueeze(0))


@dataclass
class Tries:
    """Stands for a frame: each way of starting leaves so many crossings, and strains the cloth so much."""

    left: dict[str, int]
    before: int = INPUT
    strain: dict[str, float] = field(default_factory=dict)
    between: dict[str, int] = field(default_factory=dict)
    made: list[str] = field(default_factory=list)
    given: list[float] = field(default_factory=list)

    def __call__(self, kept: Carried | None, *, anew: bool = False) -> tuple[Solved, float]:
        """One attempt, of ten milliseconds."""
        how = "anew" if anew else "cold" if kept is None else "warm"
        self.made.append(how)
        self.given.append(-1.0 if kept is None else float(kept.coarse[0, 0]))
        counts = {
            "before": {"crossings": self.before},
            "after": {"crossings": self.left[how], "between_garments": self.between.get(how, 0)},
        }
        told: dict[str, Any] = {"start": "cold" if how == "cold" else "warm", "contact": {"cloth": counts}}
        told |= {"milliseconds": {"solve": 10.0}, "how": how}
        return Solved([], carried(1.0 + len(self.made)), told, []), self.strain.get(how, 0.1)

    def taken(self, kept: Carried | None, *, counts: bool = True, again: bool = True) -> str:
        """Which one is taken; the time of all is told, whichever it is."""
        solved = best_of(self, kept, counts=counts, again=again)
        assert solved.telemetry["milliseconds"]["solve"] == 10.0 * len(self.made)
        return solved.telemetry["how"]


@pytest.mark.parametrize(
    ("warm", "anew", "made", "taken"),
    [
        (0, 0, ["warm"], "warm"),
        (5, 0, ["warm"], "warm"),
        (6, 0, ["warm", "anew"], "anew"),
        (40, 30, ["warm", "anew"], "anew"),
        (40, 31, ["warm", "anew"], "warm"),
    ],
)
def test_what_crosses_is_made_anew_where_that_leaves_a_quarter_fewer(warm: int, anew: int, made: list[str], taken: str):
    """Not where few of the input's crossings are left; and from the frame's own result, which keeps all the rest."""
    tries = Tries({"warm": warm, "anew": anew, "cold": 0})
    assert tries.taken(carried(1.0)) == taken
    assert tries.made == made
    assert tries.given == [1.0, 2.0][: len(made)]


@pytest.mark.parametrize(
    ("warm", "anew", "taken"),
    [
        ((3, 1), (3, 0), "anew"),
        ((3, 1), (2, 1), "anew"),
        ((4, 2), (4, 2), "warm"),
        ((3, 2), (4, 0), "warm"),
        ((40, 0), (20, 1), "warm"),
    ],
)
def test_garments_that_cross_are_made_anew_where_less_of_them_does(
    warm: tuple[int, int], anew: tuple[int, int], taken: str
):
    """However few edges do; but not where more crosses in all, nor to have other garments cross."""
    tries = Tries({"warm": warm[0], "anew": anew[0]}, between={"warm": warm[1], "anew": anew[1]})
    assert tries.taken(carried(1.0)) == taken
    assert tries.made == ["warm", "anew"]


@pytest.mark.parametrize(
    ("warm", "anew", "cold", "made", "taken"),
    [
        (120, 110, 80, ["warm", "anew", "cold"], "cold"),
        (120, 110, 150, ["warm", "anew", "cold"], "warm"),
        (120, 60, 0, ["warm", "anew"], "anew"),
        (250, 120, 110, ["warm", "anew", "cold"], "cold"),
        (250, 120, 130, ["warm", "anew", "cold"], "anew"),
    ],
)
def test_more_than_the_input_has_is_tried_from_cold(warm: int, anew: int, cold: int, made: list[str], taken: str):
    """Whichever crosses least is taken then."""
    tries = Tries({"warm": warm, "anew": anew, "cold": cold})
    assert tries.taken(carried(1.0)) == taken
    assert tries.made == made


def test_what_crosses_where_the_input_does_not_is_tried_from_cold():
    """Nothing of the coarse levels would be on its side for certain."""
    tries = Tries({"warm": 2, "anew": 0, "cold": 1}, before=0)
    assert tries.taken(carried(1.0)) == "cold"
    assert tries.made == ["warm", "cold"]


def test_torn_cloth_is_solved_from_cold_and_that_is_taken():
    """Even where more of it crosses; and what starts anew is not taken where it tears."""
    tries = Tries({"warm": 40, "anew": 0, "cold": 60}, strain={"warm": 0.6})
    assert tries.taken(carried(1.0)) == "cold"
    assert tries.made == ["warm", "cold"]
    tries = Tries({"warm": 40, "anew": 0, "cold": 60}, strain={"anew": 0.6})
    assert tries.taken(carried(1.0)) == "warm"
    assert tries.made == ["warm", "anew"]


def test_a_cold_frame_and_one_whose_crossings_do_not_count_are_tried_once():
    """What is only measured is no reason."""
    tries = Tries({"warm": 40, "anew": 0, "cold": 200})
    assert tries.taken(None) == "cold"
    assert tries.made == ["cold"]
    tries = Tries({"warm": 200, "anew": 0, "cold": 0})
    assert tries.taken(carried(1.0), counts=False) == "warm"
    assert tries.made == ["warm"]


def test_without_time_nothing_is_solved_on():
    """What must be solved from cold is."""
    tries = Tries({"warm": 40, "anew": 0, "cold": 0})
    assert tries.taken(carried(1.0), again=False) == "warm"
    assert tries.made == ["warm"]
    tries = Tries({"warm": 120, "anew": 0, "cold": 0})
    assert tries.taken(carried(1.0), again=False) == "cold"
    assert tries.made == ["warm", "cold"]


@pytest.mark.parametrize(
    ("cloth", "budget_ms", "made"),
    [("pairs", None, ["warm", "anew", "cold"]), ("pairs", 1e6, ["warm", "cold"]), ("off", None, ["warm"])],
)
def test_a_group_tries_what_its_settings_say(
    monkeypatch: pytest.MonkeyPatch, cloth: str, budget_ms: float | None, made: list[str]
):
    """Crossings count where cloth touches cloth, a budget is for one solve; the start is told with its reason."""
    group, frames = group_of(MESH, REST, level=1), list(frame_of(wave(REST)).garments)
    kept = group.solve(frames, None, at=None).carried
    group.use(replace(group._settings, contact=ContactSettings(cloth=cloth), budget_ms=budget_ms))
    tries = Tries({"warm": 120, "anew": 110, "cold": 80})
    monkeypatch.setattr(group, "_attempt", lambda _f, _at, _on, _moved, kept, *, anew=False: tries(kept, anew=anew))
    told = group.solve(frames, kept, at=None).telemetry
    assert tries.made == made
    assert told["start"] == (
        "warm" if cloth == "off" else "cold: the last frame's detail made 120 edges cross, 100 in the input"
    )
