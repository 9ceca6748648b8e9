"""Grain, ease and the triangle membrane: where warp lies, cloth longer than its rest shape, stiffness in shear."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from meshes import grid
from probes import bending_stiffness, plane_stiffness
from pxr import Sdf, Usd, UsdGeom, Vt
from sheets import equilateral, garment_of, level_of, triangle_mesh

from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.forces import elastic_terms
from physgraph_usd.solver.forces.bending import Bending
from physgraph_usd.solver.forces.membrane import in_plane_terms
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.problem import begin
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.frame.solve import solve_frame
from physgraph_usd.solver.integrate import method_named
from physgraph_usd.solver.level import Level, build_levels, refine_garments
from physgraph_usd.solver.mesh.weld import unwelded
from physgraph_usd.solver.scene import Frame, GarmentFrame, Grain, Scene
from physgraph_usd.usd.read.grain import read_grain, unevenness

ALONG = np.array([1.0, 0.0, 0.0])
WOVEN = Fabric(1000.0, 20e-6, 0.3, shear=70.0, weft_stretch=250.0, weft_bend=8e-6)


def sheet(warp: np.ndarray = ALONG, *, edge: float = 0.01) -> Level:
    points, triangles = equilateral(0.16, 0.16, edge)
    return level_of(points, triangles, warp=warp)


def turned(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle), 0.0])


@pytest.mark.parametrize("angle", [0.4, np.pi / 2])
def test_a_woven_sheet_has_the_stiffness_matrix_of_an_orthotropic_one(angle: float):
    """In its own axes C11 = Y1 / (1 - nu^2), C22 = Y2 / (1 - nu^2), C12 = nu sqrt(C11 C22), C66 = G, with nu = 1/3."""
    found = plane_stiffness(sheet(turned(angle)), in_plane_terms(sheet(turned(angle)), [WOVEN]))
    c, s = np.cos(angle), np.sin(angle)
    strain = np.array([[c * c, s * s, -c * s], [s * s, c * c, c * s], [2 * c * s, -2 * c * s, c * c - s * s]])
    own = strain.T @ found @ strain
    c11, c22 = 1000.0 * 9 / 8, 250.0 * 9 / 8
    c12 = np.sqrt(c11 * c22) / 3.0
    assert own == pytest.approx(np.array([[c11, c12, 0], [c12, c22, 0], [0, 0, 70.0]]), rel=1e-4, abs=1e-3 * c22)


def test_a_sheet_bends_along_warp_and_weft_as_asked_for():
    """On a regular lattice it depends on how that lies, by a quarter of the difference; in the mean it does not."""
    found = []
    for angle in (0.0, np.pi / 6):
        c, s = np.cos(angle), np.sin(angle)
        strain = np.array([[c * c, s * s, -c * s], [s * s, c * c, c * s], [2 * c * s, -2 * c * s, c * c - s * s]])
        own = strain.T @ bending_of(sheet(turned(angle))) @ strain
        found.append(own.diagonal()[:2])
    assert np.mean(found, axis=0) == pytest.approx([20e-6, 8e-6], rel=0.02)
    assert np.ptp(found, axis=0).max() < 0.51 * 12e-6


def bending_of(level: Level) -> np.ndarray:
    """The stiffness for curvatures of a sheet whose weft is softer."""
    weighed = Bending(level, torch.tensor([20e-6], dtype=torch.float64), weft=[8e-6]).weight
    plain = Bending(level, torch.tensor([20e-6], dtype=torch.float64)).weight
    return bending_stiffness(replace(level, bend_scale=level.bend_scale * weighed / plain), 20e-6)


@pytest.mark.parametrize("fabric", [Fabric(100.0), WOVEN], ids=["springs", "membrane"])
def test_eased_cloth_is_at_rest_where_it_is_that_much_longer(fabric: Fabric):
    eased = replace(fabric, warp_ease=0.04, weft_ease=-0.01)
    level = sheet(turned(0.3)).eased([eased])
    terms = elastic_terms(level, [eased])
    warp, weft = turned(0.3), turned(0.3 + np.pi / 2)
    longer = np.eye(3) + 0.04 * np.outer(warp, warp) - 0.01 * np.outer(weft, weft)
    x = level.rest @ torch.as_tensor(longer)
    at_rest = sum(float(term.add_force(x, torch.zeros_like(x))) for term in terms)
    before = sum(float(term.add_force(level.rest, torch.zeros_like(x))) for term in terms)
    assert at_rest < 1e-12 * before + 1e-15


def test_gathers_and_painted_ease_act_where_they_are_painted():
    points, triangles = equilateral(0.16, 0.16, 0.02)
    mesh = triangle_mesh(triangles, len(points))
    half = (points[:, 0] > 0.08).astype(float)
    grain = Grain(np.broadcast_to(ALONG, (mesh.face_count, 3)), half, 0.5 * (1 - half))
    garment = replace(garment_of(mesh, points), grain=grain)
    level = build_levels([garment], refine_garments([garment], [1]), dtype=torch.float64)[-1]
    ratio = (level.eased([Fabric(warp_ease=0.1)]).rest_length / level.rest_length).numpy()
    middle = level.rest.numpy()[level.edges.numpy()].mean(axis=1)[:, 0]
    span = np.diff(level.rest.numpy()[level.edges.numpy()], axis=1)[:, 0]
    flat = np.abs(span[:, 1]) < 1e-9
    assert ratio[flat & (middle > 0.11)] == pytest.approx(1.1)
    assert ratio[flat & (middle < 0.05)] == pytest.approx(1.0)
    inside = (middle > 0.03) & (middle < 0.05)  # Smooth subdivision turns edges at the jagged rim.
    assert (ratio[~flat & inside] > 1.3).all()


def garment_with(values: np.ndarray | None, *, name: str = "st", turn: float = 0.0) -> tuple[Grain, str]:
    """The grain that is read of an upright sheet with texture coordinates."""
    points, triangles = equilateral(0.2, 0.2, 0.05)
    points = points[:, [0, 2, 1]]  # Upright: y of the sheet is z.
    stage = Usd.Stage.CreateInMemory()
    usd = UsdGeom.Mesh.Define(stage, "/Cloth")
    usd.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    usd.CreateFaceVertexCountsAttr([3] * len(triangles))
    usd.CreateFaceVertexIndicesAttr(triangles.ravel().tolist())
    if values is not None:
        primvar = UsdGeom.PrimvarsAPI(usd).CreatePrimvar(name, Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
        primvar.Set(Vt.Vec2fArray.FromNumpy(values.astype(np.float32)))
    mesh, one = triangle_mesh(triangles, len(points)), np.ones(len(points))
    painted = {"easeScale": one, "gather": 0 * one, "grain": turn * one}
    kept, up = np.arange(len(triangles)), np.array([0.0, 0.0, 1.0])
    return read_grain(usd.GetPrim(), unwelded(mesh), points, kept=kept, up=up, painted=painted)


def flat_points() -> np.ndarray:
    return equilateral(0.2, 0.2, 0.05)[0]


def test_warp_lies_along_v_of_a_pattern():
    angle = 0.5
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    grain, source = garment_with(3.0 * flat_points()[:, :2] @ turn)
    assert grain.warp == pytest.approx(np.tile([-np.sin(angle), 0.0, np.cos(angle)], (len(grain.warp), 1)), abs=1e-5)
    assert source == "v of primvars:st"


def test_warp_runs_down_the_cloth_where_texture_coordinates_are_no_pattern():
    squeezed = flat_points()[:, :2] * [1.0, 0.1]
    for values in (None, squeezed):
        grain, source = garment_with(values)
        assert grain.warp == pytest.approx(np.tile([0.0, 0.0, -1.0], (len(grain.warp), 1)), abs=1e-9)
        assert source == "the rest shape, downwards"


def test_the_grain_map_turns_the_warp():
    grain, source = garment_with(None, turn=90.0)
    assert np.abs(grain.warp[:, 0]) == pytest.approx(np.ones(len(grain.warp)))
    assert "turned" in source


def test_ease_folds_cloth_whose_cage_is_at_rest():
    """Without ease a flat cage at its rest shape has nothing to fold; with it, folds run across the longer way."""
    points, triangles = equilateral(0.3, 0.3, 0.03)
    mesh, one = triangle_mesh(triangles, len(points)), np.ones(len(points))
    grain = Grain(np.broadcast_to(ALONG, (mesh.face_count, 3)), one, 0 * one)
    garment = replace(garment_of(mesh, points), grain=grain, level=2)
    bumps = {}
    for ease in (0.0, 0.04):
        refiner = Refiner(Scene((garment,), np.zeros(3)), SolveSettings())
        fine = refiner.solve(Frame(None, (GarmentFrame(points, Fabric(warp_ease=ease)),))).garments[0].points
        assert fine is not None
        height = fine[:, 2].copy()
        bumps[ease] = np.abs(height).max()
    level = build_levels([garment], refine_garments([garment], [2]), dtype=torch.float64)[-1]
    ends = level.edges.numpy()
    span, rise = np.diff(level.rest.numpy()[ends], axis=1)[:, 0], np.diff(height[ends], axis=1)[:, 0]
    slope = (rise / np.linalg.norm(span, axis=1)) ** 2
    along = np.abs(span[:, 0]) > 0.9 * np.linalg.norm(span, axis=1)
    assert bumps[0.0] < 1e-5
    assert bumps[0.04] > 1e-3
    assert slope[along].mean() > 1.5 * slope[~along].mean()


def test_folds_are_where_the_uneven_ease_is():
    """Even ease folds both halves of a sheet alike; uneven ease folds more where there is more of it."""
    points, triangles = equilateral(0.3, 0.3, 0.02)
    mesh = triangle_mesh(triangles, len(points))
    uneven = unevenness(mesh, points)
    ratio = []
    for scale in (np.ones(len(points)), uneven):
        grain = Grain(np.broadcast_to(ALONG, (mesh.face_count, 3)), scale, 0 * scale)
        garment = replace(garment_of(mesh, points), grain=grain, level=1)
        refiner = Refiner(Scene((garment,), np.zeros(3)), SolveSettings())
        fine = refiner.solve(Frame(None, (GarmentFrame(points, Fabric(warp_ease=0.04)),))).garments[0].points
        assert fine is not None
        level = build_levels([garment], refine_garments([garment], [1]), dtype=torch.float64)[-1]
        ends = level.edges.numpy()
        slope = (np.diff(fine[:, 2][ends], axis=1)[:, 0] / level.rest_length.numpy()) ** 2
        much = (level.from_coarse @ uneven)[ends].mean(axis=1) > 1.0
        ratio.append(slope[much].mean() / slope[~much].mean())
    assert ratio[1] > 1.5 * ratio[0]


def test_uneven_ease_has_mean_one_and_goes_by_the_shape_alone():
    points, triangles = equilateral(0.6, 0.6, 0.02)
    mesh = triangle_mesh(triangles, len(points))
    found = unevenness(mesh, points)
    assert found.mean() == pytest.approx(1.0)
    assert found.min() > 0.0
    assert found.std() > 0.3
    assert np.corrcoef(found[mesh.half_edges.edges].T)[0, 1] > 0.7  # That of the waves is sin(k) / k, k = 2 pi / 6.
    assert unevenness(mesh, 100.0 * points + [5.0, -3.0, 2.0]) == pytest.approx(found)


def test_cloth_without_ease_is_the_same_whatever_its_uneven_ease():
    points, triangles = equilateral(0.16, 0.16, 0.02)
    mesh = triangle_mesh(triangles, len(points))
    lengths = []
    for scale in (np.ones(len(points)), unevenness(mesh, points)):
        grain = Grain(np.broadcast_to(ALONG, (mesh.face_count, 3)), scale, np.full(len(points), 0.3))
        garment = replace(garment_of(mesh, points), grain=grain)
        level = build_levels([garment], refine_garments([garment], [1]))[-1]
        lengths.append(level.eased([Fabric()]).spring_length)
    assert torch.equal(*lengths)


SPRINGS, TRIANGLES = Fabric(30.0), Fabric(30.0, shear=7.0)


def test_a_mixed_group_is_what_its_garments_are_alone():
    """Pulled, so that there is one rest state."""
    mesh, points = grid(6, 6)
    points = 0.03 * points
    bump = 0.01 * np.sin(20 * points[:, 1])
    pulled = points * [1.15, 1.02, 1.0] + np.stack([0 * bump, 0 * bump, bump], axis=1)
    frames = [GarmentFrame(pulled, SPRINGS), GarmentFrame(pulled + np.array([1.0, 0, 0]), TRIANGLES)]
    settings = SolveSettings(method_named("quasi-newton"), steps=100, tolerance=1e-5)

    def solve(chosen: list[GarmentFrame]) -> tuple[list[np.ndarray], dict[str, float]]:
        garments = [garment_of(mesh, points) for _ in chosen]
        refinements = refine_garments(garments, [1] * len(garments))
        group = Group.of(garments, refinements, np.array([0, 0, -9.81]), settings, dtype=torch.float32, device="cpu")
        solved, telemetry = solve_frame(begin(group, chosen))
        return group.per_garment(solved.points), telemetry["energy_joules"]["output"]

    together, energies = solve(frames)
    assert {"stretch", "membrane"} <= set(energies)
    for shape, frame, term, other in zip(
        together, frames, ("stretch", "membrane"), ("membrane", "stretch"), strict=True
    ):
        alone, energy = solve([frame])
        assert energy[term] == pytest.approx(energies[term], rel=1e-3)
        assert other not in energy
        assert np.abs(shape - alone[0]).max() < 0.01 * 0.015


@pytest.mark.parametrize("shear", [None, 5.0])
def test_the_report_says_which_garments_are_membranes(sample: Callable[[str], Path], shear: float | None):
    overrides = () if shear is None else (f"physgraph:material:shearStiffness={shear}",)
    report = inspect_shot(sample("tshirt"), overrides=overrides)
    path = report["garments"][0]["path"]
    if shear is None:
        assert report["modelled"]["stretch"] == "edge springs"
        assert "membrane" not in report["modelled"]
        assert "0.375 Y" in report["left_out"]["triangle membrane"]
    else:
        assert report["modelled"]["membrane"] == f"triangle membrane for {path}"
        assert "stretch" not in report["modelled"]
        assert not {"shear", "triangle membrane"} & set(report["left_out"])
