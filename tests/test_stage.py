"""Opening stages: units, axes and every way in which a file or its numbers can be broken."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Sdf, Usd
from shots import cloth_shot, run
from stages import add_sheet, add_skeleton, bind_skin, new_stage, save, sheet_shot

from physgraph_usd.errors import StageError
from physgraph_usd.shot.plain_json import to_json
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.stage import read_units


def layer(path: Path, text: str) -> str:
    path.write_text("#usda 1.0\n" + text)
    return str(path)


def with_metadata(path: Path, **values: object) -> Usd.Stage:
    made = Sdf.Layer.CreateNew(str(path))
    for key, value in values.items():
        made.pseudoRoot.SetInfo(key, value)
    made.Save()
    return Usd.Stage.Open(made)


@pytest.mark.parametrize("suffix", ["abc", "fbx", "glb"])
def test_a_file_that_usd_does_not_read_is_refused_with_the_way_in(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"coat.{suffix}"
    file.write_bytes(b"Ogawa")
    done = run("inspect", file)
    said = "USD reads no files of this kind; import the file into Blender, Maya or Houdini and export USD"
    assert (done.exit_code, f"cannot open {file}: {said}" in done.stderr) == (1, True)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_units_that_are_no_length_are_told_and_replaced(tmp_path: Path, value: float) -> None:
    units, notices = read_units(with_metadata(tmp_path / "s.usda", metersPerUnit=value))
    assert units.metres == 0.01
    assert "is no length" in str(notices[0])


@pytest.mark.parametrize("axis", ["X", "up"])
def test_an_up_axis_that_usd_does_not_know_is_told(tmp_path: Path, axis: str) -> None:
    units, notices = read_units(with_metadata(tmp_path / "s.usda", upAxis=axis, metersPerUnit=1.0))
    np.testing.assert_array_equal(units.up, [0, 1, 0])
    assert axis in str(notices[0])


@pytest.mark.parametrize("rate", [float("inf"), float("-inf"), float("nan"), 0.0])
def test_a_rate_without_end_is_refused(stage: Usd.Stage, rate: float) -> None:
    add_skeleton(stage, "/World/rig", (1.0, 2.0))
    bind_skin(add_sheet(stage, "/World/rig/cloth", times=()), "/World/rig", joints=[0] * 20)
    stage.GetRootLayer().pseudoRoot.SetInfo("timeCodesPerSecond", rate)
    with pytest.raises(StageError, match=r"timeCodesPerSecond of @s\.usda@ is .*author the shot's rate"):
        open_shot(save(stage))


def broken_files(folder: Path) -> dict[str, str]:
    good = sheet_shot(folder / "good.usda")
    crate = folder / "good.usdc"
    Usd.Stage.Open(good).Export(str(crate))
    data = crate.read_bytes()
    half, noise = folder / "half.usdc", folder / "noise.usdc"
    half.write_bytes(data[: len(data) // 2])
    noise.write_bytes(data[:88] + np.random.default_rng(1).bytes(len(data) - 88))
    (folder / "empty.usda").write_bytes(b"")
    (folder / "wrong.usdz").write_bytes(b"PK not a zip")
    return {
        "missing": str(folder / "nowhere.usda"),
        "a folder": str(folder),
        "truncated crate": str(half),
        "noise in a crate": str(noise),
        "empty file": str(folder / "empty.usda"),
        "not a zip": str(folder / "wrong.usdz"),
        "syntax": layer(folder / "syntax.usda", 'def Mesh "X" {'),
        "unknown suffix": layer(folder / "shot.xyz", ""),
        "broken sublayer": layer(folder / "s1.usda", "(subLayers = [@./syntax.usda@])"),
        "broken reference": layer(folder / "s2.usda", 'def "A" (references = @./half.usdc@) {\n}\n'),
        "sublayer circle": layer(folder / "s3.usda", "(subLayers = [@./s3.usda@])"),
        "reference circle": layer(
            folder / "s4.usda", 'def "A" (references = </B>) {\n}\ndef "B" (references = </A>) {\n}\n'
        ),
        "bad rate": layer(folder / "s5.usda", "(framesPerSecond = -1)"),
    }


def test_broken_files_are_stage_errors_that_name_the_file(tmp_path: Path) -> None:
    for case, path in broken_files(tmp_path).items():
        with pytest.raises(StageError, match=r"cannot (open|compose|read)|no such file|is no file") as caught:
            open_shot(path, garments=["*"])
        assert path in str(caught.value), case
        assert "Error in" not in str(caught.value), case


def test_a_crate_cut_anywhere_is_never_a_traceback(tmp_path: Path) -> None:
    crate = tmp_path / "good.usdc"
    Usd.Stage.Open(sheet_shot(tmp_path / "good.usda")).Export(str(crate))
    data = crate.read_bytes()
    for number, part in enumerate(np.linspace(0.02, 0.98, 13)):
        cut = tmp_path / f"cut{number}.usdc"
        cut.write_bytes(data[: int(part * len(data))])
        with pytest.raises(StageError):
            open_shot(str(cut))


@pytest.mark.parametrize("arc", ["payload", "references"])
def test_a_missing_payload_or_reference_of_a_garment_is_an_error(tmp_path: Path, arc: str) -> None:
    sheet_shot(tmp_path / "cloth.usda")
    cloth = f'over "cloth" (add {arc} = @./gone.usda@) {{\n}}\n'
    text = f'(metersPerUnit = 1\n subLayers = [@./cloth.usda@])\nover "World" {{\n{cloth}}}\n'
    with pytest.raises(StageError, match=r"</World/cloth> is incomplete: .*gone.usda"):
        open_shot(layer(tmp_path / "shot.usda", text))


def test_a_missing_payload_elsewhere_is_a_notice(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "shot.usda")
    add_sheet(stage)
    stage.DefinePrim("/World/set").GetPayloads().AddPayload("./gone.usda")
    assert any("gone.usda" in notice.message for notice in open_shot(save(stage)).warnings)


NAN, INF = float("nan"), float("inf")
SMALL = ("--level", "1", "--steps", "2")


def strict(text: str) -> Any:
    """What a parser reads that knows no more than the standard."""

    def refuse(word: str):
        raise AssertionError(f"{word} is no JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0), size=(3, 3))


@pytest.fixture
def unsolved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail a test in which a frame is solved."""

    def solve(*_: object, **__: object):
        raise AssertionError("a frame was solved")

    monkeypatch.setattr(Refiner, "solve", solve)


