"""The part of Blender's add-on that needs no Blender: its manifest, its command lines, the processes it runs."""

import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from blender import ADDON, addon_module

import physgraph_usd
from physgraph_usd import cli
from physgraph_usd.studio.values import TUNABLES
from physgraph_usd.usd.schema import GARMENT

QUICK = "--integrator quasi-newton --steps 4"


@pytest.fixture(scope="module")
def command() -> ModuleType:
    """The add-on's module that needs no Blender."""
    return addon_module("command")


def test_the_manifest_agrees_with_the_package() -> None:
    manifest = tomllib.loads((ADDON / "blender_manifest.toml").read_text(encoding="utf-8"))
    assert (manifest["id"], manifest["version"]) == ("physgraph_usd", physgraph_usd.__version__)
    assert set(manifest["permissions"]) == {"files"}
    assert manifest["type"] == "add-on"


@pytest.mark.parametrize(("said", "exists"), [(True, True), (True, False), (False, False)])
def test_the_solver_of_the_zip_is_the_usual_command_if_it_exists(
    command: ModuleType, tmp_path: Path, said: bool, exists: bool
) -> None:
    solver = tmp_path / "physgraph-usd"
    if said:
        (tmp_path / command.SOLVER_FILE).write_text(f"{solver}\n", encoding="utf-8")
    if exists:
        solver.touch()
    assert command.usual_command(tmp_path) == (str(solver) if exists else "physgraph-usd")


def test_every_setting_arrives(command: ModuleType, tmp_path: Path) -> None:
    files = command.files_of_run(tmp_path, "shot", ["Coat"])
    more, values = "--device cuda --weights 'my file'", {"stretchStiffness": 30.0, "rest:weftEase": 4.7}
    settings = command.Settings((-3, 5), preset="denim", values=values, level=-1, report=True, more=more)
    tag, refine = command.command_lines("pg", settings, files, garments=["/a", "/b"], colliders=["/c"])
    cloth = str(files.cloth)
    garments = ["--garment", "/a", "--garment", "/b"]
    assert tag == ["pg", "tag", str(files.coarse), "-o", cloth, *garments, "--preset", "denim"]
    assert refine[:3] == ["pg", "refine", cloth]
    assert refine[refine.index("--garment") :] == [
        *garments,
        *("--collider", "/c", "--frames", "-3:5", "--level", "auto"),
        *("--set", "stretchStiffness=30", "--set", "rest:weftEase=4.7"),
        *("--report", str(files.report), "--progress", "--no-keep-frames", "--device", "cuda", "--weights", "my file"),
    ]


def test_the_command_understands_each_line(command: ModuleType, tmp_path: Path) -> None:
    files = command.files_of_run(tmp_path, "shot", ["Coat"])
    for each in (files.coarse, files.cloth):  # The command asks for its shot before all else.
        each.touch()
    settings = command.Settings((-3, 5), preset="denim", values={"density": 1.0}, level=-1, report=True, more=QUICK)
    for _, name, *words in command.command_lines("pg", settings, files, garments=["/a"], colliders=["/c"]):
        context = cli.main.commands[name].make_context(name, list(words))
        assert context.params["garments"] == ("/a",)


def test_the_line_of_live_is_understood(command: ModuleType, tmp_path: Path) -> None:
    shot = tmp_path / "a.usdc"
    shot.touch()
    for more, device in (("", "cpu"), ("--workers 2 --device cuda", "cuda"), ("--device=cuda --workers 2", "cuda")):
        settings = command.Settings((1, 5), more=more)
        line = command.live_line("pg", settings, shot, garments=["/a", "/b"], colliders=["/c"])
        assert line[:3] == ["pg", "live", str(shot)]
        given = cli.main.commands["live"].make_context("live", line[2:]).params
        assert given["garments"] == ("/a", "/b")
        assert given["colliders"] == ("/c",)
        assert given["device"] == device


