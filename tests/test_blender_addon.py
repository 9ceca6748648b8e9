"""The add-on in Blender's own Python: what a press of its button brings, and what it says when it cannot."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from blender import NEEDS_BLENDER
from scipy.spatial import cKDTree

from physgraph_usd.solver.fabric import PRESETS

ADDON = Path(__file__).parents[1] / "plugins" / "blender"
SCENE = Path(__file__).with_name("blender_addon_scene.py")
COAT, FINE, LIVE, BODY = "Coat ä.001", "Coat ä.001_refined", "Coat ä.001_live", "Body"
CELLS = 8
QUICK = "--integrator quasi-newton --steps 4"

pytestmark = NEEDS_BLENDER


class Seen(NamedTuple):
    """What Blender had at the looks of a job."""

    found: dict[str, Any]
    arrays: dict[str, np.ndarray]
    folder: Path

    def array(self, label: str, name: str, frame: int, *, what: str = "points") -> np.ndarray:
        return self.arrays[f"{label}:{name}:{frame}:{what}"]


def run_job(folder: Path, *steps: tuple[str, tuple[object, ...], dict[str, object]]) -> Seen:
    """Run steps of the scene in Blender's Python, with the add-on installed by a link as its README says."""
    extensions = folder / "extensions" / "user_default"
    extensions.mkdir(parents=True)
    (extensions / "physgraph_usd").symlink_to(ADDON)
    (folder / "job.json").write_text(json.dumps([(name, {"": given, **more}) for name, given, more in steps]))
    line = [os.environ["PHYSGRAPH_BPY_PYTHON"], str(SCENE), str(extensions.parent), "job.json"]
    environment = os.environ | {"PYTHONPATH": str(ADDON.parents[1]), "PYTHONDONTWRITEBYTECODE": "1"}
    ran = subprocess.run(line, cwd=folder, check=False, capture_output=True, text=True, timeout=500, env=environment)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    with np.load(folder / "seen.npz") as arrays:
        return Seen(json.loads((folder / "seen.json").read_text()), dict(arrays), folder)


def step(name: str, *given: object, **more: object) -> tuple[str, tuple[object, ...], dict[str, object]]:
    return name, given, more


