"""Where the rest shape comes from, when it is refused, who is told that it is not the cloth's, and the fitted one."""

import json
from pathlib import Path

import numpy as np
import pytest
from cloth import sheet
from meshes import quads_of
from pxr import Sdf, Usd, UsdGeom
from sheets import garment_of
from shots import fine, refine, run, sample_times
from stages import add_mesh, add_sheet, affine, author, new_stage, save, set_matrix, sheet_points, vec3

from physgraph_usd.errors import GarmentError, StageError
from physgraph_usd.shot.refine import inspect_shot
from physgraph_usd.solver.level import build_levels, hinge_geometry
from physgraph_usd.usd.read.reader import Shot, open_shot
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
    path: Path, *, puff: float = PUFFED, odd: dict[float, float] | None = None, default: bool = True
) -> str:
    """A sleeve whose default points, if any, are a plain tube and whose animation is puffed; ``odd`` scales samples."""
    stage = new_stage(path)
    mesh = add_mesh(stage, SLEEVE, tube(1.0), quads_of(AROUND, ROWS, closed=True, turned=True))
    if not default:
        mesh.GetPointsAttr().ClearDefault()
    for time in TIMES:
        mesh.GetPointsAttr().Set(vec3((odd or {}).get(time, 1.0) * tube(puff, bend=0.03 * time)), time)
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
    assert ("--rest" in found["command"]) == (asked is not None)


@pytest.mark.parametrize(("puff", "odd"), [(1.0, {}), (1.05, {}), (1.0, {1.0: 1.5, 7.0: 1.5})])
def test_a_little_stretch_and_a_few_odd_frames_are_not_told(tmp_path: Path, puff: float, odd: dict[float, float]):
    found = inspect_shot(puffed_shot(tmp_path / "a.usda", puff=puff, odd=odd))
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


def test_a_fitted_shape_is_smooth_where_every_pose_is_folded():
    """A strip in pleats of 120 degrees, pleated in each pose, has its lengths pleated or flat: it rests flat."""
    mesh, flat = sheet(12, 6, 0.05)
    column = np.rint((flat[:, 0] - flat[:, 0].min()) / 0.05).astype(int)
    pleated = flat.copy()
    pleated[:, 0], pleated[:, 2] = 0.5 * 0.05 * column, np.sqrt(0.75) * 0.05 * (column % 2)
    shape, _ = median_shape(mesh, [pleated, pleated + 1.0])
    edges = mesh.half_edges.edges
    lengths, wanted = (np.linalg.norm(np.subtract(*x[edges.T]), axis=1) for x in (shape, flat))
    np.testing.assert_allclose(lengths, wanted, rtol=0.02)
    (level,) = build_levels([garment_of(mesh, shape)], [()])
    folded = hinge_geometry(shape, level.hinges.numpy())[0]
    assert np.quantile(np.abs(folded), 0.95) < np.radians(10.0)  # Rims alone stay free.


def test_a_folded_frame_as_rest_shape_is_smooth(stage: Usd.Stage):
    """A sheet folded along its middle at time code 2; its lengths there are the sheet's."""
    mesh = add_sheet(stage, default=False)
    folded = np.abs(FLAT - [2.0, 0.0, 0.0]) @ [[0.5, 0.0, np.sqrt(0.75)], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
    folded[:, 0] *= np.sign(FLAT[:, 0] - 2.0)
    for time, points in ((1.0, FLAT), (2.0, folded)):
        mesh.GetPointsAttr().Set(vec3(points), time)
    rest = open_shot(save(stage), rest_frame=2.0).scene.garments[0].rest
    lengths, wanted = (np.linalg.norm(each[1:] - each[0], axis=1) for each in (rest, FLAT))
    np.testing.assert_allclose(lengths, wanted, rtol=0.03)


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


FLAT = sheet_points() * [1.0, 1.0, 0.0]


def source(shot: Shot) -> str:
    return shot.sources[0].sources["rest"]


def primvar(mesh: UsdGeom.Mesh, name: str, values: np.ndarray) -> UsdGeom.Primvar:
    made = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, Sdf.ValueTypeNames.Point3fArray, "vertex")
    made.Set(vec3(values))
    return made


def test_the_order_of_rest_shapes_from_weakest_to_strongest(stage: Usd.Stage) -> None:
    mesh = add_sheet(stage, default=False, times=(5.0, 6.0))

    def rest(**options) -> tuple[str, np.ndarray]:
        shot = open_shot(save(stage), **options)
        return source(shot), shot.scene.garments[0].rest

    name, points = rest()
    assert name == "fitted to the shot: median edge lengths of 2 time codes, from the points at 5"
    np.testing.assert_array_equal(rest(frames=(6.0, 6.0))[1], points)
    mesh.GetPointsAttr().Set(vec3(sheet_points()))
    name, points = rest()
    assert name == "default points"
    np.testing.assert_allclose(points, sheet_points())
    for number, attribute in enumerate(("Pref", "rest"), start=1):
        primvar(mesh, attribute, FLAT * (1 + 0.1 * number))
        name, points = rest()
        assert name == f"</World/cloth>.primvars:{attribute}"
        np.testing.assert_allclose(points, FLAT * (1 + 0.1 * number), rtol=1e-6)
    for schema in ("omniphysics", "physics"):
        author(mesh.GetPrim(), f"{schema}:restShapePoints", vec3(FLAT), kind="point3f[]")
        name, points = rest()
        assert name == f"</World/cloth>.{schema}:restShapePoints"
    np.testing.assert_allclose(points, FLAT)
    name, points = rest(rest_frame=6.0)
    assert name == "edge lengths at time code 6 (--rest)"
    sides = [np.linalg.norm(np.diff(each[:4], axis=0), axis=1) for each in (points, sheet_points(6.0))]
    np.testing.assert_allclose(*sides, rtol=0.02)


