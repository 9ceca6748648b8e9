"""Air: wind and a difference in pressure push cloth off its animation, as far as its guide lets them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cloth import frame_of, refiner_of, sheet
from meshes import quads_of
from pxr import Usd, UsdGeom
from sheets import garment_of
from stages import add_mesh, new_stage, save, vec3

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.solver.air import DENSITY_OF_AIR, LONGEST_GUST, Wind, load
from physgraph_usd.solver.scene import Frame

FACING = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])


def test_wind_pushes_along_normals_by_the_square_of_its_speed_across_them() -> None:
    pushed = load(FACING, 0.0, Wind((0.0, 0.0, -4.0)).at(np.zeros((3, 3)), 0.0))
    stagnation = 0.5 * DENSITY_OF_AIR * 16.0
    np.testing.assert_allclose(pushed, -stagnation * FACING * np.array([1.0, 0.0, 0.64])[:, None])


def test_pressure_pushes_along_normals_on_top_of_wind() -> None:
    velocity = Wind((0.0, 0.0, 3.0)).at(np.zeros((3, 3)), 0.0)
    np.testing.assert_allclose(load(FACING, 5.0, velocity) - load(FACING, 0.0, velocity), 5.0 * FACING)
    np.testing.assert_allclose(load(FACING, -2.0), -2.0 * FACING)


def test_gusts_have_their_strength_no_mean_and_travel_with_the_wind() -> None:
    places = np.random.default_rng(0).uniform(0.0, 50.0 * LONGEST_GUST, (20000, 3))
    wind = Wind((5.0, 0.0, 0.0), 0.3)
    gusts = wind.at(places, 0.0) - wind.mean
    np.testing.assert_allclose(gusts.mean(axis=0), 0.0, atol=0.05)
    assert np.sqrt((gusts**2).sum(axis=1).mean() / 3.0) == pytest.approx(0.3 * 5.0, rel=0.03)
    np.testing.assert_allclose(wind.at(places + np.array([5.0 * 0.7, 0.0, 0.0]), 0.7), wind.at(places, 0.0), atol=1e-9)


def test_gusts_blow_neither_together_nor_apart() -> None:
    """Their divergence is a thousandth of a derivative's size."""
    wind, step = Wind((5.0, 0.0, 0.0), 0.3), 1e-4
    places = np.random.default_rng(0).uniform(0.0, 10.0, (200, 3))
    slopes = [(wind.at(places + each, 0.0) - wind.at(places - each, 0.0)) / (2.0 * step) for each in step * np.eye(3)]
    divergence = sum(slope[:, axis] for axis, slope in enumerate(slopes))
    assert np.abs(divergence).max() < 1e-3 * np.abs(slopes).max()


def test_a_load_moves_cloth_by_its_size_over_the_guide() -> None:
    mesh, rest = sheet(6, 5)
    calm = frame_of(rest)
    loaded = replace(calm.garments[0], load=np.broadcast_to([0.0, 0.0, 3.0], rest.shape))
    frames = calm, Frame(None, (loaded,))
    answers = [refiner_of([garment_of(mesh, rest)], steps=200).solve(frame).points[0] for frame in frames]
    np.testing.assert_allclose((answers[1] - answers[0]).mean(axis=0), [0.0, 0.0, 3.0 / loaded.guide], atol=1e-4)


def test_gusts_move_cloth_over_a_cage_that_stands_and_steady_wind_lets_it_rest(tmp_path: Path) -> None:
    shot = ball(tmp_path / "shot.usda")
    moved = {}
    for name, turbulence in (("steady", 0.0), ("gusts", 0.5)):
        layer = refined(shot, tmp_path / f"{name}.usdc", **{"wind:speed": 8.0, "wind:turbulence": turbulence})
        moved[name] = float(np.linalg.norm(points_of(layer, 12) - points_of(layer, 11), axis=1).max())
    assert moved["steady"] < 1e-6
    assert moved["gusts"] > 1e-3


