"""Stages that no artist means but every pipeline meets: values out of bounds, points at one place, tiny cloth, pipes.

Each of these once ended the process, hung, or lost a layer that was already solved.
"""

import time
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from shots import CLOTH, TIMES, cloth_shot, faults, fine, refine
from stages import COLLIDER_API, add_mesh, add_sheet, new_stage, save, set_matrix, sheet_points, vec3

from physgraph_usd.errors import GarmentError, PhysGraphError
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.usd.read.reader import open_shot


def edit(shot: Path) -> tuple[Usd.Stage, UsdGeom.Mesh]:
    stage = Usd.Stage.Open(str(shot))
    return stage, UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH))


@pytest.mark.parametrize(("how", "bad"), [("one point", 1e24), ("scale", 1e24), ("place", np.nan)])
def test_a_body_out_of_bounds_is_left_out_there_with_a_word(tmp_path: Path, how: str, bad: float):
    shot = cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0))
    stage = Usd.Stage.Open(str(shot))
    body = add_sheet(stage, "/World/floor", times=(1.0, 2.0), tagged=False)
    body.GetPrim().AddAppliedSchema(COLLIDER_API)
    if how == "one point":
        body.GetPointsAttr().Set(vec3(np.vstack([[[bad] * 3], sheet_points(2.0)[1:]])), 2.0)
    else:
        set_matrix(body.GetPrim(), np.eye(4), 1.0)
        matrix = np.eye(4)
        matrix[0, 0 if how == "scale" else 3] = bad
        set_matrix(body.GetPrim(), matrix, 2.0)
    stage.Save()
    report = refine(shot, tmp_path / "out.usdc")
    assert report.exit_code == 0
    assert any("</World/floor> at time code 2: " in said and "left out" in said for said in report.warnings)


def test_of_points_at_one_place_a_layer_is_written_with_a_word_and_the_cage_s_topology(tmp_path: Path):
    """A sheet with two neighbours at one place, a face twice, and a point that no face uses."""
    shot = cloth_shot(tmp_path / "shot.usda", times=TIMES[:2])
    stage, mesh = edit(shot)
    for at in (None, *TIMES[:2]):
        points = sheet_points(at, (6, 4))
        points[10] = points[9]
        points = np.vstack([points, [[0.5, 0.5, 0.5]]])
        mesh.GetPointsAttr().Set(vec3(points), Usd.TimeCode.Default() if at is None else at)
    for attribute, count in ((mesh.GetFaceVertexCountsAttr(), 1), (mesh.GetFaceVertexIndicesAttr(), 4)):
        attribute.Set([*attribute.Get(), *attribute.Get()[:count]])
    stage.Save()
    report = refine(shot, tmp_path / "out.usdc", level=1)
    assert report.exit_code == 0
    assert faults(tmp_path / "out.usdc", shot) == []
    assert any("points[9] and points[10]" in said and "taken for one" in said for said in report.warnings)
    # Points, edges and faces of the cage; the face that is there twice has four corners.
    assert len(fine(shot, tmp_path / "out.usdc", 1.0)) == 36 + (7 * 4 + 6 * 5) + 25


