"""Stages that no artist means but every pipeline meets: values out of bounds, points at one place, tiny cloth.

Each of these once ended the process, hung, or lost a layer that was already solved.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cloth import settings_of, sheet
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from sheets import garment_of
from shots import CLOTH, TIMES, cloth_shot, faults, fine, refine, run, sample_times
from stages import COLLIDER_API, GARMENT_API, add_sheet, new_stage, save, sheet_points, vec3

from physgraph_usd.errors import GarmentError, SolveError
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.solver.colliders.pose import Collider, MeshPose
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.scene import Frame, GarmentFrame, Scene
from physgraph_usd.usd.read.reader import open_shot

FLOATS = Sdf.ValueTypeNames.FloatArray
FAR = (1e24, 3e38, float("inf"), float("nan"))


def edit(shot: Path) -> tuple[Usd.Stage, UsdGeom.Mesh]:
    """A shot and its cloth, to be changed."""
    stage = Usd.Stage.Open(str(shot))
    return stage, UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH))


class TestOutOfBounds:
    def test_painted_detail_of_1e24_is_named_and_the_process_lives(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0))
        stage, mesh = edit(shot)
        painted = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("physgraph:detailScale", FLOATS, "constant")
        painted.Set(Vt.FloatArray([1e24]))
        stage.Save()
        done = run("refine", shot, "-o", tmp_path / "out.usdc", "--level", 1)
        assert done.exit_code == 1
        assert f"<{CLOTH}>.primvars:physgraph:detailScale[0]" in done.stderr
        assert "[0, 10]" in done.stderr

    @pytest.mark.parametrize("bad", FAR)
    def test_one_frame_of_the_cloth_is_named_and_the_others_are_done(self, tmp_path: Path, bad: float):
        shot = cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0, 3.0))
        stage, mesh = edit(shot)
        points = np.full_like(np.asarray(mesh.GetPointsAttr().Get(2.0)), bad)
        mesh.GetPointsAttr().Set(vec3(points), 2.0)
        stage.Save()
        report = refine(shot, tmp_path / "out.usdc")
        assert list(report.failed) == ["2"]
        assert f"<{CLOTH}> at time code 2: " in report.failed["2"]
        assert sample_times(tmp_path / "out.usdc") == (1.0, 3.0)

    @pytest.mark.parametrize(
        ("how", "bad"),
        [*(("one point", each) for each in FAR), ("scale", 1e24), ("place", 3e38), ("place", float("nan"))],
    )
    def test_a_body_is_left_out_there_with_a_word(self, tmp_path: Path, how: str, bad: float):
        shot = cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0))
        stage = Usd.Stage.Open(str(shot))
        body = add_sheet(stage, "/World/floor", times=(1.0, 2.0), tagged=False)
        body.GetPrim().AddAppliedSchema(COLLIDER_API)
        if how == "one point":
            body.GetPointsAttr().Set(vec3(np.vstack([[[bad] * 3], sheet_points(2.0)[1:]])), 2.0)
        else:
            place = UsdGeom.Xformable(body).AddTransformOp()
            row = 0 if how == "scale" else 3
            place.Set(Gf.Matrix4d(1.0), 1.0)
            matrix = np.eye(4)
            matrix[row, 0] = bad
            place.Set(Gf.Matrix4d(matrix), 2.0)
        stage.Save()
        report = refine(shot, tmp_path / "out.usdc")
        assert report.exit_code == 0
        assert any("</World/floor> at time code 2: " in said and "left out" in said for said in report.warnings)

    @pytest.mark.parametrize("bad", FAR)
    def test_frames_made_in_python_too(self, bad: float):
        mesh, rest = sheet(3, 2)
        body, triangles = rest - [0.0, 0.1, 0.0], mesh.triangulate(rest).triangles
        garment = replace(garment_of(mesh, rest), colliders=(0,))
        scene = Scene((garment,), np.array([0.0, -9.81, 0.0]), (), (Collider("/World/floor", "mesh"),))
        refiner = Refiner(scene, settings_of(), levels=[1])

        def solve(time: float, *, cloth: np.ndarray = rest, floor: np.ndarray = body, detail: float = 1.0):
            refiner.solve(Frame(time, (GarmentFrame(cloth, Fabric(), detail=detail),), (MeshPose(floor, triangles),)))

        solve(1.0)
        with pytest.raises(GarmentError, match=r"</World/Sheet> at time code 2: point 1 is at .*at most 1e\+09 m"):
            solve(2.0, cloth=np.where(np.arange(len(rest))[:, None] == 1, bad, rest))
        with pytest.raises(SolveError, match=r"</World/Sheet> at time code 3: .*detail"):
            solve(3.0, cloth=1.1 * rest, detail=bad)
        if np.isnan(bad):  # Faces of bodies that are not finite are left out.
            return
        with pytest.raises(GarmentError, match="</World/floor> at time code 4: "):
            solve(4.0, floor=np.full_like(rest, bad))


class TestPointsAtOnePlace:
    @pytest.fixture
    def shot(self, tmp_path: Path) -> Path:
        """A sheet with two neighbours at one place, a face twice, and a point that no face uses."""
        shot = cloth_shot(tmp_path / "shot.usda", times=TIMES[:2])
        stage, mesh = edit(shot)
        for at in (None, *TIMES[:2]):
            points = sheet_points(at, (6, 4))
            points[10] = points[9]
            points = np.vstack([points, [[0.5, 0.5, 0.5]]])
            mesh.GetPointsAttr().Set(vec3(points), Usd.TimeCode.Default() if at is None else at)
        counts, indices = (
            np.asarray(each.Get()) for each in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
        )
        mesh.GetFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.append(counts, counts[:1])))
        mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(np.append(indices, indices[:4])))
        stage.Save()
        return shot

    def test_a_layer_is_written_with_a_word_and_the_cage_s_topology(self, shot: Path, tmp_path: Path):
        report = refine(shot, tmp_path / "out.usdc", level=1)
        assert report.exit_code == 0
        assert faults(tmp_path / "out.usdc", shot) == []
        assert any("points[9] and points[10]" in said and "taken for one" in said for said in report.warnings)
        # Points, edges and faces of the cage; the face that is there twice has four corners.
        assert len(fine(shot, tmp_path / "out.usdc", 1.0)) == 36 + (7 * 4 + 6 * 5) + 25

    def test_they_stay_together_and_so_does_what_lies_between_them(self, shot: Path, tmp_path: Path):
        refine(shot, tmp_path / "out.usdc", level=1, steps=12)
        points, cage = fine(shot, tmp_path / "out.usdc", 2.0), open_shot(str(shot)).frame(2.0).garments[0].points
        edges = open_shot(str(shot)).scene.garments[0].mesh.half_edges.edges
        between = len(cage) + int(np.flatnonzero((edges == [9, 10]).all(axis=1))[0])
        assert np.linalg.norm(points[9] - cage[9]) > 1e-5
        np.testing.assert_allclose(points[10], points[9], atol=1e-7)
        np.testing.assert_allclose(points[between], points[9], atol=1e-5)


def test_a_rest_shape_whose_points_are_all_at_one_place_is_refused(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usda")
    stage, mesh = edit(shot)
    mesh.GetPointsAttr().Set(vec3(np.zeros((35, 3))))
    stage.Save()
    with pytest.raises(GarmentError, match=f"<{CLOTH}>: all points of the rest shape"):
        open_shot(str(shot))


@pytest.mark.parametrize("time", [1.0, 2.0])
def test_a_sample_with_all_points_at_one_place_loses_no_layer(tmp_path: Path, time: float):
    shot = cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0), broken={time: 0.0})
    assert refine(shot, tmp_path / "out.usdc").exit_code == 0


@pytest.mark.parametrize("name", ["sleeve", "torus"])
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


def test_a_body_scaled_to_nothing_holds_no_report_up(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0))
    stage = Usd.Stage.Open(str(shot))
    body = add_sheet(stage, "/World/floor", times=(), tagged=False, size=(40, 30))
    body.GetPrim().AddAppliedSchema(COLLIDER_API)
    UsdGeom.XformCommonAPI(body).SetScale(Gf.Vec3f(0.0))
    stage.Save()
    began = time.process_time()
    refine(shot, tmp_path / "out.usdc", report=tmp_path / "report", level=0)
    assert time.process_time() - began < 40.0
    assert (tmp_path / "report" / "report.html").is_file()


def test_a_face_of_a_thousand_corners_takes_seconds(tmp_path: Path):
    stage = new_stage(tmp_path / "shot.usda")
    angle = np.linspace(0.0, 2.0 * np.pi, 1000, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    mesh = UsdGeom.Mesh.Define(stage, CLOTH)
    mesh.CreateFaceVertexCountsAttr([1000])
    mesh.CreateFaceVertexIndicesAttr(list(range(1000)))
    mesh.CreatePointsAttr(vec3(ring))
    mesh.GetPrim().AddAppliedSchema(GARMENT_API)
    save(stage)
    began = time.process_time()
    assert refine(tmp_path / "shot.usda", tmp_path / "out.usdc", steps=12).exit_code == 0
    # Twice as many took 45 s and 1.5 GB where clusters of faces looked one another up one by one.
    assert time.process_time() - began < 12.0
