"""No file that is written follows a link, and nothing is removed or replaced that was not asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("pxr", reason="shots are read with usd-core")

from shots import cloth_shot, run

SMALL = ("--level", "1", "--steps", "2")


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0), size=(3, 3))


def locked(folder: Path) -> tuple[Path, tuple[object, ...]]:
    (folder / "fine.usdc.frames").mkdir()
    return folder / "fine.usdc.frames" / "run.lock", ()


OPTIONS: dict[str, Callable[[Path], tuple[Path, tuple[object, ...]]]] = {
    "lock": locked,
    "layer": lambda folder: (folder / "fine.usdc", ("--overwrite",)),
    "log": lambda folder: (folder / "run.log", ("--log-file", folder / "run.log")),
    "report": lambda folder: (folder / "run.json", ("--report", folder / "run.json", "--overwrite")),
    "page": lambda folder: (folder / "page" / "report.html", ("--report", folder / "page", "--overwrite")),
    "summary": lambda folder: (folder / "all.json", ("--summary", folder / "all.json", "--overwrite")),
    "root": lambda folder: (folder / "root.usda", ("--root", folder / "root.usda", "--overwrite")),
}


@pytest.mark.parametrize("what", OPTIONS)
@pytest.mark.parametrize("leads", ["to a file", "nowhere"])
def test_no_link_is_written_through(shot: Path, tmp_path: Path, what: str, leads: str):
    link, options = OPTIONS[what](tmp_path)
    mine = tmp_path / "mine.txt"
    if leads == "to a file":
        mine.write_text("mine")
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(mine)
    result = run("refine", shot, "-o", tmp_path / "fine.usdc", *options, *SMALL)
    assert result.exit_code == 2, result.output
    assert f"{link} is a link to {mine}; name that, or remove the link" in result.stderr
    assert link.is_symlink()
    assert (mine.read_text() if mine.exists() else None) == ("mine" if leads == "to a file" else None)


@pytest.mark.parametrize("name", ["notes.txt", "cache.npz", "1.npz.bak", "sub"])
@pytest.mark.parametrize("sign", ["run.json", "run.lock"])
def test_a_folder_with_files_that_are_not_ours_is_left(shot: Path, tmp_path: Path, name: str, sign: str):
    folder = tmp_path / "fine.usdc.frames"
    (folder / "sub").mkdir(parents=True)
    for file in (folder / sign, folder / "0.npz"):
        file.write_text("{}")
    if name != "sub":
        (folder / "sub").rmdir()
        (folder / name).write_text("mine")
    before = {file.name: None if file.is_dir() else file.read_bytes() for file in folder.iterdir()}
    result = run("refine", shot, "-o", tmp_path / "fine.usdc", "--overwrite", *SMALL)
    assert (result.exit_code, f"{name} is not a file of ours" in result.stderr) == (2, True), result.output
    assert {file.name: None if file.is_dir() else file.read_bytes() for file in folder.iterdir()} == before


@pytest.mark.parametrize("name", ["a.png", "a.gif"])
def test_a_picture_is_replaced_only_where_that_is_allowed(shot: Path, tmp_path: Path, name: str):
    pytest.importorskip("PIL", reason="previews are written with Pillow")
    picture, mine = tmp_path / name, tmp_path / "mine"
    line = ("preview", shot, "-o", picture, "--size", "64x32")
    picture.write_text("mine")
    refused = run(*line)
    assert (refused.exit_code, "exists" in refused.stderr) == (2, True), refused.output
    assert picture.read_text() == "mine"
    assert run(*line, "--overwrite").exit_code == 0
    drawn = picture.read_bytes()
    assert drawn[:3] in (b"\x89PN", b"GIF")
    picture.unlink()
    picture.symlink_to(mine)
    assert "is a link" in run(*line, "--overwrite").stderr
    assert not mine.exists()
    assert {file.name for file in tmp_path.iterdir()} == {"shot.usda", name}
