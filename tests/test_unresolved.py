"""Bending is raised where edges are too long for a fabric's folds, and only there."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cloth import sheet, solved, wave
from folds import levels_of
from pxr import Usd
from sheets import garment_of
from stages import add_sheet, author, new_stage, save

from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.folds import EDGES_PER_WAVE, FOLDING, carried_bend, raised_by
from physgraph_usd.solver.forces import elastic_terms
from physgraph_usd.solver.forces.bending import Bending
from physgraph_usd.solver.level import Level, build_levels, hinge_geometry, refine_garments
from physgraph_usd.solver.mesh.elements import hinges_of
from physgraph_usd.usd.read.reader import open_shot

DENIM = PRESETS["denim"]


def level_of(edge: float, **fields: object) -> Level:
    garment = replace(garment_of(*sheet(6, 6, edge)), **fields)
    return build_levels([garment], refine_garments([garment], [0]))[0]


def weight(level: Level, fabric: Fabric, *, raised: bool) -> torch.Tensor:
    terms = elastic_terms(level, [fabric], raised=[raised])
    return next(each for each in terms if isinstance(each, Bending)).weight


@pytest.mark.parametrize("fabric", PRESETS.values(), ids=PRESETS)
def test_the_stiffness_raised_folds_in_five_edges(fabric: Fabric):
    edge = 0.02
    stiffest = max(fabric.stretch, fabric.weft_stretch or 0.0)
    wave = 2.0 * math.pi * math.sqrt(carried_bend(fabric, edge) / (stiffest * FOLDING))
    assert wave == pytest.approx(EDGES_PER_WAVE * edge)


def test_fine_edges_have_the_fabrics_own_bending_to_the_bit():
    level = level_of(0.004)
    assert raised_by(DENIM, 0.004) == 1.0
    assert torch.equal(weight(level, DENIM, raised=True), weight(level, DENIM, raised=False))


def test_long_edges_bend_less_and_each_by_its_own_length():
    level = level_of(0.05)
    own, raised = weight(level, DENIM, raised=False), weight(level, DENIM, raised=True)
    edge = level.spacing[level.hinges[:, :2].long()].mean(dim=1)
    torch.testing.assert_close(raised / own, carried_bend(DENIM, edge) / torch.full_like(edge, DENIM.bend))
    assert raised.max() / raised.min() > own.max() / own.min()


def test_paint_that_stiffens_cloth_shortens_its_folds():
    level = level_of(0.05, stretch_scale=np.full(49, 4.0))
    plain = weight(level_of(0.05), DENIM, raised=True)
    torch.testing.assert_close(weight(level, DENIM, raised=True), 4.0 * plain)


def test_cloth_that_never_bends_stays():
    level, fabric = level_of(0.05), replace(DENIM, bend=0.0)
    assert torch.equal(weight(level, fabric, raised=False), weight(level, fabric, raised=True))


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
