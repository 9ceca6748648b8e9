"""Fabrics of material subsets: their values hold on their faces, in bending, stretch and mass."""

from pathlib import Path

import numpy as np
import pytest
from meshes import quads_of
from pxr import Sdf, Usd, UsdGeom
from shots import fine, refine
from stages import add_mesh, add_subset, author, new_stage, said, save, vec3

from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.usd.read.reader import open_shot

CLOTH, SIDE, EDGE = "/World/cloth", 10, 0.03
FACES = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
"""Faces of the sheet, by their rows and columns."""
LEFT, RIGHT = (FACES[:, half].ravel() for half in (slice(None, SIDE // 2), slice(SIDE // 2, None)))
BEND = "physgraph:material:bendStiffness"


def grid(*, squeezed: float = 1.0, upright: bool = False) -> np.ndarray:
    """Points of a sheet [m], by columns; squeezed along x it has a slight wave."""
    x, y = np.meshgrid(EDGE * np.arange(SIDE + 1.0), EDGE * np.arange(SIDE + 1.0))
    wave = (squeezed < 1.0) * 0.004 * np.sin(2.0 * np.pi * x / (4.0 * EDGE))
    points = [squeezed * x, y, wave] if upright else [squeezed * x, wave, -y]
    return np.stack(points, axis=-1).reshape(-1, 3)


def sheet(path: Path, *times: np.ndarray) -> Usd.Stage:
    """A sheet with points at time codes 1, 2 and so on."""
    stage = new_stage(path)
    mesh = add_mesh(stage, CLOTH, times[0], quads_of(SIDE + 1, SIDE + 1))
    for time, points in enumerate(times):
        mesh.GetPointsAttr().Set(vec3(points), time + 1.0)
    return stage


def refined(stage: Usd.Stage, folder: Path, time: float, **options: object) -> np.ndarray:
    """World points [m] of the cage's vertices in the refined layer, by rows and columns."""
    shot = Path(save(stage))
    refine(shot, folder / "fine.usdc", **{"level": 1, "steps": 60} | options)
    return fine(shot, folder / "fine.usdc", time, prim=CLOTH)[: (SIDE + 1) ** 2].reshape(SIDE + 1, SIDE + 1, 3)


def bent(points: np.ndarray) -> tuple[float, float]:
    """Mean second difference along x of the left and the right half [m], without the row between."""
    second = np.linalg.norm(points[:, 2:] - 2.0 * points[:, 1:-1] + points[:, :-2], axis=2).mean(axis=0)
    half = len(second) // 2
    return float(second[:half].mean()), float(second[half + 1 :].mean())


@pytest.mark.parametrize("kind", ["material", "proposal", "subset"])
def test_a_stiff_subset_folds_less(tmp_path: Path, kind: str):
    stage = sheet(tmp_path / "s.usda", grid(), grid(squeezed=0.93))
    values = {"material": {"bendStiffness": 1e-3}, "proposal": {"physics_surfaceBendStiffness": 1e-3}, "subset": {}}
    add_subset(stage, "leather", RIGHT, **values[kind])
    if kind == "subset":
        author(stage.GetPrimAtPath(f"{CLOTH}/leather"), BEND, 1e-3)
    left, right = bent(refined(stage, tmp_path, 2.0, rest_frame=1.0))
    assert right < 0.7 * left


def test_a_heavy_subset_sinks(tmp_path: Path):
    stage = sheet(tmp_path / "s.usda", grid())
    add_subset(stage, "wet", RIGHT, density=2.0)
    height = refined(stage, tmp_path, 1.0)[..., 1]
    assert height[:, -3:].mean() < height[:, :3].mean() - 5e-3


def test_a_soft_subset_hangs_longer(tmp_path: Path):
    stage = sheet(tmp_path / "s.usda", grid(upright=True))
    add_subset(stage, "elastic", RIGHT, stretchStiffness=2.0)
    held = [float(each // (SIDE + 1) == SIDE) for each in range((SIDE + 1) ** 2)]
    pin = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(CLOTH)).CreatePrimvar(
        "physgraph:pin", Sdf.ValueTypeNames.FloatArray, "vertex"
    )
    pin.Set(held)
    hem = refined(stage, tmp_path, 1.0, overrides=["guide:stiffness=20"])[0, :, 1]
    assert hem[-1] < hem[0] - 4e-3


def test_the_fabric_of_most_faces_is_the_garments_and_others_are_multiples(tmp_path: Path):
    stage = sheet(tmp_path / "s.usda", grid())
    add_subset(stage, "body", FACES[:, :8].ravel(), bendStiffness=2e-5, thickness=5e-4)
    add_subset(stage, "trim", FACES[:, 8:].ravel(), bendStiffness=1e-4, thickness=2e-3, shearStiffness=9.0)
    found = inspect_shot(save(stage))
    (garment,) = found["garments"]
    assert garment["fabric"]["bend"] == pytest.approx(2e-5)
    assert garment["sources"]["thickness"] == "</World/looks/body>.physgraph:material:thickness"
    assert garment["sources"]["bendStiffness of trim"] == f"</World/looks/trim>.{BEND}"
    note = f"<{CLOTH}/trim>: 20 faces of another fabric: bendStiffness times 5; not used: its shearStiffness, thickness"
    assert note in found["notes"]
    shot = open_shot(save(stage), overrides=["bendStiffness=4e-5"])
    assert shot.frame(1.0).garments[0].fabric.bend == pytest.approx(4e-5)
    scale = shot.scene.garments[0].fabric_scale
    assert scale is not None
    assert np.unique(scale[:, 1]) == pytest.approx([1.0, 5.0])


def test_faces_of_no_subset_keep_the_fallbacks(tmp_path: Path):
    stage = sheet(tmp_path / "s.usda", grid())
    add_subset(stage, "leather", FACES[:, 2:].ravel(), density=0.65)
    shot = open_shot(save(stage))
    fabric, scale = shot.frame(1.0).garments[0].fabric, shot.scene.garments[0].fabric_scale
    assert scale is not None
    assert fabric.density * scale[FACES[0], 2] == pytest.approx([Fabric().density] * 2 + [0.65] * 8)


def test_materials_without_values_leave_the_garments(tmp_path: Path):
    stage = sheet(tmp_path / "s.usda", grid())
    author(stage.GetPrimAtPath(CLOTH), BEND, 1e-4)
    add_subset(stage, "front", LEFT)
    add_subset(stage, "back", RIGHT, bendStiffness=1e-3)  # The garment's own value comes before its materials'.
    shot = open_shot(save(stage))
    assert shot.scene.garments[0].fabric_scale is None
    assert not shot.sources[0].fabrics


def test_values_that_change_are_held_and_misspelt_ones_named(tmp_path: Path):
    stage = sheet(tmp_path / "s.usda", grid())
    add_subset(stage, "trim", RIGHT, bendStifness=1e-4)
    for time in (1.0, 2.0):
        author(stage.GetPrimAtPath("/World/looks/trim"), BEND, 1e-5 * time, time=time)
    shot = open_shot(save(stage))
    assert "bendStiffness as at the first time code" in shot.sources[0].fabrics["trim"]
    assert "</World/looks/trim>: physgraph:material:bendStifness" in said(shot)