def test_a_rest_shape_whose_points_are_all_at_one_place_is_refused(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usda")
    stage, mesh = edit(shot)
    mesh.GetPointsAttr().Set(vec3(np.zeros((35, 3))))
    stage.Save()
    with pytest.raises(GarmentError, match=f"<{CLOTH}>: all points of the rest shape"):
        open_shot(str(shot))


@pytest.mark.parametrize("name", ["sleeve", pytest.param("torus", marks=pytest.mark.slow)])
def test_a_garment_of_a_millimetre_is_refined_in_the_time_of_a_large_one(tmp_path: Path, name: str):
    shot = write_sample(name, tmp_path)
    stage = Usd.Stage.Open(str(shot))
    UsdGeom.SetStageMetersPerUnit(stage, 1e-3 * UsdGeom.GetStageMetersPerUnit(stage))
    stage.Save()
    began = time.process_time()
    report = refine(shot, tmp_path / "out.usdc", frames=(1.0, 2.0), level=0)
    assert time.process_time() - began < 10.0
    assert report.exit_code == 0
    assert any("a 10th of the cloth's size" in said for said in report.warnings)


def test_a_face_of_a_thousand_corners_takes_seconds(tmp_path: Path):
    shot = polygon(tmp_path / "shot.usda", np.arange(1000))
    began = time.process_time()
    assert refine(shot, tmp_path / "out.usdc", steps=12).exit_code == 0
    # Twice as many took 45 s and 1.5 GB where clusters of faces looked one another up one by one.
    assert time.process_time() - began < 12.0


def polygon(path: Path, *faces: np.ndarray) -> Path:
    """A garment of one round, or of several on the same points."""
    stage = new_stage(path)
    angle = np.linspace(0.0, 2.0 * np.pi, len(faces[0]), endpoint=False)
    add_mesh(stage, CLOTH, np.stack([np.cos(angle), np.sin(angle), 0.05 * np.sin(3.0 * angle)], axis=1), faces)
    return Path(save(stage))


@pytest.mark.parametrize(
    ("faces", "said"),
    [
        ([np.arange(6000)], "face 0 has 6,000 corners; 1,000 are the most"),
        ([np.arange(500), np.arange(500)[::-1]], "faces 0 and 1 have the same 500 corners"),
    ],
)
def test_a_face_that_no_solve_ends_on_is_refused(tmp_path: Path, faces: list[np.ndarray], said: str):
    with pytest.raises(GarmentError, match=said):
        refine(polygon(tmp_path / "s.usda", *faces), tmp_path / "fine.usdc")


def test_a_vertex_that_single_precision_cannot_hold_with_its_cloth_fails_its_frame(tmp_path: Path):
    shot = cloth_shot(tmp_path / "s.usda", times=(1.0, 2.0, 3.0))
    stage = Usd.Stage.Open(str(shot))
    attribute = UsdGeom.Mesh(stage.GetPrimAtPath("/World/cloth")).GetPointsAttr()
    points = np.array(attribute.Get(2.0))
    points[20] = 1e9, 0.0, 0.0
    attribute.Set(vec3(points), 2.0)
    stage.Save()
    report = refine(shot, tmp_path / "fine.usdc")
    assert list(report.failed) == ["2"]
    assert "point 20 is 4.85714e+07 m from the garment's middle" in report.failed["2"]


@pytest.mark.parametrize("guide", ["1e-30", "0"])
def test_a_guide_that_lets_the_garment_fall_is_refused(tmp_path: Path, guide: str):
    with pytest.raises(PhysGraphError, match="nothing holds it up but a guide of"):
        refine(
            cloth_shot(tmp_path / "s.usda"), tmp_path / "fine.usdc", overrides=(f"physgraph:guide:stiffness={guide}",)
        )


@pytest.mark.parametrize("overrides", [("stretchStiffness=1e-3", "physgraph:guide:stiffness=0"), ("density=1e5",)])
def test_cloth_on_a_body_that_cannot_carry_its_weight_is_refused(tmp_path: Path, overrides: tuple[str, ...]):
    shot = cloth_shot(tmp_path / "s.usda")
    stage = Usd.Stage.Open(str(shot))
    UsdGeom.Sphere.Define(stage, "/World/ball")
    stage.Save()
    with pytest.raises(PhysGraphError, match=r"N/m cannot carry its weight of .* N/m\^2: where it hangs it would be"):
        refine(shot, tmp_path / "fine.usdc", overrides=overrides, colliders=("/World/ball",))


def test_a_rest_frame_shrunk_to_nothing_fails_those_that_are_not(tmp_path: Path):
    shot = cloth_shot(tmp_path / "s.usda", times=(1.0, 2.0, 3.0), size=(7, 7), broken={1.0: 1e-6})
    report = refine(shot, tmp_path / "fine.usdc", rest_frame=1.0)
    assert list(report.failed) == ["2", "3"]
    assert "those of its rest shape, to which cloth shrinks, of 5.0" in report.failed["2"]
