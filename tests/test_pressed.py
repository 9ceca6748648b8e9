"""Pressed folds: edges that the cage keeps folded, or that an artist marks, rest as the cage is folded there."""

from pathlib import Path

import numpy as np
import pytest
from meshes import grid, quads_of
from pxr import Sdf, UsdGeom, Vt
from shots import fine, refine
from stages import add_mesh, new_stage, save, vec3

from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.level import build_levels, refine_garments
from physgraph_usd.solver.mesh.elements import elastic_elements, hinge_geometry
from physgraph_usd.solver.mesh.topology import PolygonMesh, find_edges
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.read.rest import pressed_folds

COLLAR, AROUND = "/World/collar", 20
RADIUS = np.array([60.0, 60.0, 60.0, 60.2, 61.4, 62.4, 63.4, 66.0, 69.0]) / 1000
HEIGHT = np.array([0.0, 12.0, 24.0, 34.0, 36.0, 34.0, 24.0, 12.0, 2.0]) / 1000
"""Rows of a collar: the stand, from its seam to the fold in row 4, and the fall outside."""
STAND, FALL = 2, 6
TIMES = (1.0, 2.0, 3.0, 4.0)


def collar(time: float) -> np.ndarray:
    """Points of a collar [m], a little wider in each frame."""
    turn = 2 * np.pi * np.arange(AROUND) / AROUND
    radius, height = (each[:, None] * (1.0 + 0.01 * (time - 1.0)) for each in (RADIUS, HEIGHT))
    return np.stack(np.broadcast_arrays(radius * np.cos(turn), height, radius * np.sin(turn)), axis=-1).reshape(-1, 3)


def collar_shot(path: Path, *, pressed: bool | None = None, row: int = 4) -> Path:
    """A shot of it; with ``pressed``, a subset of the edges in a row says whether they are."""
    stage = new_stage(path)
    mesh = add_mesh(stage, COLLAR, collar(1.0), quads_of(AROUND, len(RADIUS), closed=True, turned=True))
    for time in TIMES:
        mesh.GetPointsAttr().Set(vec3(collar(time)), time)
    if pressed is not None:
        ids = row * AROUND + np.arange(AROUND)
        ends = np.stack([ids, np.roll(ids, -1)], axis=1).reshape(-1)
        indices = Vt.IntArray.FromNumpy(ends.astype(np.int32))
        subset = UsdGeom.Subset.CreateGeomSubset(mesh, "fold", UsdGeom.Tokens.edge, indices, "folds")
        subset.GetPrim().CreateAttribute("physgraph:pressed", Sdf.ValueTypeNames.Bool).Set(pressed)
    return Path(save(stage))


def gaps(shot: Path, out: Path) -> np.ndarray:
    """Distance of the fall from the stand in each frame [m], shape (times, AROUND)."""
    refine(shot, out, level=1)
    points = np.array([fine(shot, out, time, prim=COLLAR)[: AROUND * len(RADIUS)] for time in TIMES])
    radius = np.hypot(points[..., 0], points[..., 2]).reshape(len(TIMES), -1, AROUND)
    return radius[:, FALL] - radius[:, STAND]


def rows_pressed(shot: Path) -> list[int]:
    """Rows of a shot's pressed vertices."""
    found = open_shot(str(shot)).scene.garments[0].pressed
    return [] if found is None else np.flatnonzero(found.reshape(-1, AROUND).all(axis=1)).tolist()


@pytest.mark.parametrize("pressed", [None, True])
def test_a_collar_stays_over_its_stand(tmp_path: Path, pressed: bool | None):
    """The cage keeps 3.4 mm; without pressing it springs open to 6.4 mm."""
    found = gaps(collar_shot(tmp_path / "shot.usda", pressed=pressed), tmp_path / "fine.usdc")
    assert found.min() > 3e-4
    assert found.max() < 4.5e-3
    said = inspect_shot(str(tmp_path / "shot.usda"))
    assert f"pressed folds of <{COLLAR}>" in str(said)