@pytest.mark.usefixtures("unsolved")
@pytest.mark.parametrize("value", [NAN, INF, 0.0, -1.0, 1e-45, 3e38])
@pytest.mark.parametrize(
    ("key", "remedy"),
    [
        ("metersPerUnit", "author one above 0, such as 0.01"),
        ("kilogramsPerUnit", "author one above 0, such as 1"),
        ("timeCodesPerSecond", "such as 24"),
        ("framesPerSecond", "author one above 0, such as 24"),
        ("startTimeCode", "author one or remove it"),
        ("endTimeCode", "author one or remove it"),
    ],
)
def test_stage_metadata_that_cannot_be_used_are_named(shot: Path, key: str, remedy: str, value: float):
    if key.endswith("TimeCode") and abs(value) < INF:
        pytest.skip("a time code like others")
    stage = Usd.Stage.Open(str(shot))
    stage.GetRootLayer().pseudoRoot.SetInfo(key, value)
    stage.Save()
    result = run("refine", shot, "-o", shot.with_name("fine.usdc"), "--velocities", *SMALL)
    assert result.exit_code == 1, result.output
    assert key in result.stderr
    assert remedy in result.stderr
    told = run("inspect", shot, "--json")
    assert told.exit_code == 1
    if key != "timeCodesPerSecond":  # USD may look for samples without end.
        assert key in strict(told.stdout)["problem"]
    else:
        assert key in told.stderr


def test_json_is_what_every_parser_reads(tmp_path: Path):
    assert strict(to_json({"a": NAN, "b": [INF, -INF, 1.5, (NAN,)], "c": tmp_path}, default=str)) == {
        "a": None,
        "b": [None, None, 1.5, [None]],
        "c": str(tmp_path),
    }


@pytest.mark.parametrize("rate", [0.0, NAN])
@pytest.mark.parametrize("which", ["shot.usda", "fine.usda"])
def test_validate_and_preview_name_a_rate_that_is_none(shot: Path, which: str, rate: float):
    """USD looks for samples without end."""
    fine = shot.with_name("fine.usda")
    assert run("refine", shot, "-o", fine, "--velocities", *SMALL).exit_code == 0
    layer = Sdf.Layer.FindOrOpen(str(shot.with_name(which)))
    layer.timeCodesPerSecond = rate
    layer.Save()
    for command in (("validate", fine), ("preview", fine, "-o", shot.with_name("a.gif"))):
        result = run(*command)
        assert result.exit_code == 1, result.output
        assert f"timeCodesPerSecond of @{which}@ is {rate:g}" in result.output