def test_the_rest_shape_has_the_size_that_the_cloth_has_in_the_world(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "s.usda", metres=0.01)
    matrix = affine(np.diag([2.0, 1.0, 0.5]), (7, 0, 0))
    set_matrix(stage.GetPrimAtPath("/World"), matrix, 1.0)
    add_sheet(stage)
    expected = 0.01 * (sheet_points() @ matrix[:3, :3].T + matrix[:3, 3])
    np.testing.assert_allclose(open_shot(save(stage)).scene.garments[0].rest, expected, atol=1e-9)


def test_s16_a_rest_shape_of_another_topology_is_refused(stage: Usd.Stage) -> None:
    primvar(add_sheet(stage), "rest", FLAT[:-1])
    with pytest.raises(GarmentError, match=r"</World/cloth>: primvars:rest has 19 values, the mesh has 20 points; "):
        open_shot(save(stage))


@pytest.mark.parametrize("where", ["rest", "default"])
def test_s16_a_rest_edge_without_length_is_told_with_its_indices(stage: Usd.Stage, where: str) -> None:
    mesh, points = add_sheet(stage), FLAT.copy()
    points[6] = points[7]
    if where == "rest":
        primvar(mesh, "rest", points)
    else:
        mesh.GetPointsAttr().Set(vec3(points))
    said = [str(notice) for notice in open_shot(save(stage)).warnings]
    assert any("</World/cloth>: 1 edge has no length in" in each and "points[6] and points[7]" in each for each in said)


def test_a_rest_shape_that_is_not_finite_is_refused_with_its_index(stage: Usd.Stage) -> None:
    points = FLAT.copy()
    points[4, 1] = np.nan
    primvar(add_sheet(stage), "Pref", points)
    with pytest.raises(GarmentError, match=r"</World/cloth>.primvars:Pref\[4\] is NaN"):
        open_shot(save(stage))


def test_a_rest_shape_of_another_size_is_told(stage: Usd.Stage) -> None:
    primvar(add_sheet(stage), "rest", 100 * FLAT)
    assert any("times as long as the animation's" in notice.message for notice in open_shot(save(stage)).warnings)


@pytest.mark.parametrize(
    ("value", "bent", "renamed"),
    [("restShape", True, None), ("restShapeDefault", True, "restShape"), (None, False, None)],
)
def test_hinges_rest_flat_or_bent(stage: Usd.Stage, value: str | None, bent: bool, renamed: str | None) -> None:
    mesh = add_sheet(stage)
    if value:
        author(mesh.GetPrim(), "physics:restBendAnglesDefault", value, kind="token")
    shot = open_shot(save(stage))
    assert shot.scene.garments[0].bent_rest == bent
    told = [notice for notice in shot.warnings if "restBendAnglesDefault" in notice.message]
    assert [(notice.path, f"author {renamed!r}" in notice.message) for notice in told] == (
        [(str(mesh.GetPath()), True)] if renamed else []
    )


@pytest.mark.parametrize("kind", ["edit", "block"])
def test_points_in_several_layers_are_read_as_composed(tmp_path: Path, kind: str) -> None:
    """An edit of an array changes some of a weaker layer's points, and a block of the animation shows the default."""
    stage = new_stage(tmp_path / "cage.usda")
    add_sheet(stage, times=(1.0, 2.0))
    weaker = save(stage)
    value = "edit [write (9, 9, 9) to [3]]" if kind == "edit" else "AnimationBlock"
    text = '#usda 1.0\n(\n metersPerUnit = 1\n upAxis = "Y"\n subLayers = [@./cage.usda@]\n)\n'
    text += f'over "World"\n{{\n over "cloth"\n {{\n  point3f[] points = {value}\n }}\n}}\n'
    (tmp_path / "shot.usda").write_text(text)
    try:
        shot = open_shot(str(tmp_path / "shot.usda"))
    except StageError as error:
        pytest.skip(f"this USD does not read it: {error}")
    rest, plain = (each.scene.garments[0].rest for each in (shot, open_shot(weaker)))
    changed = np.any(rest != plain, axis=1)
    assert np.flatnonzero(changed).tolist() == ([3] if kind == "edit" else [])
    assert bool(shot.scene.times) == (kind == "edit")