def test_an_artist_says_that_a_fold_is_not_pressed(tmp_path: Path):
    shot = collar_shot(tmp_path / "shot.usda", pressed=False)
    assert not rows_pressed(shot)
    assert gaps(shot, tmp_path / "fine.usdc").max() > 4.5e-3


@pytest.mark.parametrize(("first", "pressed"), [(1.0, False), (0.0, True)])
def test_a_fold_that_forms_is_not_pressed_and_one_hidden_by_scale_in_the_first_pose_is(first: float, pressed: bool):
    """A grid folded along its middle in all poses but the first, where it is flat, or collapsed to a point."""
    mesh, flat = grid(4, 4)
    x = flat[:, 0] - flat[:, 0].mean()
    folded = np.stack([0.3 * x, flat[:, 1], 0.95 * np.abs(x)], axis=1)
    none = np.zeros((0, 2), np.int64)
    found = pressed_folds(mesh, [first * flat, folded, folded, folded], none, none)
    assert (None if found is None else set(x[found[0]])) == ({0.0} if pressed else None)


def test_an_artist_says_that_a_gentle_fold_is_pressed(tmp_path: Path):
    """Row 7 is bent by few degrees, row 4 turned over. Fine hinges rest bent within a row of them, all others flat."""
    shot = open_shot(str(collar_shot(tmp_path / "shot.usda", pressed=True, row=7)))
    garments = shot.scene.garments
    assert garments[0].pressed is not None
    assert set(np.flatnonzero(garments[0].pressed) // AROUND) == {4, 7}
    finest = build_levels(garments, refine_garments(garments, [2]))[-1]
    row = finest.from_coarse @ np.repeat(np.arange(len(RADIUS)), AROUND)
    bent = row[finest.hinges[:, :2].numpy()].mean(axis=1)[finest.rest_angle.numpy() != 0.0]
    assert len(bent)
    assert (np.minimum(np.abs(bent - 4), np.abs(bent - 7)) < 1.0).all()


TROUSERS, LEG, HEIGHTS = "/World/trousers", 16, 6
CREASE, BACK = 0, 8
"""Columns of a trouser leg with an edge in front and behind."""


def leg(time: float) -> np.ndarray:
    """Points of a leg that swings [m], pointed in front and behind: the cage folds by 53 degrees there."""
    turn = 2 * np.pi * np.arange(LEG) / LEG
    across = 0.09 * np.sin(turn) * (1.0 - 0.1 * np.abs(np.cos(turn)))
    along = 0.1 * np.cos(turn) * (1.0 - 0.12 * np.abs(np.sin(2 * turn)))
    height = np.linspace(0.0, 0.4, HEIGHTS)[:, None]
    x = along + 0.02 * (time - 1.0) * height
    return np.stack(np.broadcast_arrays(x, height, across), axis=-1).reshape(-1, 3)


def leg_shot(path: Path, *, sharpness: float, scheme: str = "catmullClark", pressed: bool | None = None) -> Path:
    """A shot of it with creases along both columns."""
    stage = new_stage(path)
    ids = np.arange(LEG * HEIGHTS).reshape(HEIGHTS, LEG)
    mesh = add_mesh(stage, TROUSERS, leg(1.0), quads_of(LEG, HEIGHTS, closed=True, turned=True))
    for time in TIMES:
        mesh.GetPointsAttr().Set(vec3(leg(time)), time)
    mesh.GetSubdivisionSchemeAttr().Set(scheme)
    mesh.CreateCreaseIndicesAttr([*ids[:, CREASE].tolist(), *ids[:, BACK].tolist()])
    mesh.CreateCreaseLengthsAttr([HEIGHTS, HEIGHTS])
    mesh.CreateCreaseSharpnessesAttr([sharpness, sharpness])
    if pressed is not None:
        ends = np.stack([ids[:-1, [CREASE, BACK]], ids[1:, [CREASE, BACK]]], axis=-1).reshape(-1)
        indices = Vt.IntArray.FromNumpy(ends.astype(np.int32))
        subset = UsdGeom.Subset.CreateGeomSubset(mesh, "fold", UsdGeom.Tokens.edge, indices, "folds")
        subset.GetPrim().CreateAttribute("physgraph:pressed", Sdf.ValueTypeNames.Bool).Set(pressed)
    return Path(save(stage))


def fold_at(mesh: PolygonMesh, points: np.ndarray, ends: np.ndarray) -> float:
    """Median angle between the faces at some edges of a mesh [degrees]."""
    hinges = elastic_elements(mesh, mesh.triangulate(points), points).hinges
    at = find_edges(np.unique(np.sort(ends, axis=1), axis=0), hinges[:, :2]) >= 0
    return float(np.degrees(np.median(np.abs(hinge_geometry(points, hinges[at])[0]))))


def crease_of(shot: Path, out: Path, *, level: int) -> tuple[float, float]:
    """Median angle at the creases of the cage and of the refined mesh [degrees], at the last time code."""
    refine(shot, out, level=level)
    garment = open_shot(str(shot)).scene.garments[0]
    ids = np.arange(LEG * HEIGHTS).reshape(HEIGHTS, LEG)[:, [CREASE, BACK]]
    ends, points = np.stack([ids[:-1], ids[1:]], axis=-1).reshape(-1, 2), leg(TIMES[-1])
    coarse, mesh = fold_at(garment.mesh, points, ends), garment.mesh
    for step in refine_garments([garment], [level])[0]:
        middle = mesh.vertex_count + find_edges(step.edges, ends)
        ends, mesh = np.concatenate([np.stack([ends[:, side], middle], axis=1) for side in (0, 1)]), step.mesh
    return coarse, fold_at(mesh, fine(shot, out, TIMES[-1], prim=TROUSERS), ends)


@pytest.mark.parametrize("level", [1, 2])
def test_a_crease_of_the_cage_keeps_its_angle(tmp_path: Path, level: int):
    coarse, kept = crease_of(leg_shot(tmp_path / "shot.usda", sharpness=10.0), tmp_path / "fine.usdc", level=level)
    assert coarse > 40.0
    assert kept == pytest.approx(coarse, rel=0.12)


def test_a_crease_of_sharpness_1_is_rounded_by_the_second_subdivision(tmp_path: Path):
    coarse, kept = crease_of(leg_shot(tmp_path / "shot.usda", sharpness=1.0), tmp_path / "fine.usdc", level=2)
    assert kept < 0.7 * coarse


@pytest.mark.parametrize(("scheme", "pressed"), [("none", None), ("catmullClark", False)])
def test_creases_without_a_subdivision_scheme_or_refused_are_not_pressed(
    tmp_path: Path, scheme: str, pressed: bool | None
):
    shot = leg_shot(tmp_path / "shot.usda", sharpness=10.0, scheme=scheme, pressed=pressed)
    assert open_shot(str(shot)).scene.garments[0].pressed is None


def test_a_sharp_corner_of_the_cage_stays(tmp_path: Path):
    """Corners of a lapel: a sharp one stays a corner of the cloth, and the other is rounded by subdivision."""
    stage = new_stage(tmp_path / "shot.usda")
    mesh, points = grid(4, 4)
    lapel = add_mesh(stage, COLLAR, points, mesh.indices.reshape(-1, mesh.counts[0]))
    inner = int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))
    lapel.CreateCornerIndicesAttr([inner])
    lapel.CreateCornerSharpnessesAttr([10.0])
    garment = open_shot(save(stage)).scene.garments[0]
    moved = points.copy()
    moved[inner, 2] += 0.1
    smooth, _ = garment.control.subdivided(refine_garments([garment], [1])[0][0])
    assert (smooth @ moved)[inner, 2] == pytest.approx(moved[inner, 2])