@pytest.fixture(scope="session")
def program(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The command, as this environment's Python runs it."""
    file = tmp_path_factory.mktemp("bin") / "physgraph-usd"
    file.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m physgraph_usd "$@"\n')
    file.chmod(0o755)
    return str(file)


@pytest.fixture(scope="module")
def story(program: str, tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """A saved file: refined once, then by the refined object at another level, then opened again."""
    folder = tmp_path_factory.mktemp("story")
    blend = str(folder / "shot.blend")
    panel = {"more": QUICK, "preset": "silk", "hide_coarse": True}
    return run_job(
        folder,
        step("scene", program, saved=blend),
        step("look", "before", 1, 3),
        step("choose", "Bodies", level=1, use_bend=True, bend=20.0, report=True, **panel),
        step("refine", "first"),
        step("look", "one", 1, 3),
        step("draw", "drawn"),
        step("add_modifier", FINE, "SOLIDIFY"),
        step("choose", level=2, use_bend=False, report=False, **panel),
        step("refine", "second"),
        step("look", "two"),
        step("reopen", blend),
        step("look", "opened"),
        step("unregister"),
    )


@pytest.fixture(scope="module")
def odd(program: str, tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """An unsaved scene in metres and one in centimetres, refined at one frame and then live, without colliders."""
    frame = {"scene_frames": False, "frame_start": 3, "frame_end": 3}
    both = [
        (
            step("scene", program, unit=unit),
            step("choose", level=1, more=QUICK, **frame),
            step("refine", f"refined {label}"),
            step("look", label, 3),
            step("choose", level=1, more="", use_bend=True, bend=20.0, **frame),
            step("live"),
            step("follow", f"live {label}"),
            step("keep", f"kept {label}"),
            step("look", f"kept {label}", 3),
        )
        for label, unit in (("m", 1.0), ("cm", 0.01))
    ]
    return run_job(tmp_path_factory.mktemp("odd"), *both[0], *both[1])


def within_a_cage_edge(seen: Seen, label: str, frame: int, *, name: str = FINE) -> None:
    """Each vertex on either side has one of the other nearer than the cage's longest edge."""
    coarse, fine = seen.array(label, COAT, frame), seen.array(label, name, frame)
    faces = seen.array(label, COAT, frame, what="faces")
    edge = np.linalg.norm(coarse[faces] - coarse[np.roll(faces, 1, axis=1)], axis=2).max()
    assert np.max(cKDTree(coarse).query(fine)[0]) < edge
    assert np.max(cKDTree(fine).query(coarse)[0]) < 0.5 * edge
    assert np.abs(coarse.mean(axis=0) - fine.mean(axis=0)).max() < 0.25 * edge


class TestRefinedInBlender:
    def test_it_lies_where_the_coarse_cloth_does(self, story: Seen) -> None:
        assert np.abs(story.array("one", FINE, 3) - story.array("one", FINE, 1)).max() > 0.3, "must move"
        for frame in (1, 3):
            within_a_cage_edge(story, "one", frame)

    def test_the_coarse_objects_are_as_they_were(self, story: Seen) -> None:
        before, after = story.found["before"]["objects"], story.found["one"]["objects"]
        assert set(after) - set(before) == {FINE}
        for name, item in before.items():
            changed = {key for key in item if item[key] != after[name][key]}
            assert changed == ({"hidden", "selected"} if name == COAT else set())
        assert after[COAT]["hidden"]
        for key, values in story.arrays.items():
            if key.startswith("before:"):
                np.testing.assert_array_equal(values, story.arrays[key.replace("before:", "one:")])
        assert story.found["one"]["range"][:2] == story.found["before"]["range"][:2]

    def test_materials_are_the_same_on_the_same_faces(self, story: Seen) -> None:
        objects = story.found["one"]["objects"]
        assert objects[FINE]["slots"] == objects[COAT]["slots"] == ["Unused", "Denim blue", "Wool"]
        assert story.found["one"]["materials"] == story.found["before"]["materials"]
        for frame in (1, 3):
            middle = story.array("one", FINE, frame, what="uv:Pattern").mean(axis=1)
            np.testing.assert_array_equal(story.array("one", FINE, frame, what="material"), 1 + (middle[:, 0] > 0.5))

    def test_the_hidden_body_pushes_as_it_is_seen(self, story: Seen) -> None:
        body = story.array("one", BODY, 1)
        middle, radius = body.mean(axis=0), np.linalg.norm(body - body.mean(axis=0), axis=1)
        # Without its subdivision the body would keep the cloth further off.
        assert radius.max() < 0.29
        reach = {name: np.linalg.norm(story.array("one", name, 1) - middle, axis=1).min() for name in (COAT, FINE)}
        assert reach[COAT] < radius.min() - 0.01
        assert radius.min() - 1e-3 < reach[FINE] < 0.3

    def test_the_command_was_told_what_the_panel_says(self, story: Seen) -> None:
        report = Path(story.found["one"]["report"])
        assert report.is_file()
        said = json.loads(report.with_name("report.json").read_text())["garments"][0]
        assert said["fabric"]["bend"] == pytest.approx(20e-6)
        assert said["fabric"]["stretch"] == PRESETS["silk"].stretch
        assert said["level"] == 1
        assert story.found["two"]["report"] == ""

    def test_refining_the_refined_object_renews_it(self, story: Seen) -> None:
        objects = story.found["two"]["objects"]
        assert set(objects) == set(story.found["one"]["objects"])
        assert objects[FINE]["modifiers"] == [["MESH_SEQUENCE_CACHE", True], ["SOLIDIFY", True]]
        assert objects[FINE]["points"] == (4 * CELLS + 1) ** 2
        assert [path.startswith("//physgraph/") for path in story.found["two"]["caches"]] == [True]
        assert len(list((story.folder / "physgraph").glob("*.refined.usdc"))) == 2

    def test_the_panel_shows_every_setting(self, story: Seen) -> None:
        drawn = story.found["drawn"]
        shown = {name for kind, *names in drawn if kind == "prop" for name in names}
        assert shown >= {"command", "preset", "use_stretch", "stretch", "use_bend", "bend", "level", "colliders"}
        assert shown >= {"scene_frames", "report", "hide_coarse", "more"}
        assert [names for kind, *names in drawn if kind == "operator"] == [
            ["physgraph.refine"],
            ["physgraph.live"],
            ["wm.path_open"],
        ]

    def test_a_scene_in_centimetres_is_as_large_as_in_metres(self, odd: Seen) -> None:
        apart = odd.array("cm", FINE, 3) / 100.0 - odd.array("m", FINE, 3)
        moved = odd.array("m", FINE, 3)[: (CELLS + 1) ** 2] - odd.array("m", COAT, 3)
        assert np.abs(moved).max() > 5e-4
        assert np.abs(apart).max() < 1e-2 * np.abs(moved).max()


def test_what_goes_wrong_is_said(program: str, tmp_path: Path) -> None:
    """Nothing selected, a wrong command, no garment, a wrong range, an error of the command."""
    seen = run_job(
        tmp_path,
        step("scene", program, saved=str(tmp_path / "shot.blend")),
        step("choose", level=1, more=QUICK),
        step("select"),
        step("refine", "nothing"),
        step("select", COAT),
        step("choose", "Bodies", scene_frames=False, frame_start=5, frame_end=2),
        step("refine", "backwards"),
        step("choose", scene_frames=True, more="--rest nonsense"),
        step("refine", "option"),
        step("select", BODY),
        step("choose", "Bodies", more=""),
        step("refine", "only bodies"),
        step("scene", str(tmp_path / "nowhere"), saved=str(tmp_path / "shot.blend")),
        step("refine", "command"),
        step("look", "after"),
    )
    assert "Select the garments to refine" in seen.found["nothing"][0]
    assert "the range ends before it starts" in seen.found["backwards"][0]
    assert "'nonsense' is neither a time code nor 'auto'" in seen.found["option"][0]
    assert "select a garment" in seen.found["only bodies"][0]
    assert "nowhere" in seen.found["command"][0]
    assert "Edit > Preferences" in seen.found["command"][0]
    assert FINE not in seen.found["after"]["objects"]
    assert seen.found["after"]["collections"] == ["Bodies"]


def test_blender_stays_usable_while_the_command_runs(program: str, tmp_path: Path) -> None:
    """Esc ends the process and leaves no layer; a run waits for object mode; a failure is said whole."""
    seen = run_job(
        tmp_path,
        step("scene", program, saved=str(tmp_path / "shot.blend")),
        step("choose", "Bodies", level=1, more=QUICK),
        step("tick", "escape", escape_after=5),
        step("tick", "done", edit_mode=True),
        step("look", "after"),
        step("choose", "Bodies", level=1, more="--integrator nonsense"),
        step("tick", "failed"),
    ).found
    assert [seen[label]["answer"] for label in ("escape", "done", "failed")] == [
        ["CANCELLED"],
        ["FINISHED"],
        ["CANCELLED"],
    ]
    for label in ("escape", "done", "failed"):
        assert (seen[label]["could press"], seen[label]["free"]) == (False, True)
    assert seen["escape"]["code"] != 0
    assert seen["escape"]["left"] == []
    assert seen["escape"]["said"][-1] == ["INFO", "Refining was cancelled"]
    assert seen["done"]["progress"] == [1.0, "about 0 s left 3 of 3 frames"]
    assert ["progress"] in seen["done drawn"]
    assert seen["done"]["modes"] == ["EDIT_MESH", "OBJECT"]
    assert seen["done"]["said"][-1] == ["INFO", f"refined {FINE}"]
    assert f"nothing gives the stretchStiffness and bendStiffness of '{COAT}'" in seen["done"]["said"][0][1]
    assert FINE in seen["after"]["objects"]
    assert seen["failed"]["said"][-1][0] == "ERROR"
    assert "unknown integrator 'nonsense'" in seen["failed"]["said"][-1][1]


@pytest.fixture(scope="module")
def lively(program: str, tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """Live on a saved file: values, frames, a level and Keep; then four more ends."""
    folder = tmp_path_factory.mktemp("live")
    blend = str(folder / "shot.blend")
    ends = (
        (step("reopen", blend), step("select", COAT)),
        (step("look", "on again"), step("press_escape")),
        (step("kill"), step("follow", "killed"), step("draw", "drawn after"), step("look", "at last")),
        (step("unregister"),),
    )
    return run_job(
        folder,
        step("scene", program, saved=blend),
        step("look", "before"),
        step("choose", "Bodies", level=-1, hide_coarse=True, report=True, use_guide=True, guide=1000.0),
        step("go", 2),
        step("live"),
        step("draw", "drawn"),
        step("follow", "first"),
        step("look", "on"),
        step("choose", "Bodies", use_bend=True, bend=200.0),
        step("follow", "bent"),
        step("push"),
        step("choose", "Bodies", use_bend=True, bend=2000.0),
        step("push"),
        step("follow", "stiff"),
        step("undo"),
        step("follow", "undone"),
        step("go", 3),
        step("follow", "third"),
        step("choose", "Bodies", level=1, preset="silk"),
        step("follow", "other"),
        step("keep", "kept"),
        step("look", "after", 3),
        *(
            each
            for k, end in enumerate(ends)
            for each in (step("live"), step("follow", f"again {k}"), *end, step("ended", f"end {k}"))
        ),
    )


class TestLive:
    def test_the_cloth_lies_where_the_coarse_cloth_does(self, lively: Seen) -> None:
        for label, frame in (("first", 2), ("bent", 2), ("third", 3), ("other", 3)):
            assert lively.found[label]["state"] == "settled", lively.found[label]
            within_a_cage_edge(lively, label, frame, name=LIVE)

    def test_it_follows_values_and_frames(self, lively: Seen) -> None:
        bent = lively.array("bent", LIVE, 2) - lively.array("first", LIVE, 2)
        assert np.abs(bent).max() > 1e-3
        assert np.abs(lively.array("third", LIVE, 3) - lively.array("bent", LIVE, 2)).max() > 0.1
        assert lively.found["bent"]["first"] < 5.0

    def test_it_follows_undo(self, lively: Seen) -> None:
        bends = [lively.found[label]["sent"]["bendStiffness"] for label in ("bent", "stiff", "undone")]
        assert bends == pytest.approx([200e-6, 2000e-6, 200e-6])
        assert np.abs(lively.array("undone", LIVE, 2) - lively.array("stiff", LIVE, 2)).max() > 1e-3

    def test_a_level_that_is_chosen_goes_onto_the_panel(self, lively: Seen) -> None:
        level = lively.found["first"]["level"]
        assert level > 1
        assert len(lively.array("first", LIVE, 2)) == (2**level * CELLS + 1) ** 2
        assert len(lively.array("other", LIVE, 3)) == (2 * CELLS + 1) ** 2

    def test_other_objects_are_hidden_and_come_back(self, lively: Seen) -> None:
        before, on = lively.found["before"]["objects"], lively.found["on"]["objects"]
        assert set(on) - set(before) == {LIVE}
        assert (on[COAT]["hidden"], on[LIVE]["collections"]) == (True, ["PhysGraph"])
        assert not lively.found["after"]["objects"][FINE]["hidden"]
        again = lively.found["on again"]["objects"]
        assert {name: again[name]["hidden"] for name in (COAT, FINE, LIVE)} == {COAT: True, FINE: True, LIVE: False}
        last = lively.found["at last"]["objects"]
        assert {name: item["hidden"] for name, item in last.items() if name in (COAT, FINE, LIVE)} == {
            COAT: False,
            FINE: False,
        }

    def test_keep_refines_with_the_values_that_were_shown(self, lively: Seen) -> None:
        assert lively.found["kept"] == ["FINISHED"]
        objects = lively.found["after"]["objects"]
        assert LIVE not in objects
        assert objects[FINE]["points"] == (2 * CELLS + 1) ** 2
        report = Path(lively.found["after"]["report"]).with_name("report.json")
        garment = json.loads(report.read_text())["garments"][0]
        assert garment["fabric"]["bend"] == pytest.approx(200e-6)
        assert garment["fabric"]["stretch"] == PRESETS["silk"].stretch
        assert garment["fabric"]["guide"] == 1000.0
        assert garment["level"] == 1

    def test_each_end_ends_the_process_and_removes_its_files(self, lively: Seen) -> None:
        assert [lively.found[f"end {k}"] for k in range(4)] == [0, 0, -9, 0]
        assert len(list((lively.folder / "physgraph").glob("*.coarse.usdc"))) == 1, "of Keep"

    def test_the_panel_shows_the_buttons_and_why_it_ended(self, lively: Seen) -> None:
        buttons = [names for kind, *names in lively.found["drawn"] if kind == "operator"]
        assert buttons == [["physgraph.refine"], ["physgraph.live"], ["physgraph.keep"]]
        after = lively.found["drawn after"]
        assert ["operator", "physgraph.keep"] not in after
        assert ["label"] in after
        assert "ended" in lively.found["killed"]["failure"]


def test_keep_gives_the_cloth_that_was_shown(odd: Seen) -> None:
    """Of a single frame: in a range each frame follows from the one before."""
    for label in ("m", "cm"):
        shown, kept = odd.array(f"live {label}", LIVE, 3), odd.array(f"kept {label}", FINE, 3)
        added = kept[: (CELLS + 1) ** 2] - odd.array(f"kept {label}", COAT, 3)
        assert np.abs(kept - shown).max() < 1e-3 * np.abs(added).max()


def test_live_in_centimetres_is_as_large_as_in_metres(odd: Seen) -> None:
    apart = odd.array("live cm", LIVE, 3) / 100.0 - odd.array("live m", LIVE, 3)
    moved = odd.array("live m", LIVE, 3)[: (CELLS + 1) ** 2] - odd.array("live m", COAT, 3)
    assert np.abs(moved).max() > 5e-4
    assert np.abs(apart).max() < 1e-2 * np.abs(moved).max()
