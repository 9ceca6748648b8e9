"""How many subdivisions a garment gets, by the formula for its buckling wavelength; and whether they were enough."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from cloth import DOWN, FABRIC, frame_of, sheet
from meshes import grid, mesh_of
from sheets import garment_of

from physgraph_usd.shot.warnings import of_folds, of_levels
from physgraph_usd.solver import resolution
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.folds import EDGES_PER_WAVE
from physgraph_usd.solver.level import build_levels
from physgraph_usd.solver.mesh.subdivide import fine_count, subdivide_times
from physgraph_usd.solver.resolution import (
    AUTO,
    LEAST_STRAIN,
    LIMIT,
    MOST,
    SHARP_FRACTION,
    LevelChoice,
    choose_levels,
    finer,
    sample_frames,
    sharp_folds,
)
from physgraph_usd.solver.scene import Frame, Scene

EDGE = 0.05
MESH, REST = sheet(6, 4, EDGE)


def choose(
    squeeze: float, *, level: int = AUTO, fabric: Fabric = FABRIC, times: tuple[float, ...] = (), edge: float = EDGE
) -> tuple[LevelChoice, list[float | None]]:
    """The choice for a sheet squeezed evenly, and the times that were read."""
    rest = REST * edge / EDGE
    read: list[float | None] = []

    def frame_at(time: float | None) -> Frame:
        read.append(time)
        return frame_of((1.0 - squeeze) * rest, time, fabric=fabric)

    scene = Scene((replace(garment_of(MESH, rest), level=level),), DOWN, times)
    return choose_levels(scene, sample_frames(scene.times, frame_at))[0], read


@pytest.mark.parametrize("squeeze", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("bend", [1e-6, 4.7e-6, 1e-4])
def test_a_fifth_of_a_wave_decides(squeeze: float, bend: float):
    choice, _ = choose(squeeze, fabric=replace(FABRIC, bend=bend))
    wave = 2 * math.pi * math.sqrt(bend / (FABRIC.stretch * squeeze))
    mean = EDGE * (6 * 5 + 7 * 4 + 24 * math.sqrt(2)) / (6 * 5 + 7 * 4 + 24)
    assert choice.wavelength == pytest.approx(wave)
    assert choice.edge == pytest.approx(mean / 2**choice.level)
    assert choice.level == MOST or choice.edge <= wave / EDGES_PER_WAVE
    assert choice.level == 0 or 2 * choice.edge > wave / EDGES_PER_WAVE


def test_stiffer_and_finer_cages_need_fewer_levels():
    levels = [choose(0.1, fabric=replace(FABRIC, bend=bend))[0].level for bend in (1e-2, 4e-4, 1e-4, 2.5e-5)]
    assert levels == [0, levels[1], levels[1] + 1, levels[1] + 2]
    halves = [choose(0.1, fabric=replace(FABRIC, bend=2.5e-5), edge=EDGE / n)[0].level for n in (1, 2, 4)]
    assert halves == [levels[3], levels[3] - 1, levels[3] - 2]


def test_cloth_that_is_not_compressed_counts_as_one_per_cent():
    assert choose(-0.2)[0].wavelength == pytest.approx(choose(LEAST_STRAIN)[0].wavelength)


def test_a_level_that_was_asked_for_is_kept():
    choice, _ = choose(0.3, level=1, fabric=replace(FABRIC, bend=1e-7))
    assert choice.level == 1
    assert choice.reason.startswith("as authored or asked for")


@pytest.mark.parametrize("level", [0, 1, 3])
def test_what_is_said_of_a_level_names_the_one_that_would_do_and_its_cost(level: int):
    choice, _ = choose(0.1, level=level, fabric=replace(FABRIC, bend=4e-4))
    enough, _ = choose(0.1, fabric=replace(FABRIC, bend=4e-4))
    assert choice.needed == enough.level == 2
    points = [len(build_levels([garment_of(MESH, REST)], [subdivide_times(MESH, n)])[-1].rest) for n in (level, 2)]
    assert choice.vertices == tuple(points)
    said = f"use --level 2, with edges of {1e3 * enough.edge:.1f} mm, for up to {4 ** max(2 - level, 0)} times the time"
    assert (said in choice.reason) == (level < 2)
    assert f"edges of {1e3 * choice.edge:.1f} mm resolve wrinkles of {5e3 * choice.edge:.1f} mm" in choice.reason


@pytest.mark.parametrize("bend", np.geomspace(1e-7, 1e-3, 9))
def test_a_warning_where_two_edges_are_longer_than_a_wave(bend: float):
    choice, _ = choose(0.1, level=1, fabric=replace(FABRIC, bend=bend))
    said = "".join(of_levels(["/coat"], [choice]))
    assert bool(said) == (choice.wavelength < 2 * choice.edge)
    assert not said or f"use --level {min(choice.needed, LIMIT)}," in said


def test_auto_that_stops_short_says_so():
    choice, _ = choose(0.3, fabric=replace(FABRIC, bend=1e-9))
    assert choice.level == MOST
    assert f"resolve wrinkles of {5e3 * choice.edge:.1f} mm" in choice.reason
    assert "which takes no more than level 4" in choice.reason
    assert "use --level 5, with edges of" in choice.reason
    assert "(the finest, and not all of what is needed)" in choice.reason
    assert f"level {choice.needed}" not in choice.reason


@pytest.mark.parametrize("kind", ["triangles", "quads"])
@pytest.mark.parametrize("level", [0, 1, 3])
def test_vertices_are_counted_without_making_them(kind: str, level: int):
    mesh, _ = grid(4, 3, kind)
    refined = subdivide_times(mesh, level)
    assert fine_count(mesh, level) == (refined[-1].mesh if refined else mesh).vertex_count


def pleated(fold: float) -> float:
    """Share of sharp folds of a sheet pleated by an angle at every column of vertices."""
    mesh, rest = grid(12, 12)
    rise = (rest[:, 0].round().astype(int) % 2) * np.tan(fold / 2.0)
    level = build_levels([garment_of(mesh, rest)], [()], dtype=torch.float64)[0]
    return sharp_folds(level, torch.as_tensor(rest + rise[:, None] * [0.0, 0.0, 1.0]))


def test_sharp_folds_are_counted():
    assert pleated(0.0) == 0.0
    assert pleated(np.radians(30.0)) == 0.0
    assert 0.2 < pleated(np.radians(70.0)) < 0.5


def test_what_cuda_measures_is_what_the_host_does():
    values = np.random.default_rng(2).uniform(size=201).astype(np.float32)
    wanted = dict(zip(("p50", "p99", "max"), np.percentile(values, [50, 99, 100]), strict=True))
    assert resolution._spread(torch.as_tensor(values)) == pytest.approx(wanted, rel=1e-6)


def folds(coat: dict[str, Any], shares: dict[float | None, float]) -> str:
    return "".join(of_folds(coat, {time: {"sharp_folds": share} for time, share in shares.items()}))


def test_a_word_when_folds_are_too_sharp_for_the_mesh():
    coat = {"path": "/coat", "level": 2, "level_needed": 2, "fine_edge_mm": 8.0, "wavelength_mm": 40.0}
    assert not folds(coat, {})
    assert not folds(coat, {1.0: SHARP_FRACTION})
    said = folds(coat, {1.0: 0.0, 7.0: 0.034, 9.0: 0.02})
    assert "</coat> at time code 7: 3% of the edges fold by more than 45 degrees: edges of 8.0 mm" in said
    assert said.endswith(finer(2, 2, 8e-3))
    assert "--level 3, with edges of 4.0 mm, for up to 4 times the time" in said


@pytest.mark.parametrize(("level", "needed", "wave"), [(1, 3, 40.0), (1, 6, 40.0), (2, 0, 99.0), (5, 7, 40.0)])
def test_before_and_after_the_run_one_level_is_named(level: int, needed: int, wave: float):
    coat = {"path": "/coat", "level": level, "level_needed": needed, "fine_edge_mm": 8.0, "wavelength_mm": wave}
    choice = LevelChoice(level, "", 1e-3 * wave, 8e-3, needed, (0, 0))
    said = [choice.advice, folds(coat, {1.0: 0.1}), folds(coat | {"wavelength_mm": 9.0}, {1.0: 0.1})]
    levels = {found for each in said for found in re.findall(r"--level (\d)", each)}
    assert levels <= {str(min(max(needed, level + 1), LIMIT))}
    assert ("raise bendStiffness: level 5 is the finest" in said[0]) == (level == LIMIT)
    if needed > level:
        assert "raise" not in said[2]  # What `of_levels` said before the run is not said again.


def test_few_frames_are_read_first_and_last_among_them():
    _, read = choose(0.1, times=tuple(float(t) for t in range(1001, 1101)))
    assert len(read) <= 5
    assert (read[0], read[-1]) == (1001.0, 1100.0)
    assert choose(0.1)[1] == [None]


@pytest.mark.parametrize("level", [AUTO, 0, 2])
def test_a_garment_without_faces(level: int):
    scene = Scene((replace(garment_of(mesh_of([], 3), np.zeros((3, 3))), level=level),), DOWN, ())
    choice = choose_levels(scene, [frame_of(np.zeros((3, 3)), None)])[0]
    assert choice.level == max(level, 0)


@pytest.mark.parametrize(("stretch", "bend"), [(30.0, 0.0), (0.0, 4.7e-6), (0.0, 0.0)])
def test_fabrics_without_stiffness(stretch: float, bend: float):
    choice, _ = choose(0.1, fabric=Fabric(stretch, bend))
    assert 0 <= choice.level <= MOST