def test_sliders_are_those_of_tune(command: ModuleType) -> None:
    for slider in command.SLIDERS:
        row, tuned = GARMENT[slider.name], TUNABLES[slider.name]
        assert slider.factor == tuned.factor
        assert slider.unit.replace(" ", "") == tuned.unit.replace("\N{MIDDLE DOT}", "").replace(
            "\N{GREEK SMALL LETTER MU}", "\N{MICRO SIGN}"
        )
        assert row.fallback is None or slider.default / slider.factor == pytest.approx(row.fallback)
        assert [each / slider.factor for each in slider.limits] == pytest.approx([row.minimum, row.maximum])
        assert row.minimum <= slider.ends[0] / slider.factor < slider.ends[1] / slider.factor <= row.maximum


def test_jersey_is_never_taken_in_silence(command: ModuleType) -> None:
    lacking = {"Coat": ["stretchStiffness", "bendStiffness"], "Skirt": ["bendStiffness"]}
    both = command.unsaid_warnings(command.Settings((1, 2)), lacking)
    assert [("stretchStiffness" in said, "bendStiffness" in said) for said in both] == [(True, True), (False, True)]
    assert "'Coat'" in both[0]
    (left,) = command.unsaid_warnings(command.Settings((1, 2), values={"bendStiffness": 1e-5}), lacking)
    assert "stretchStiffness" in left
    assert "bendStiffness" not in left


def test_a_new_run_has_new_files(command: ModuleType, tmp_path: Path) -> None:
    first = command.files_of_run(tmp_path, "my shot", ["Coat ä", "Skirt/2"])
    assert first.layer.name == "my_shot-Coat_ä-Skirt_2.v001.refined.usdc"
    first.log.touch()
    assert command.files_of_run(tmp_path, "my shot", ["Coat ä", "Skirt/2"]).log.name.endswith(".v002.log")
    assert command.files_of_run(tmp_path, "my shot", ["Coat ä"]).log.name.endswith(".v001.log")
    long = [command.files_of_run(tmp_path, "shot", ["x" * 100 + end]).log.name for end in "ab"]
    assert long[0] != long[1]
    assert max(map(len, long)) < 100


def script(tmp_path: Path, text: str) -> list[str]:
    """A command line that runs some Python."""
    file = tmp_path / f"{len(list(tmp_path.iterdir()))}.py"
    file.write_text(text, encoding="utf-8")
    return [sys.executable, str(file)]


def test_a_run_goes_through_its_lines_and_tells_progress(command: ModuleType, tmp_path: Path) -> None:
    first = script(tmp_path, "import sys; sys.stderr.write('warning: thin\\nother words\\n')")
    second = script(
        tmp_path, "import sys; sys.stderr.write(' 25%  about 3 s left        1 of 4 frames\\n'); sys.exit(3)"
    )
    run = command.Run([first, second], tmp_path / "log")
    run.wait()
    assert run.progress() == (0.25, "about 3 s left 1 of 4 frames")
    assert run.warnings() == ["thin"]
    assert run.in_part


def test_a_failure_says_all_that_the_command_said(command: ModuleType, tmp_path: Path) -> None:
    words = "error: </root/Coat> at time code 3: no\nremedy: split it"
    text = f"import sys; sys.stderr.write(' 25%  x  y\\n' + {words!r}); sys.exit(1)"
    unreached = script(tmp_path, "raise SystemExit(7)")
    run = command.Run([script(tmp_path, text), unreached], tmp_path / "log")
    with pytest.raises(command.CommandError) as caught:
        run.wait()
    assert str(caught.value) == words


def test_cancelling_ends_the_process(command: ModuleType, tmp_path: Path) -> None:
    run = command.Run([script(tmp_path, "import time; time.sleep(60)")], tmp_path / "log")
    assert not run.poll()
    run.cancel()
    with pytest.raises(command.CommandError):
        run.poll()


def test_the_process_does_not_get_blenders_own_usd(
    command: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in command.OF_BLENDER:
        monkeypatch.setenv(name, "blender's")
    text = f"import os, sys; sys.exit(any(name in os.environ for name in {command.OF_BLENDER!r}))"
    command.Run([script(tmp_path, text)], tmp_path / "log").wait()


def test_a_wrong_path_names_the_remedy(command: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(command.CommandError, match=r"nowhere.*No such file.*Preferences"):
        command.Run([["nowhere/physgraph-usd"]], tmp_path / "log")
