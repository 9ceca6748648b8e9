"""A rest shape that is not the cloth's: who is told, and the one that is fitted to the shot."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from meshes import grid
from pxr import UsdGeom, Vt
from sheets import garment_of
from shots import fine, refine, run, sample_times
from stages import GARMENT_API, new_stage, save, vec3

from physgraph_usd.errors import GarmentError, UsageError
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.shot.untagged import rest_options
from physgraph_usd.shot.warnings import of_strain
from physgraph_usd.solver.strain import StrainedPart, strained_parts, strayed
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.read.rest import FITTED, median_shape

SLEEVE = "/World/sleeve"
AROUND, ROWS, RADIUS, LENGTH = 16, 13, 0.06, 0.4
PUFFED = 1.5
TIMES = tuple(float(time) for time in range(1, 8))


def tube(puff: float, *, bend: float = 0.0) -> np.ndarray:
    """Points of a sleeve [m], round in its lower half and `puff` times as wide in its upper one, bent to the side."""
    row, turn = np.meshgrid(np.linspace(0.0, 1.0, ROWS), 2 * np.pi * np.arange(AROUND) / AROUND, indexing="ij")
    radius = RADIUS * (1.0 + (puff - 1.0) * np.clip(6.0 * row - 3.0, 0.0, 1.0))
    side = bend * LENGTH * row**2
    return np.stack([radius * np.cos(turn) + side, LENGTH * row, radius * np.sin(turn)], axis=-1).reshape(-1, 3)


def puffed_shot(
    path: Path,
    *,
    puff: float = PUFFED,
    subset: bool = False,
    odd: dict[float, float] | None = None,
    default: bool = True,
    times: Sequence[float] = TIMES,
) -> str:
    """A sleeve whose default points, if any, are a plain tube and whose animation is puffed; ``odd`` scales samples."""
    stage = new_stage(path)
    mesh = UsdGeom.Mesh.Define(stage, SLEEVE)
    ids = np.arange(AROUND * ROWS).reshape(ROWS, AROUND)
    across = np.roll(ids, -1, axis=1)
    quads = np.stack([ids[:-1], ids[1:], across[1:], across[:-1]], axis=-1).reshape(-1, 4)
    mesh.CreateFaceVertexCountsAttr([4] * len(quads))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(quads.ravel().astype(np.int32)))
    mesh.CreatePointsAttr()
    if default:
        mesh.GetPointsAttr().Set(vec3(tube(1.0)))
    for time in times:
        mesh.GetPointsAttr().Set(vec3((odd or {}).get(time, 1.0) * tube(puff, bend=0.03 * time)), time)
    if subset:
        upper = Vt.IntArray.FromNumpy(np.arange(len(quads) // 2, len(quads)).astype(np.int32))
        UsdGeom.Subset.CreateGeomSubset(mesh, "puff", "face", upper)
    mesh.GetPrim().AddAppliedSchema(GARMENT_API)
    return save(stage)


def radius(points: np.ndarray) -> float:
    """Mean distance from the axis [m] of the upper third of a refined sleeve, its bend taken out."""
    high = points[points[:, 1] > 0.7 * LENGTH]
    height = np.round(high[:, 1] / LENGTH * 24)
    centred = np.concatenate([high[height == each] - high[height == each].mean(axis=0) for each in np.unique(height)])
    return float(np.linalg.norm(centred[:, [0, 2]], axis=1).mean())


def test_stretched_parts_are_told_with_place_amount_and_remedy(tmp_path: Path):
    found = inspect_shot(puffed_shot(tmp_path / "a.usda"))
    (part,) = found["garments"][0]["strained"]
    assert part["area_ratio"] == pytest.approx(PUFFED, rel=0.1)
    assert 0.4 < part["share"] < 0.6
    (said,) = [warning for warning in found["warnings"] if "--rest auto" in warning]
    assert f"<{SLEEVE}>" in said
    assert "(default points)" in said
    assert f"{part['area_ratio']:.0%} of its area on {part['faces']} faces in its upper part" in said
    assert "--rest auto" in found["command"]


@pytest.mark.parametrize(("default", "asked"), [(False, None), (True, "auto"), (False, 4.0)])
def test_cloth_in_its_own_size_is_not_warned_of(tmp_path: Path, default: bool, asked: str | float | None):
    found = inspect_shot(puffed_shot(tmp_path / "a.usda", default=default), rest_frame=asked)
    assert found["garments"][0]["strained"] == []
    assert not [warning for warning in found["warnings"] if "rest" in warning]
    assert "command" not in found


def test_a_fitted_shape_that_is_not_the_clothes_is_not_to_be_fitted_again():
    part = StrainedPart("all over it", 9, 1.5, 1.0)
    (said,) = of_strain({SLEEVE: [part]}, f"{FITTED}: something")
    assert "--rest auto" not in said
    assert "--rest FRAME" in said
    assert not rest_options([(f"{FITTED}: something", [part])])
    assert rest_options([("default points", [part])]) == ["--rest", "auto"]


def test_a_part_is_named_by_height_and_axes():
    mesh, rest = grid(6, 6)
    garment = garment_of(mesh, rest)
    large = rest * np.where((rest[:, :1] > rest[:, 0].mean()) & (rest[:, 1:2] > rest[:, 1].mean()), 1.5, 1.0)
    for up, said in (((0, 1, 0), "in its upper part, towards +X"), ((0, 0, 1), "in its middle, towards +X and +Y")):
        assert strained_parts(garment, [large], {}, up=np.array(up, float))[0].where == said


def test_a_subset_that_covers_a_part_names_it(tmp_path: Path):
    found = inspect_shot(puffed_shot(tmp_path / "a.usda", subset=True))
    assert found["garments"][0]["strained"][0]["where"] == "in GeomSubset puff"
    assert any("faces in GeomSubset puff" in warning for warning in found["warnings"])


@pytest.mark.parametrize(("puff", "odd"), [(1.0, {}), (1.05, {}), (1.0, {1.0: 1.5, 7.0: 1.5})])
def test_a_little_stretch_and_a_few_odd_frames_are_not_told(tmp_path: Path, puff: float, odd: dict[float, float]):
    found = inspect_shot(puffed_shot(tmp_path / "a.usda", puff=puff, odd=odd))
    assert not [warning for warning in found["warnings"] if "--rest" in warning]


def test_cloth_pushed_together_is_reported_without_a_warning(tmp_path: Path):
    found = inspect_shot(puffed_shot(tmp_path / "a.usda", puff=0.8))
    assert found["garments"][0]["strained"][0]["area_ratio"] < 0.9
    assert not [warning for warning in found["warnings"] if "--rest" in warning]


def test_a_puffed_sleeve_stays_puffed_with_rest_auto(tmp_path: Path):
    shot = Path(puffed_shot(tmp_path / "a.usda"))
    plain, auto = tmp_path / "plain.usdc", tmp_path / "auto.usdc"
    asked = {"level": 1, "steps": 24, "self_contact": "off"}
    assert any("--rest auto" in warning for warning in refine(shot, plain, **asked).warnings)
    report = refine(shot, auto, rest_frame="auto", **asked)
    assert not [warning for warning in report.warnings if "--rest" in warning]
    assert report.garments[0]["strained"] == []
    assert report.garments[0]["sources"]["rest"].startswith(f"{FITTED}: median edge lengths of 7 time codes")
    assert sample_times(auto, SLEEVE) == TIMES
    deflated, kept = (radius(fine(shot, layer, 4.0, prim=SLEEVE)) for layer in (plain, auto))
    assert deflated < 1.15 * RADIUS
    assert kept == pytest.approx(PUFFED * RADIUS, rel=0.03)


@pytest.mark.parametrize("odd", [{1.0: 2.0, 6.0: 0.5}, {1.0: 100.0}, dict.fromkeys(TIMES[:5], 0.0)])
def test_a_fitted_shape_has_the_median_lengths_and_no_single_frames(tmp_path: Path, odd: dict[float, float]):
    shot = puffed_shot(tmp_path / "a.usda", default=False, odd=odd)
    rest = open_shot(shot).scene.garments[0].rest.reshape(ROWS, AROUND, 3)
    wanted = tube(PUFFED).reshape(ROWS, AROUND, 3)
    around, expected = (np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2) for x in (rest, wanted))
    np.testing.assert_allclose(around, expected, rtol=0.02)


def test_a_fitted_shape_does_not_depend_on_the_frames_that_are_refined(tmp_path: Path):
    shot = puffed_shot(tmp_path / "a.usda", default=False)
    whole, *parts = (open_shot(shot, frames=f).scene.garments[0].rest for f in (None, (1.0, 2.0), (6.0, 7.0)))
    for part in parts:
        np.testing.assert_array_equal(whole, part)


def test_a_cache_that_begins_later_has_the_same_size(tmp_path: Path):
    """Its lengths are medians of fewer poses, its pose another one's."""
    shots = [puffed_shot(tmp_path / f"{n}.usda", default=False, times=TIMES[n:]) for n in (0, 3)]
    whole, cut = (open_shot(shot).scene.garments[0].rest.reshape(ROWS, AROUND, 3) for shot in shots)
    for axis in (0, 1):
        a, b = (np.linalg.norm(np.diff(x, axis=axis), axis=2) for x in (whole, cut))
        np.testing.assert_allclose(a, b, rtol=0.03)


