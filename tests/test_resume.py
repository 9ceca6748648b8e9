"""``--resume`` where layers are there already: what the same run made is done, nothing else is replaced."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pxr import Usd, UsdGeom
from shots import CLOTH, cloth_shot, faults, refine, run

from physgraph_usd.errors import UsageError

SHORT: dict[str, Any] = {"steps": 1, "tolerance": 1e-6}
"""So that no frame settles."""


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "shot.usdc")


def edited(shot: Path, change: Callable[[UsdGeom.Mesh], object]) -> None:
    stage = Usd.Stage.Open(str(shot))
    change(UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)))
    stage.Save()


def test_a_batch_goes_on_at_the_shot_where_it_ended(tmp_path: Path):
    """Of three shots one is done, one was made with other options, one is not there yet."""
    names = ("done", "other", "new")
    shots = [cloth_shot(tmp_path / f"{name}.usdc", times=(1.0, 2.0)) for name in names]
    layers = [tmp_path / "out" / f"{name}.refined.usdc" for name in names]
    line = ("refine", *shots, "-o", tmp_path / "out", "--level", "1", "--steps", "6")
    (tmp_path / "out").mkdir()
    for number, steps in ((0, 6), (1, 5)):
        refine(shots[number], layers[number], steps=steps)
    before = [layer.stat().st_mtime_ns for layer in layers[:2]]
    ended = run(*line, "--resume")
    assert ended.exit_code == 3, ended.stderr
    assert f"{layers[0]} is taken as done" in ended.stderr
    assert f"error: {shots[1]}: {layers[1]} exists; choose another name" in ended.stderr
    assert ended.stdout.split() == [str(layers[0]), str(layers[2])]
    assert [layer.stat().st_mtime_ns for layer in layers[:2]] == before
    assert faults(layers[2], shots[2]) == []
    again = run(*line, "--resume", "--overwrite")
    assert again.exit_code == 0, again.stderr
    assert again.stderr.count("is taken as done") == 2
    assert [layer.stat().st_mtime_ns for layer in layers[:2]] != before


@pytest.mark.parametrize("name", ["fine.usdc", "fine.usda"])
def test_a_whole_layer_is_done_with_all_that_was_asked_for(shot: Path, tmp_path: Path, name: str):
    out, asked = tmp_path / name, {"root": tmp_path / "root.usda", "report": tmp_path / "report.json"}
    refine(shot, out, **asked)
    written = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    done = refine(shot, out, **asked, resume=True)
    assert (done.exit_code, done.out, done.frames) == (0, out, [])
    assert written == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}


@pytest.mark.parametrize(
    "asked",
    [
        {"steps": 5},
        {"report": Path("report.json")},
        {"root": Path("root.usda")},
        {"strict": True},
        {"velocities": True},
    ],
)
def test_it_is_not_where_more_or_something_else_is_asked_for(shot: Path, tmp_path: Path, asked: dict[str, Any]):
    """Strictly, a layer with frames that did not settle is not done."""
    out = tmp_path / "fine.usdc"
    assert refine(shot, out, **SHORT).unsettled
    asked = {name: tmp_path / value if isinstance(value, Path) else value for name, value in asked.items()}
    with pytest.raises(UsageError, match=r"fine\.usdc exists"):
        refine(shot, out, **SHORT | asked, resume=True)
    told = ["report.json"] if "report" in asked else []  # A run that fails says so in its report.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fine.usdc", *told, "shot.usdc"]


def test_it_is_not_where_the_shot_was_edited(shot: Path, tmp_path: Path):
    refine(shot, tmp_path / "fine.usdc")
    edited(shot, lambda mesh: mesh.GetPointsAttr().Set(mesh.GetPointsAttr().Get(2.0), 3.0))
    with pytest.raises(UsageError, match=r"fine\.usdc exists"):
        refine(shot, tmp_path / "fine.usdc", resume=True)


def test_it_is_not_where_frames_failed(shot: Path, tmp_path: Path):
    edited(shot, lambda mesh: mesh.GetPointsAttr().Set(mesh.GetPointsAttr().Get(4.0)[:-1], 4.0))
    assert list(refine(shot, tmp_path / "fine.usdc").failed) == ["4"]
    with pytest.raises(UsageError, match=r"fine\.usdc exists"):
        refine(shot, tmp_path / "fine.usdc", resume=True)


def test_a_file_that_is_no_layer_of_ours_is_left_alone(shot: Path, tmp_path: Path):
    (tmp_path / "fine.usdc").write_bytes(b"PXR-USDC" + bytes(200))
    with pytest.raises(UsageError, match=r"fine\.usdc exists"):
        refine(shot, tmp_path / "fine.usdc", resume=True)
