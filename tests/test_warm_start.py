"""Where frames start from: the last one's detail, a walk of the cage, or anew where a start ended badly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cloth import DOWN, FABRIC, GUIDE, frame_of, group_of, settings_of, sheet, wave
from folds import frame_with, named, refiner_with, square
from shots import refine

from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.solver.collide import search
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.problem import begin
from physgraph_usd.solver.frame.solve import WorseStartError, solve_frame, solve_soundly
from physgraph_usd.solver.frame.start import STILL
from physgraph_usd.solver.frame.state import State
from physgraph_usd.solver.integrate.stop import UNTANGLINGS, WARM_UNTANGLINGS
from physgraph_usd.solver.level import refine_garments
from physgraph_usd.solver.scene import GarmentFrame
from physgraph_usd.solver.seen import normal_angles

MESH, REST = sheet(8, 6)


@pytest.mark.parametrize(("moved", "still"), [(0.9, True), (1.1, False)])
def test_a_pose_is_held_while_its_cage_hardly_moves(moved: float, still: bool):
    group, points = group_of(MESH, REST, level=1), wave(REST)
    state, _ = solve_frame(begin(group, frame_of(points).garments))
    edge = float(group.levels[0].spacing.mean())
    frames = frame_of(points + np.array([0.0, moved * STILL * edge, 0.0])).garments
    start = begin(group, frames, state, moved=0.0).start
    assert (start.reason, start.still_frames) == ("warm", int(still))


def test_what_rests_stays_until_it_is_moved_by_more_than_it_rested_with():
    """The cage is bent by ever more: until twice the tolerance is left, no step is made."""
    group = group_of(MESH, REST, steps=400, tolerance=1e-3, contact=ContactSettings(), temporal="warm")
    (state, _), made = solve_frame(begin(group, frame_of(wave(REST)).garments)), []
    for bend in np.linspace(0.0, 0.001, 15):
        points = wave(REST) + bend * np.sin(20.0 * REST[:, [0]]) * np.array([0.0, 1.0, 0.0])
        levels = solve_frame(begin(group, frame_of(points).garments, state))[1]["levels"]
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


@pytest.fixture(scope="module")
def skirt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample("skirt", tmp_path_factory.mktemp("skirt"))


@pytest.mark.slow
def test_nothing_crosses_in_frames_whose_cages_cross(skirt: Path, tmp_path: Path):
    """Without the earlier frames a contour stays that the cage by itself does not get rid of."""
    options = RefineOptions(frames=(36.0, 37.0), level=1)
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


def test_a_warm_frame_ends_where_nothing_is_seen_to_move():
    """A sheet that is hardly squeezed more ends soon, and its folds stay; one that is squeezed much goes on."""
    mesh, rest = sheet(10, 10)
    group = group_of(mesh, rest, level=1, dtype=torch.float32, steps=200, tolerance=0.0, integrator="physgraph")
    state, _ = solve_frame(begin(group, frame_of(wave(rest)).garments))
    made, further = list[int](), list[float]()
    for squeeze in (0.1001, 0.16):
        frames = frame_of(wave(rest, squeeze=squeeze)).garments
        solved, telemetry = solve_frame(begin(group, frames, state))
        (round_,) = telemetry["levels"]
        assert round_["stopped"] == "seen"
        made.append(round_["steps"])
        rest_of_it, _ = solve_frame(begin(group, frames, solved))
        triangles = group.levels[-1].triangles.numpy()
        further.append(float(np.median(normal_angles(solved.points, rest_of_it.points, triangles))))
    assert 4 <= made[0] < made[1] < 200
    assert max(further) < 1.0  # degrees


def test_a_garment_that_turns_folds_like_one_that_does_not():
    """Curvature goes on from frame to frame in the cloth's own axes. Without gravity a turn changes nothing else."""
    mesh, rest = sheet(10, 10)
    squeezed = [rest * [scale, 1.0, 1.0] + wave(rest) - rest for scale in (0.98, 0.95, 0.92, 0.89)]
    ends = list[np.ndarray]()
    upsampled = np.zeros(0)
    for step in (0.0, 0.5):
        group = group_of(mesh, rest, level=1, dtype=torch.float32, gravity=np.zeros(3), integrator="physgraph")
        state = None
        for number, points in enumerate(squeezed):
            turn = turned_about_y(step * number)
            state, _ = solve_frame(begin(group, [GarmentFrame(points @ turn.T, FABRIC, GUIDE)], state))
        assert state is not None
        ends.append(state.points @ turned_about_y(step * (len(squeezed) - 1)))
        upsampled = group.upsampled([GarmentFrame(squeezed[-1], FABRIC, GUIDE)])[0]
    apart, detail = (np.linalg.norm(ends[0] - other, axis=1) for other in (ends[1], upsampled))
    assert np.median(apart) < 0.02 * np.median(detail)


def turned_about_y(angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])


def test_frames_in_a_row_come_nearer_to_rest_with_the_curvature_of_the_last():
    """A squeezed sheet in four frames of eight steps; the energy above that of many steps, with and without."""
    mesh, rest = sheet(12, 12)
    squeezed = [rest * [scale, 1.0, 1.0] + wave(rest) - rest for scale in (0.97, 0.94, 0.91, 0.88)]

    def energy(steps: int, *, forget: bool) -> float:
        group = group_of(mesh, rest, level=2, dtype=torch.float32, steps=steps, integrator="physgraph")
        state, telemetry = None, dict[str, Any]()
        for points in squeezed:
            state = state if state is None or not forget else replace(state, curvature=None)
            state, telemetry = solve_frame(begin(group, [GarmentFrame(points, FABRIC, GUIDE)], state))
        return sum(telemetry["energy_joules"]["output"].values())

    least = energy(300, forget=False)
    assert energy(8, forget=False) - least < 0.9 * (energy(8, forget=True) - least)


