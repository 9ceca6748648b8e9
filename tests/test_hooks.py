"""The hooks of `plugins/`: each by its host's own library where there is one, else by a stage in place of the host."""

import importlib
import json
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import usdview_stub
from pxr import Sdf, Usd, UsdGeom
from shots import CLOTH, FAST, cloth_shot, faults, refine

import physgraph_usd as pg
from physgraph_usd.usd.provenance import read_record

PLUGINS = Path(__file__).resolve().parents[1] / "plugins"
PYBLISH = Path(sys.prefix) / "pyblish"
"""Where `make` installs pyblish-base: beside its own, it brings a package `tests` that would hide ours."""
COARSE, FINE = 35, 117
"""Points of the sheet, and at level 1."""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0, 3.0))


@pytest.fixture
def stage(file: Path) -> Usd.Stage:
    return Usd.Stage.Open(str(file))


@pytest.fixture(autouse=True)
def paths(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the docs put on PYTHONPATH."""
    for folder in (PLUGINS, PLUGINS / "solaris", PLUGINS / "usdview"):
        monkeypatch.syspath_prepend(str(folder))


def count(stage: Usd.Stage, time: float = 2.0) -> int:
    return len(UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr().Get(time))


def tear(stage: Usd.Stage) -> None:
    UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetFaceVertexIndicesAttr().Set([0, 1, 99])


class TestPublishHook:
    def test_writes_what_the_command_would(self, stage: Usd.Stage, file: Path, tmp_path: Path):
        hook = importlib.import_module("publish_hook")
        hook.publish(stage, tmp_path / "cloth.usdc", pg.RefineOptions(**FAST))
        assert faults(tmp_path / "cloth.usdc", file) == []
        refine(file, tmp_path / "command.usdc")
        ours, theirs = (Sdf.Layer.FindOrOpen(str(tmp_path / name)) for name in ("cloth.usdc", "command.usdc"))
        for time in (1.0, 2.0, 3.0):
            one, other = (np.asarray(layer.QueryTimeSample(f"{CLOTH}.points", time)) for layer in (ours, theirs))
            assert np.array_equal(one, other)

    def test_publishes_nothing_where_a_frame_failed(self, stage: Usd.Stage, tmp_path: Path):
        points = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr()
        points.Set([(float("nan"), 0.0, 0.0)] * COARSE, 2.0)
        hook = importlib.import_module("publish_hook")
        with pytest.raises(pg.PhysGraphError, match="time code 2"):
            hook.publish(stage, tmp_path / "cloth.usdc", pg.RefineOptions(**FAST))
        assert not (tmp_path / "cloth.usdc").exists()


@pytest.fixture
def pyblish(monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any]:
    """Its modules ``api`` and ``util``."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(PYBLISH)])
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])  # It leaves an importer there that warns of others.
    api = pytest.importorskip("pyblish.api", reason="needs pyblish-base, which make test installs")
    return api, importlib.import_module("pyblish.util")


class TestPyblish:
    @pytest.fixture
    def run(self, pyblish: tuple[Any, Any]) -> Any:
        """Publish with our plug-ins alone; the context, whose ``results`` say what became of each."""
        api, util = pyblish
        api.deregister_all_plugins()
        api.deregister_all_paths()
        api.register_plugin_path(str(PLUGINS / "pyblish"))

        def publish(**data: Any) -> Any:
            context = api.Context()
            context.data.update({"physgraphOptions": FAST} | data)
            return util.publish(context)

        yield publish
        api.deregister_all_paths()

    def test_h34_a_stage_is_collected_validated_and_extracted(self, run: Any, stage: Usd.Stage, file: Path):
        context = run(usdStage=stage)
        assert [str(result["error"]) for result in context.data["results"] if result["error"]] == []
        (instance,) = context
        assert instance.data["garments"] == [CLOTH]
        (made,) = instance.data["files"]
        assert faults(Path(made), file) == []

    def test_a_garment_that_cannot_be_refined_fails_at_validation(self, run: Any, stage: Usd.Stage):
        tear(stage)
        context = run(usdStage=stage)
        failed = [
            (result["plugin"].__name__, str(result["error"])) for result in context.data["results"] if result["error"]
        ]
        assert [name for name, _ in failed] == ["ValidateGarments"]
        assert CLOTH in failed[0][1]
        assert not any("files" in instance.data for instance in context)