def ball(path: Path, *, up: str = "Y", orientation: str = "rightHanded") -> str:
    """A closed ball of cloth with a radius of 0.2 m that stands for twelve frames."""
    stage = new_stage(path, up=up)
    longitude, latitude = np.meshgrid(2.0 * np.pi * np.arange(16) / 16, np.pi * np.arange(1, 8) / 8)
    ring = np.stack([np.sin(latitude) * np.cos(longitude), np.cos(latitude), np.sin(latitude) * np.sin(longitude)], -1)
    points = 0.2 * np.concatenate([ring.reshape(-1, 3), [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]])
    caps = [[112, (k + 1) % 16, k] for k in range(16)] + [[113, 96 + k, 96 + (k + 1) % 16] for k in range(16)]
    faces = [*quads_of(16, 7, closed=True).tolist(), *caps]
    if orientation == "leftHanded":
        faces = [face[::-1] for face in faces]
    mesh = add_mesh(stage, "/World/ball", points, faces)
    mesh.CreateOrientationAttr(orientation)
    for time in range(1, 13):
        mesh.GetPointsAttr().Set(vec3(points), time)
    return save(stage)


def refined(shot: str, layer: Path, **values: float) -> Path:
    overrides = tuple(f"{name}={value}" for name, value in values.items())
    refine_shot(shot, layer, RefineOptions(level=1, overrides=overrides))
    return layer


def points_of(layer: Path, time: float) -> np.ndarray:
    stage = Usd.Stage.Open(str(layer))
    return np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/World/ball")).GetPointsAttr().Get(time))


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_pressure_blows_a_closed_garment_up_whichever_way_its_faces_are_wound(tmp_path: Path, orientation: str) -> None:
    shot = ball(tmp_path / "shot.usda", orientation=orientation)
    radius = {
        pressure: float(
            np.linalg.norm(points_of(refined(shot, tmp_path / f"{pressure}.usdc", pressure=pressure), 2), axis=1).mean()
        )
        for pressure in (-10.0, 0.0, 10.0)
    }
    assert radius[-10.0] + 1e-3 < radius[0.0] < radius[10.0] - 1e-4


@pytest.mark.parametrize(
    ("up", "heading", "along"), [("Y", 0.0, [1, 0, 0]), ("Y", 90.0, [0, 0, -1]), ("Z", 90.0, [0, 1, 0])]
)
def test_wind_blows_along_its_heading_about_the_up_axis(
    tmp_path: Path, up: str, heading: float, along: list[int]
) -> None:
    shot = ball(tmp_path / "shot.usda", up=up)
    calm = points_of(refined(shot, tmp_path / "calm.usdc"), 2)
    windy = points_of(refined(shot, tmp_path / "wind.usdc", **{"wind:speed": 10.0, "wind:heading": heading}), 2)
    shift = (windy - calm).mean(axis=0)
    assert shift @ np.array(along) > 2e-3
    assert np.linalg.norm(shift - (shift @ np.array(along)) * np.array(along)) < 0.1 * np.linalg.norm(shift)


def test_the_report_names_the_largest_load_and_calm_air_leaves_the_cloth_as_it_was(tmp_path: Path) -> None:
    shot = ball(tmp_path / "shot.usda")
    report = refine_shot(shot, tmp_path / "a.usdc", RefineOptions(level=1, overrides=("wind:speed=5",)))
    calm = refine_shot(shot, tmp_path / "b.usdc", RefineOptions(level=1, overrides=("wind:heading=40",)))
    air = [report.frames[0]["garments"][0]["air"], calm.frames[0]["garments"][0].get("air")]
    assert air[0] == pytest.approx(0.5 * DENSITY_OF_AIR * 25.0, rel=0.05)
    assert air[1] is None
    plain = points_of(refined(shot, tmp_path / "c.usdc"), 3)
    np.testing.assert_array_equal(points_of(tmp_path / "b.usdc", 3), plain)
