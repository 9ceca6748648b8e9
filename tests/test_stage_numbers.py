"""Numbers of a stage and of its fabric that cannot be used are refused before the solve, and JSON is JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pxr", reason="shots are read with usd-core")

from pxr import Sdf, Usd, UsdPhysics
from shots import CLOTH, cloth_shot, run

from physgraph_usd.shot.plain_json import to_json
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.usd.schema import GARMENT

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
    if key != "timeCodesPerSecond" or abs(value) < INF:  # USD looks for samples without end.
        assert key in strict(told.stdout)["problem"]
    else:
        assert key in told.stderr


@pytest.mark.usefixtures("unsolved")
def test_a_sublayer_without_a_rate_is_named(shot: Path):
    layer = Sdf.Layer.FindOrOpen(str(shot))
    layer.timeCodesPerSecond = 0.0
    layer.Save()
    top = shot.with_name("top.usda")
    top.write_text("#usda 1.0\n(subLayers = [@./shot.usda@])\n")
    result = run("refine", top, "-o", shot.with_name("fine.usdc"), *SMALL)
    assert (result.exit_code, "timeCodesPerSecond of @shot.usda@ is 0" in result.stderr) == (1, True), result.output


@pytest.mark.usefixtures("unsolved")
@pytest.mark.parametrize(
    "row", [row for row in GARMENT.values() if row.type == "float" and not row.interpolation], ids=lambda row: row.short
)
def test_every_physical_value_has_an_upper_limit(shot: Path, row: Any):
    assert row.maximum is not None
    result = run("refine", shot, "-o", shot.with_name("fine.usdc"), "--set", f"{row.short}=1e30", *SMALL)
    assert (result.exit_code, f"{row.maximum:g}]" in result.stderr) == (2, True), result.output
    stage = Usd.Stage.Open(str(shot))
    stage.GetPrimAtPath(CLOTH).CreateAttribute(row.name, Sdf.ValueTypeNames.Float).Set(1e30)
    stage.Save()
    result = run("refine", shot, "-o", shot.with_name("fine.usdc"), *SMALL)
    assert (result.exit_code, f"{row.maximum:g}]" in result.stderr) == (1, True), result.output


def test_a_gravity_of_no_planet_is_the_earth_s(shot: Path):
    stage = Usd.Stage.Open(str(shot))
    UsdPhysics.Scene.Define(stage, "/World/physics").CreateGravityMagnitudeAttr(1e30)
    stage.Save()
    report = shot.with_name("report.json")
    result = run("refine", shot, "-o", shot.with_name("fine.usdc"), "--report", report, *SMALL)
    assert result.exit_code == 0, result.output
    plain = strict(report.read_text())
    assert any("physics:gravityMagnitude is 1" in warning for warning in plain["warnings"])


def test_json_is_what_every_parser_reads(tmp_path: Path):
    assert strict(to_json({"a": NAN, "b": [INF, -INF, 1.5, (NAN,)], "c": tmp_path}, default=str)) == {
        "a": None,
        "b": [None, None, 1.5, [None]],
        "c": str(tmp_path),
    }


@pytest.mark.parametrize("rate", [0.0, -1.0, NAN, INF])
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