def test_cloth_that_is_always_a_point_is_refused(tmp_path: Path):
    shot = puffed_shot(tmp_path / "a.usda", odd=dict.fromkeys(TIMES, 0.0), default=False)
    with pytest.raises(GarmentError, match=r"all points of the rest shape \(.*\) are at one place"):
        open_shot(shot)


def test_a_fit_comes_near_medians_that_no_pose_has():
    ends = np.array([[0, 1], [1, 2], [2, 3]])
    poses = [
        np.pad(np.cumsum([[0.0], *([length] for length in lengths)], axis=0), ((0, 0), (0, 2)))
        for lengths in ((1.0, 2.0, 2.0), (2.0, 1.0, 2.0), (2.0, 2.0, 1.0))
    ]
    shape, _ = median_shape(ends, poses)
    np.testing.assert_allclose(np.linalg.norm(np.diff(shape, axis=0), axis=1), 2.0, rtol=1e-3)
    np.testing.assert_allclose(median_shape(ends, poses[:1])[0], poses[0], atol=1e-6)


def test_the_command_tells_before_the_first_frame_and_once(tmp_path: Path):
    shot, out = puffed_shot(tmp_path / "a.usda"), tmp_path / "a.usdc"
    report = tmp_path / "a.json"
    done = run("refine", shot, "-o", out, "--level", "1", "--steps", "2", "--progress", "--report", report)
    assert done.exit_code == 0
    assert done.stderr.count("--rest auto") == 1
    assert done.stderr.index("--rest auto") < done.stderr.index("1 of 7 frames")
    assert any("--rest auto" in warning for warning in json.loads(report.read_text())["warnings"])
    done = run("refine", shot, "-o", out, "--level", "0", "--rest", "auto", "--overwrite")
    assert done.exit_code == 0
    assert "--rest" not in done.stderr


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_the_command_tells_once_of_each_of_several_shots(
    tmp_path: Path, workers: int, capfd: pytest.CaptureFixture[str]
):
    shots = [puffed_shot(tmp_path / name) for name in ("a.usda", "b.usda")]
    done = run("refine", *shots, "-o", tmp_path / "out", "--level", "0", "--workers", str(workers))
    assert done.exit_code == 0
    told = [line for line in (done.stderr + capfd.readouterr().err).splitlines() if "--rest auto" in line]
    assert sorted(line.partition(": in most")[0] for line in told) == [f"warning: {shot}" for shot in shots]


@pytest.mark.parametrize("asked", ["median", float("nan")])
def test_a_rest_that_is_neither_a_time_nor_auto_is_refused(tmp_path: Path, asked: str | float):
    with pytest.raises(UsageError, match="neither a time code nor 'auto'"):
        open_shot(puffed_shot(tmp_path / "a.usda"), rest_frame=asked)


@pytest.mark.parametrize(
    ("scale", "aside", "said"),
    [
        (1.0, 0.0, ""),
        (1.0, 1.3, ""),
        (1.0, 1.5, "lies 1500 mm"),
        (5.0, 0.0, "7071 mm large"),
        (0.2, 0.0, "282.8 mm large"),
    ],
)
def test_cloth_that_has_left_its_cage_is_told(scale: float, aside: float, said: str):
    """A cage 1.41 m across; the validator refuses what is farther from it, or four times as large or small."""
    cage = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) - [0.5, 0.5, 0.0]
    found = strayed(cage, scale * cage + [aside, 0.0, 0.0])
    assert said in found
    assert bool(found) == bool(said)
    assert not strayed(5.0 * cage, cage, before=cage)  # One frame's cage is too large, and its cloth not.
