"""`refine_stage`: an open stage as it stands in, a layer in memory out, and nothing else changed."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from layers import world_metres
from pxr import Sdf, Usd, UsdGeom
from shots import CLOTH, FAST, cloth_shot, fine, refine
from stages import add_sheet, add_skeleton, author, bind_skin, new_stage, sheet_points, vec3

import physgraph_usd as pg
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import inspect_shot, refine_stage
from physgraph_usd.shot.report import RefineReport
from physgraph_usd.usd.check.validate import validate_layer

BEND = "physgraph:material:bendStiffness"
SKINNED = "/World/rig/cloth"
SHORT = (1.0, 2.0, 3.0)


@pytest.fixture
def stage(tmp_path: Path) -> Usd.Stage:
    return Usd.Stage.Open(str(cloth_shot(tmp_path / "shot.usda", times=SHORT)))


def refined(stage: Usd.Stage, **options: Any) -> Sdf.Layer:
    return refine_stage(stage, RefineOptions(**FAST | options))


def points(layer: Sdf.Layer, time: float = 2.0, prim: str = CLOTH) -> np.ndarray:
    """Fine points in the layer, local."""
    return np.asarray(layer.QueryTimeSample(f"{prim}.points", time))


def shown(stage: Usd.Stage, layer: Sdf.Layer, prim: str = CLOTH) -> np.ndarray:
    """World points [m] that a stage shows with the layer over it."""
    stage.GetSessionLayer().subLayerPaths.insert(0, layer.identifier)
    return world_metres(stage, prim, 2.0)


def on_disk(folder: Path) -> dict[str, bytes]:
    return {str(file): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_five_lines_from_an_open_stage_to_a_layer(tmp_path: Path):
    stage = Usd.Stage.Open(str(cloth_shot(tmp_path / "shot.usda", times=(1.0,))))
    layer = pg.refine_stage(stage)
    stage.GetSessionLayer().subLayerPaths.insert(0, layer.identifier)
    assert len(UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr().Get(1.0)) > 35
    assert [problem for problem in pg.validate_layer(layer) if problem.severity == "error"] == []


def test_the_same_cloth_as_from_the_file(stage: Usd.Stage, tmp_path: Path):
    refine(tmp_path / "shot.usda", tmp_path / "fine.usdc")
    expected = fine(tmp_path / "shot.usda", tmp_path / "fine.usdc", 2.0)
    layer = refined(stage)
    assert np.array_equal(shown(stage, layer), expected)
    record = layer.customLayerData["physgraph"]
    assert Path(record["shot"]) == (tmp_path / "shot.usda").resolve()
    assert "unsaved" not in record


def test_the_stage_and_the_disk_stay_as_they_were(stage: Usd.Stage, tmp_path: Path):
    stage.GetRootLayer().GetPrimAtPath(CLOTH).SetInfo("documentation", "edited")
    stage.SetEditTarget(stage.GetSessionLayer())
    stage.GetPrimAtPath(CLOTH).SetDocumentation("by hand")
    layers = {each.identifier: (each.ExportToString(), each.dirty) for each in stage.GetUsedLayers()}
    files, target = on_disk(tmp_path), stage.GetEditTarget().GetLayer()
    state = (stage.GetMutedLayers(), stage.GetLoadRules(), stage.GetPopulationMask(), stage.GetInterpolationType())
    refined(stage)
    assert {each.identifier: (each.ExportToString(), each.dirty) for each in stage.GetUsedLayers()} == layers
    assert on_disk(tmp_path) == files
    assert stage.GetEditTarget().GetLayer() == target
    now = (stage.GetMutedLayers(), stage.GetLoadRules(), stage.GetPopulationMask(), stage.GetInterpolationType())
    assert now == state


class TestStateOfTheStage:
    """Each edit changes the cloth as it does when it is saved to the file, and the result composes and validates."""

    def as_from_file(self, stage: Usd.Stage, folder: Path, **options: Any) -> None:
        """Compare with the flattened stage refined from a file."""
        flat = folder / "flat" / "shot.usda"
        flat.parent.mkdir()
        stage.Export(str(flat))
        refine(flat, folder / "flat" / "fine.usdc", **options)
        layer = refined(stage, **options)
        assert [p for p in validate_layer(layer, stage) if p.severity == "error"] == []
        assert np.array_equal(shown(stage, layer), fine(flat, folder / "flat" / "fine.usdc", 2.0))

    def test_an_edit_of_the_session(self, stage: Usd.Stage, tmp_path: Path):
        before = points(refined(stage))
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            author(stage.GetPrimAtPath(CLOTH), BEND, 1e-3)
        layer = refined(stage)
        assert np.abs(points(layer) - before).max() > 1e-3
        assert list(layer.customLayerData["physgraph"]["unsaved"]) == ["session.usda"]
        self.as_from_file(stage, tmp_path)

    @pytest.mark.parametrize("rate", [24.0, 30.0])
    def test_samples_of_the_session_keep_their_times(self, stage: Usd.Stage, tmp_path: Path, rate: float):
        """A copy without a rate of its own would be rescaled."""
        stage.SetTimeCodesPerSecond(rate)
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/World")).SetTranslate((0, 5, 0), 2.0)
            UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/World")).SetTranslate((0, 9, 0), 3.0)
        self.as_from_file(stage, tmp_path)

    def test_a_muted_layer(self, stage: Usd.Stage, tmp_path: Path):
        stiff = Sdf.Layer.CreateNew(str(tmp_path / "stiff.usda"))
        stage.GetRootLayer().subLayerPaths.append("./stiff.usda")
        with Usd.EditContext(stage, stiff):
            author(stage.GetPrimAtPath(CLOTH), BEND, 1e-3)
        heard = points(refined(stage))
        stage.MuteLayer(stiff.identifier)
        assert np.abs(points(refined(stage)) - heard).max() > 1e-3
        self.as_from_file(stage, tmp_path)

    def test_a_variant_selected_in_the_session(self, stage: Usd.Stage, tmp_path: Path):
        cut = stage.GetPrimAtPath("/World").GetVariantSets().AddVariantSet("cut")
        for name, size in (("short", (4, 3)), ("long", (4, 6))):
            cut.AddVariant(name)
            cut.SetVariantSelection(name)
            with cut.GetVariantEditContext():
                add_sheet(stage, "/World/other", times=SHORT, size=size)
        cut.SetVariantSelection("short")
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            cut.SetVariantSelection("long")
        layer = refined(stage)
        assert list(layer.customLayerData["physgraph"]["variants"]) == ["/World{cut=long}"]
        assert len(points(layer, prim="/World/other")) > 4 * len(sheet_points(size=(4, 3)))
        self.as_from_file(stage, tmp_path)

    def test_a_refined_layer_over_it_is_a_result(self, stage: Usd.Stage):
        layer = refined(stage)
        expected = shown(stage, layer)
        again = refined(stage)
        assert np.array_equal(points(again), points(layer))
        assert np.array_equal(shown(stage, again), expected)


def test_a_stage_without_any_file():
    stage = Usd.Stage.CreateInMemory("made.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 0.05)
    add_sheet(stage, "/cloth", times=(1.0, 2.0), default=False)
    layer = refined(stage)
    record = layer.customLayerData["physgraph"]
    assert (record.get("shot"), list(record["unsaved"])) == (None, ["made.usda"])
    assert [p for p in validate_layer(layer, stage) if p.severity == "error"] == []
    assert len(shown(stage, layer, "/cloth")) == 63
    assert layer.ExportToString() == refined(stage).ExportToString()


class TestReport:
    def test_it_is_given_and_written_where_asked(self, stage: Usd.Stage, tmp_path: Path):
        told: list[RefineReport] = []
        options = RefineOptions(**FAST, report=tmp_path / "report.json")
        refine_stage(stage, options, on_report=told.append)
        written = json.loads((tmp_path / "report.json").read_text())
        assert told[0].exit_code == 0
        assert [frame["time"] for frame in written["frames"]] == list(SHORT)
        assert written["out"] is None

    def test_a_run_that_fails_is_told(self, stage: Usd.Stage, tmp_path: Path):
        told: list[RefineReport] = []
        options = RefineOptions(**FAST, report=tmp_path / "report.json")
        stage.SetTimeCodesPerSecond(0.0)
        with pytest.raises(pg.StageError, match="timeCodesPerSecond"):
            refine_stage(stage, options, on_report=told.append)
        assert "timeCodesPerSecond" in told[0].error
        assert json.loads((tmp_path / "report.json").read_text())["exit_code"] == 1
        stage.SetTimeCodesPerSecond(24.0)
        refine_stage(stage, RefineOptions(**FAST, report=tmp_path / "report.json"))
        assert json.loads((tmp_path / "report.json").read_text())["exit_code"] == 0


@pytest.mark.parametrize(
    ("name", "value"),
    [("workers", 2), ("resume", True), ("dry_run", True), ("root", Path("r.usda")), ("report", Path("folder"))],
)
def test_what_needs_a_file_or_processes_is_refused(stage: Usd.Stage, name: str, value: object):
    with pytest.raises(pg.UsageError, match=name):
        refined(stage, **{name: value})


def test_an_open_stage_is_inspected_as_it_stands(stage: Usd.Stage):
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        author(stage.GetPrimAtPath(CLOTH), BEND, 1e-3)
    assert inspect_shot(stage)["garments"][0]["fabric"]["bend"] == pytest.approx(1e-3)
    stage.GetPrimAtPath(CLOTH).SetActive(False)
    assert "no garment" in inspect_shot(stage)["problem"]


def test_a_skinned_garment_is_baked_off_the_stage(tmp_path: Path):
    """Points that the session has by hand are what the skeleton moves; they are no baked points."""
    stage = new_stage(tmp_path / "shot.usda")
    add_skeleton(stage, "/World/rig", SHORT)
    joints = [int(x > 2) for x in sheet_points()[:, 0]]
    bind_skin(add_sheet(stage, SKINNED, times=()), "/World/rig", joints=joints)
    stage.Save()
    plain = points(refined(stage), prim=SKINNED)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(SKINNED))
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        mesh.GetPointsAttr().Set(vec3(np.asarray(mesh.GetPointsAttr().Get()) * [1.0, 1.0, 1.5]))
    edited = stage.GetSessionLayer().ExportToString()
    layer = refined(stage)
    assert np.abs(points(layer, prim=SKINNED) - plain).max() > 0.1
    assert stage.GetSessionLayer().ExportToString() == edited
    assert [p for p in validate_layer(layer, stage) if p.severity == "error"] == []