class TestAyon:
    """The plug-ins under pyblish, which AYON runs; ayon-core's extractor is a stand-in."""

    @pytest.fixture
    def run(self, pyblish: tuple[Any, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
        """Publish with our plug-ins alone, as settings make them."""
        api, util = pyblish
        own = {"order": api.ExtractorOrder, "staging_dir": lambda *_: str(tmp_path)}
        core = SimpleNamespace(Extractor=type("Extractor", (api.InstancePlugin,), own))
        monkeypatch.setitem(sys.modules, "ayon_core", ModuleType("ayon_core"))
        monkeypatch.setitem(sys.modules, "ayon_core.pipeline", SimpleNamespace(publish=core))
        names = {"collect_refined_cloth": "CollectRefinedCloth", "extract_refined_cloth": "ExtractRefinedCloth"}
        files = [runpy.run_path(str(PLUGINS / "ayon" / f"{name}.py")) for name in names]
        plugins = [file[name] for file, name in zip(files, names.values(), strict=True)]

        def publish(settings: dict[str, Any], **data: Any) -> Any:
            for name, value in settings.items():
                monkeypatch.setattr(plugins[0], name, value)
            context = api.Context()
            context.data.update(data)
            return util.publish(context, plugins=plugins)

        return publish

    def test_a_stage_becomes_a_representation(self, run: Any, stage: Usd.Stage, file: Path):
        context = run({"level": "1", "garments": [CLOTH]}, usdStage=stage, folderPath="/shots/010", task="cloth")
        assert [str(result["error"]) for result in context.data["results"] if result["error"]] == []
        (instance,) = context
        (made,) = instance.data["representations"]
        assert (instance.data["folderPath"], instance.data["productName"], made["ext"]) == (
            "/shots/010",
            "usdCloth",
            "usdc",
        )
        layer = Path(made["stagingDir"]) / made["files"]
        assert faults(layer, file) == []
        assert len(Sdf.Layer.FindOrOpen(str(layer)).QueryTimeSample(f"{CLOTH}.points", 2.0)) == FINE


class TestSolaris:
    """A LOP node in pxr: what comes in as a stage, and the layer that the node's edits go to."""

    @pytest.fixture
    def node(self, file: Path) -> Any:
        incoming, edits = Usd.Stage.Open(str(file)), Sdf.Layer.CreateAnonymous("edits.usda")
        edits.timeCodesPerSecond = incoming.GetTimeCodesPerSecond()
        root = Sdf.Layer.CreateAnonymous("root.usda")
        root.timeCodesPerSecond = incoming.GetTimeCodesPerSecond()
        for below in (edits.identifier, str(file)):
            root.subLayerPaths.append(below)
        whole = Usd.Stage.Open(root)
        whole.SetMetadata("metersPerUnit", UsdGeom.GetStageMetersPerUnit(incoming))
        parms = {
            "garments": SimpleNamespace(evalAsString=lambda: CLOTH),
            "frames": SimpleNamespace(evalAsString=lambda: "2 3"),
            "level": SimpleNamespace(evalAsInt=lambda: 1),
        }
        said: list[str] = []
        return SimpleNamespace(
            editableStage=lambda: whole, editableLayer=lambda: edits, parm=parms.get, addWarning=said.append, said=said
        )

    def test_what_the_nodes_layer_held_is_there_beside_the_refined_cloth(self, node: Any, file: Path):
        """Among it the cage, of which no sample is left between the fine ones."""
        edits, whole = node.editableLayer(), node.editableStage()
        edits.customLayerData = {"host": "data"}
        edits.comment = "mine"
        Sdf.CreatePrimInLayer(edits, "/World/lamp").specifier = Sdf.SpecifierDef
        Sdf.CreatePrimInLayer(edits, CLOTH)
        below = Sdf.Layer.FindOrOpen(str(file))
        Sdf.CopySpec(below, f"{CLOTH}.points", edits, f"{CLOTH}.points")
        Sdf.AttributeSpec(edits.GetPrimAtPath(CLOTH), "note", Sdf.ValueTypeNames.String).default = "mine"
        importlib.import_module("refine_lop").cook(node)
        assert whole.GetPrimAtPath("/World/lamp")
        assert (edits.comment, edits.customLayerData["host"]) == ("mine", "data")
        assert (read_record(edits) or {})["garments"]
        assert edits.GetAttributeAtPath(f"{CLOTH}.note").default == "mine"
        assert {count(whole, time) for time in (1.0, 2.0, 3.0)} == {FINE}

    def test_what_is_wrong_is_the_nodes_error(self, node: Any):
        tear(node.editableStage())
        with pytest.raises(pg.GarmentError, match=CLOTH):
            importlib.import_module("refine_lop").cook(node)


class TestUsdview:
    @pytest.fixture
    def api(self, stage: Usd.Stage) -> Any:
        said: list[str] = []
        return SimpleNamespace(stage=stage, frame=Usd.TimeCode(2.0), PrintStatus=said.append, said=said)

    @pytest.fixture
    def actions(self) -> Any:
        usdview_stub.install()
        return importlib.import_module("physgraph_usdview.actions").Actions()

    def test_the_current_frame_is_refined_over_the_stage_and_taken_off_again(self, api: Any, actions: Any, file: Path):
        before = file.read_bytes()
        for _ in range(2):
            actions.refine_frame(api)
            assert count(api.stage) > FINE
            assert len(api.stage.GetSessionLayer().subLayerPaths) == 1
        actions.clear(api)
        assert count(api.stage) == COARSE
        assert not api.stage.GetSessionLayer().subLayerPaths
        assert not api.stage.GetRootLayer().dirty
        assert file.read_bytes() == before

    @pytest.mark.parametrize("name", ["penetration", "crossing"])
    def test_a_heat_map_colours_each_vertex(self, api: Any, actions: Any, name: str):
        for _ in range(2):
            actions.show_heat(api, name)
        colour = UsdGeom.PrimvarsAPI(api.stage.GetPrimAtPath(CLOTH)).GetPrimvar("displayColor")
        assert len(colour.Get(api.frame)) == count(api.stage)
        assert len(api.stage.GetSessionLayer().subLayerPaths) == 2

    def test_what_is_wrong_is_in_the_status_line(self, api: Any, actions: Any):
        tear(api.stage)
        actions.refine_frame(api)
        assert CLOTH in api.said[-1]
        assert count(api.stage) == COARSE

    def test_its_menu_is_there_as_usdview_loads_plug_ins(self, api: Any):
        """By the real plug-in registry; the container's base and the menu are a stand-in: usd-core has no usdview."""
        (menu,) = usdview_stub.menus(PLUGINS / "usdview").values()
        assert [title for _, title, _ in menu] == [
            "Refine Current Frame",
            "Show Depth in Bodies",
            "Show Crossings",
            "Show Coarse Cloth",
        ]
        menu[0][2](api)
        assert count(api.stage) > FINE


def test_versions_of_the_packages_are_the_packages():
    read = runpy.run_path(str(PLUGINS / "rez" / "package.py"))
    assert read["version"] == pg.__version__
    assert read["name"] == pg.__name__
    assert json.loads((PLUGINS / "usdview" / "plugInfo.json").read_text())["Plugins"][0]["Type"] == "python"