@pytest.mark.slow
def test_layers_that_are_shaken_end_about_as_low_as_by_quasi_newton(sample: Callable[[str], Path], tmp_path: Path):
    """The network, whose steps are nearly all corrected there, ended at three to ten times the energy."""
    ends = []
    for who in ("physgraph", "quasi-newton"):
        report = refine(sample("layers"), tmp_path / f"{who}.usdc", integrator=who, level=2, frames=(6.0, 9.0))
        garments = report.frames[-1]["garments"]
        ends.append(sum(sum(each["energy_joules"]["output"].values()) for each in garments))
    assert ends[0] < 1.3 * ends[1]


@pytest.fixture(scope="module")
def layers() -> tuple[Group, list[GarmentFrame], State]:
    """Two level sheets 2 cm apart, and what their frame leaves to the next."""
    garments = [named(square(6), name) for name in ("Upper", "Lower")]
    cages = [garments[0].rest + np.array([0.0, 0.02, 0.0]), garments[1].rest]
    settings = settings_of(contact=ContactSettings())
    chains = refine_garments(garments, [1, 1])
    group = Group.of(garments, chains, DOWN, settings, dtype=torch.float32, device="cpu")
    frames = [GarmentFrame(cage, FABRIC, GUIDE) for cage in cages]
    return group, frames, solve_frame(begin(group, frames))[0]


def crossings(telemetry: dict[str, Any]) -> int:
    return telemetry["contact"]["cloth"]["after"]["crossings"]


def test_a_warm_frame_searches_few_times(
    layers: tuple[Group, list[GarmentFrame], State], monkeypatch: pytest.MonkeyPatch
):
    """The cage, and the move with its near pairs: what the last frame left is known to be clean."""
    group, frames, state = layers
    searches, search_once = [], search._search
    monkeypatch.setattr(search, "_search", lambda *args, **options: searches.append(1) or search_once(*args, **options))
    _, telemetry = solve_frame(begin(group, frames, state))
    assert len(searches) <= 2 * len(telemetry["levels"])


@pytest.mark.parametrize(("twist", "why"), [(3.0, "it kept "), (0.0, "it ended with ")])
def test_cloth_caught_on_the_wrong_side_is_started_anew(
    layers: tuple[Group, list[GarmentFrame], State], twist: float, why: str
):
    """The last frame had the lower sheet above the upper one, or twisted through it."""
    group, frames, state = layers
    lower, lifted = group.levels[-1].spans[1], torch.zeros_like(state.fine)
    at = state.fine[lower]
    lifted[lower, 1] = (0.02 if twist else 0.04) + twist * at[:, 0] * at[:, 2]
    caught = replace(state, fine=state.fine + lifted, clean=False)
    alone, mended = (solve(begin(group, frames, caught))[1] for solve in (solve_frame, solve_soundly))
    assert ("follows_cage" in alone) == (twist > 0.0)
    assert crossings(alone) == crossings(mended) == 0
    assert "follows_cage" not in mended
    assert mended["start"].startswith(f"cold: started anew, since {why}")
    energies = [sum(each["energy_joules"]["output"].values()) for each in (mended, alone)]
    assert energies[0] < 0.1 * energies[1]


@pytest.fixture(scope="module")
def stuck() -> tuple[Group, list[GarmentFrame]]:
    """Two pressed sheets, held at their borders, that stand in one another: nothing can take them apart."""
    flat = square(16)
    _, rest = flat
    away = np.abs(rest - rest.mean(axis=0)).max(axis=1)
    pins = {"pin": (away > 0.99 * away.max()).astype(float)}
    garments = [named(flat, name, **pins) for name in ("Level", "Upright")]
    settings = settings_of(contact=ContactSettings(), integrator="physgraph", steps=24)
    chains = refine_garments(garments, [1, 1])
    group = Group.of(garments, chains, DOWN, settings, dtype=torch.float32, device="cpu")
    edge = 2.0 * away.max() / 16
    cages = rest, rest[:, [0, 2, 1]] * [1.0, -1.0, 1.0] + edge * np.array([0.2, 0.3, 0.4])
    return group, [GarmentFrame(cage * [0.92, 1.0, 1.0], FABRIC, GUIDE) for cage in cages]


def test_a_level_ends_early_where_crossings_do_not_become_fewer(stuck: tuple[Group, list[GarmentFrame]]):
    """Beside the rounds that untangle, of 4 steps, 25 at the cage and 4 at each level, a level makes 24 steps."""
    _, telemetry = solve_frame(begin(*stuck))
    steps = [sum(report["steps"] for report in telemetry["levels"] if report["level"] == n) for n in (0, 1)]
    assert crossings(telemetry) > 0
    assert steps[0] <= 24 + 4 * (UNTANGLINGS + WARM_UNTANGLINGS)
    assert steps[1] <= 24 + 4 * WARM_UNTANGLINGS


def test_a_start_from_a_cage_that_crosses_as_often_is_dropped(stuck: tuple[Group, list[GarmentFrame]]):
    """Finer levels only cross more often: a result with a single crossing is not to be had from there."""
    with pytest.raises(WorseStartError):
        solve_frame(begin(*stuck), fewer_than=1)
