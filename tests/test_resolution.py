"""How many subdivisions a garment gets, whether they were enough, and bending where edges are too long for folds."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cloth import DOWN, FABRIC, frame_of, sheet, solved, wave
from folds import levels_of
from meshes import grid
from pxr import Usd
from sheets import garment_of
from stages import add_sheet, author, new_stage, save

from physgraph_usd.shot.findings.table import Facts, texts
from physgraph_usd.shot.report import RefineReport
from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.folds import EDGES_PER_WAVE
from physgraph_usd.solver.level import build_levels, hinge_geometry
from physgraph_usd.solver.mesh.elements import hinges_of
from physgraph_usd.solver.mesh.subdivide import subdivide_times
from physgraph_usd.solver.resolution import AUTO, MOST, LevelChoice, choose_levels, sample_frames, sharp_folds
from physgraph_usd.solver.scene import Frame, Scene
from physgraph_usd.usd.read.reader import open_shot

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


@pytest.mark.parametrize("squeeze", [0.02, 0.3])
@pytest.mark.parametrize("bend", [1e-6, 1e-4])
def test_a_fifth_of_a_wave_decides(squeeze: float, bend: float):
    choice, _ = choose(squeeze, fabric=replace(FABRIC, bend=bend))
    wave = 2 * math.pi * math.sqrt(bend / (FABRIC.stretch * squeeze))
    mean = EDGE * (6 * 5 + 7 * 4 + 24 * math.sqrt(2)) / (6 * 5 + 7 * 4 + 24)
    assert choice.wavelength == pytest.approx(wave)
    assert choice.edge == pytest.approx(mean / 2**choice.level)
    assert choice.level == MOST or choice.edge <= wave / EDGES_PER_WAVE
    assert choice.level == 0 or 2 * choice.edge > wave / EDGES_PER_WAVE


def test_a_level_that_was_asked_for_is_kept():
    choice, _ = choose(0.3, level=1, fabric=replace(FABRIC, bend=1e-7))
    assert choice.level == 1
    assert choice.reason.startswith("as authored or asked for")


@pytest.mark.parametrize("level", [0, 1, 3])
def test_the_level_that_would_do_is_counted_and_what_edges_resolve_said(level: int):
    choice, _ = choose(0.1, level=level, fabric=replace(FABRIC, bend=4e-4))
    enough, _ = choose(0.1, fabric=replace(FABRIC, bend=4e-4))
    assert choice.needed == enough.level == 2
    points = [len(build_levels([garment_of(MESH, REST)], [subdivide_times(MESH, n)])[-1].rest) for n in (level, 2)]
    assert choice.vertices == tuple(points)
    assert f"edges of {1e3 * choice.edge:.1f} mm resolve wrinkles of {5e3 * choice.edge:.1f} mm" in choice.reason


def test_auto_that_stops_short_says_so():
    choice, _ = choose(0.3, fabric=replace(FABRIC, bend=1e-9))
    assert choice.level == MOST
    assert f"resolve wrinkles of {5e3 * choice.edge:.1f} mm" in choice.reason
    assert "which takes no more than level 4" in choice.reason


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


@pytest.mark.parametrize("squeeze", [0.0, 0.005, 0.05])
def test_a_cage_without_slack_is_noted_with_what_makes_folds(squeeze: float):
    choice, _ = choose(squeeze)
    report = RefineReport("s", None, {}, garments=[{"path": "/coat"}])
    said = texts("slack", Facts(report=report, choices=[choice]))
    assert len(said) == (squeeze < 0.01)
    assert not said or said[0].endswith("has no slack: expect what subdivision gives; for folds give --set weftEase=4")
    eased, _ = choose(squeeze, fabric=replace(FABRIC, weft_ease=0.04))
    assert texts("slack", Facts(report=report, choices=[eased])) == []


DENIM = PRESETS["denim"]


def test_stiff_cloth_does_not_crumple_where_its_folds_are_not_resolved():
    mesh, rest = sheet(16, 12, 0.03)
    fine = levels_of(garment_of(mesh, rest))[-1]
    for fabric in (DENIM, PRESETS["silk"]):
        bent = []
        for raised in (True, False):
            answer = solved(mesh, rest, wave(rest), level=1, fabric=fabric, painted={"raises_bending": raised})
            angle, _, _, length = hinge_geometry(answer.points[0], hinges_of(fine.triangles.numpy()))
            bent.append(float((np.abs(angle) * length).sum()))
        assert bent[0] < 0.95 * bent[1]


def test_the_attribute_is_read(tmp_path: Path):
    stage = new_stage(tmp_path / "shot.usda", metres=0.05)
    prim: Usd.Prim = add_sheet(stage, "/World/cloth", times=(1.0, 2.0)).GetPrim()
    path = save(stage)
    for authored, wanted in ((None, True), (False, False)):
        if authored is not None:
            author(prim, "physgraph:refine:raiseBending", authored, kind="bool")
            path = save(stage)
        with closing(open_shot(path, garments=["/World/cloth"])) as shot:
            assert shot.scene.garments[0].raises_bending is wanted
            source = shot.sources[0].sources["refine:raiseBending"]
            assert source == ("fallback" if wanted else "</World/cloth>.physgraph:refine:raiseBending")
