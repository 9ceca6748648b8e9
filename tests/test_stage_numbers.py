"""Numbers of a stage and of its fabric that cannot be used are refused before the solve, and JSON is JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pxr", reason="shots are read with usd-core")

from pxr import Sdf, Usd
from shots import cloth_shot, run

from physgraph_usd.shot.plain_json import to_json
from physgraph_usd.solver.frame.refiner import Refiner

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
