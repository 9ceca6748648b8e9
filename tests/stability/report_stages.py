"""Measurements of the stability report that no integrator decides: stages, meshes, forces and probes."""

from __future__ import annotations

import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from calibration import BENT, expected_cantilever, measure_bend, measure_cantilever, measure_plane
from cloth import refiner_of, sheet, solved, wave
from energies import apart, difference_force, evaluate
from pxr import Usd, UsdGeom
from report_solver import EDGE, Result, under
from sheets import KINDS, garment_of, level_of
from shots import CLOTH, TIMES, cloth_shot, faults, fine, refine, sample_times
from test_forces import crumple, force_of
from test_forces_folds import TRIANGLES, hinge
from test_guard import PROPOSALS, descent, problem

from physgraph_usd.errors import GarmentError
from physgraph_usd.shot.findings.table import Facts, texts
from physgraph_usd.shot.report import RefineReport
from physgraph_usd.solver.fabric import Fabric


def s5_broken_point(method: str) -> Result:
    """Frames that a NaN in one point of another frame changes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        clean, dirty = cloth_shot(folder / "clean.usdc"), cloth_shot(folder / "dirty.usdc")
        stage = Usd.Stage.Open(str(dirty))
        attribute = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr()
        points = np.array(attribute.Get(3.0))
        points[11, 1] = np.nan
        attribute.Set(type(attribute.Get(3.0)).FromNumpy(points), 3.0)
        stage.Save()
        refine(clean, folder / "c.usdc", temporal="off", integrator=method)
        refine(dirty, folder / "d.usdc", temporal="off", integrator=method)
        pairs = {t: (fine(clean, folder / "c.usdc", t), fine(dirty, folder / "d.usdc", t)) for t in TIMES}
    changed = sum(not np.array_equal(a, b) for t, (a, b) in pairs.items() if t != 3.0)
    finite = all(bool(np.isfinite(b).all()) for _, b in pairs.values())
    return Result(changed == 0 and finite, f"{changed} of {len(TIMES) - 1} changed")


def s14_folds() -> Result:
    """Largest relative error of the gradient of a hinge up to and past half a turn."""
    worst = 0.0
    for angle in (np.pi - 1e-2, np.pi - 1e-4, np.pi + 1e-2, -np.pi + 1e-4):
        force = force_of("bending", level_of(hinge(3.0), TRIANGLES, bent=True))
        x = torch.as_tensor(hinge(angle))
        worst = max(worst, apart(evaluate(force, x)[1], difference_force(force, x, 1e-5)))
    return under(worst, 1e-4, " relative error")


def s16_rest_shapes() -> Result:
    """Rest shapes that cannot be, refused by name."""
    refused = 0
    for bad in ("1e24", "nan", "inf"):
        mesh, rest = sheet(3, 2)
        rest[5] = float(bad)
        try:
            refiner_of([garment_of(mesh, rest)])
        except GarmentError as error:
            refused += "</World/Sheet>" in str(error)
    return Result(refused == 3, f"{refused} of 3 refused")


def s31_times(method: str) -> Result:
    """Whether samples lie exactly at the authored times, with gaps and between frames."""
    times = (1.0, 2.0, 7.0, 8.0, 8.0 + 1.0 / 3.0)
    with tempfile.TemporaryDirectory() as name:
        shot = cloth_shot(Path(name) / "shot.usdc", times=times)
        refine(shot, Path(name) / "fine.usdc", integrator=method)
        written = sample_times(Path(name) / "fine.usdc")
    return Result(written == times, "exact" if written == times else f"{written}")


def s32_topology() -> Result:
    """A frame of another number of points: named, left out, and the layer valid."""
    with tempfile.TemporaryDirectory() as name:
        shot = cloth_shot(Path(name) / "shot.usdc")
        stage = Usd.Stage.Open(str(shot))
        attribute = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr()
        attribute.Set(attribute.Get(4.0)[:-1], 4.0)
        stage.Save()
        report = refine(shot, Path(name) / "fine.usdc")
        wrong = faults(Path(name) / "fine.usdc", shot)
    named = list(report.failed) == ["4"] and CLOTH in report.failed["4"]
    return Result(named and not wrong, "named, others written" if named else str(report.failed))


def s37_adversary() -> Result:
    """Steps that raise the energy under a guard, over every adversary of tests/stability/test_guard.py."""
    rises = 0
    for propose in PROPOSALS.values():
        system, x = problem(torch.float32)
        carries = descent(system, x, propose)
        rises += sum(b.energy > a.energy for a, b in pairwise(carries))
    return Result(rises == 0, f"{rises} rises, {len(PROPOSALS)} adversaries")


def s38_analytic() -> Result:
    """Worst error of Y, D and the cantilever's angle on three kinds of mesh."""
    errors = {
        "Y": max(abs(measure_plane(kind, None).youngs.mean - 1.0) for kind in BENT),
        "D": max(abs(measure_bend(kind).rigidity.mean - 1.0) for kind in BENT),
        "angle": max(abs(measure_cantilever(kind)[0] / expected_cantilever(nu) - 1.0) for kind, nu in BENT.items()),
    }
    said = ", ".join(f"{name} {100 * error:.1f} %" for name, error in errors.items())
    return Result(max(errors.values()) <= 0.05, said)


def s39_locking() -> Result:
    """Cloth that buckles in waves of half an edge to eight edges: which of them are noted."""
    warned = []
    for edges in (0.5, 1.0, 2.0, 3.0, 8.0):
        mesh, rest = sheet(8, 6, EDGE)
        bend = 300.0 * 0.2 * (edges * 0.5 * EDGE / (2.0 * np.pi)) ** 2
        fabric = Fabric(300.0, bend, 0.187)
        state = solved(mesh, rest, wave(rest, squeeze=0.2), fabric=fabric, level=1, steps=40)
        sheets = [{"path": "/World/Sheet", "level": 1, "fine_edge_mm": 500.0 * EDGE}]
        frames = [{"time": None, "garments": [state.telemetry[0]]}]
        report = RefineReport("s", None, {}, garments=sheets, frames=frames)
        warned += [edges] * len(texts("folds", Facts(report=report)))
    return Result(warned == [0.5, 1.0, 2.0, 3.0], f"noted at {', '.join(f'{each:g}' for each in warned)} edges a wave")


def s40_gradients() -> Result:
    """Largest relative error of a force against differences of its energy, float64."""
    worst = 0.0
    for name in ("stretch", "membrane", "bending", "gravity", "guide", "tether"):
        for kind, make in KINDS.items():
            points, triangles = make(0.4, 0.3, 0.1)
            force, x = force_of(name, level_of(points, triangles)), crumple(points, 0.01, len(kind))
            worst = max(worst, apart(evaluate(force, x)[1], difference_force(force, x, 2e-4)))
    return under(worst, 1e-6, " relative error")
