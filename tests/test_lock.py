"""Who holds a folder, and who may not: `test_interruptions.py` has two runs at once."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from physgraph_usd.errors import LayerError
from physgraph_usd.shot import lock
from physgraph_usd.shot.lock import LOCK, FolderLock, is_held


def test_one_holds_it_at_a_time(tmp_path: Path):
    folder = tmp_path / "frames"
    first = FolderLock(folder, layer=tmp_path / "fine.usdc")
    assert is_held(folder)
    with pytest.raises(LayerError, match=rf"fine\.usdc is being made by process {os.getpid()} on "):
        FolderLock(folder, layer=tmp_path / "fine.usdc")
    first.release()
    assert not is_held(folder)
    assert not list(tmp_path.iterdir())
    FolderLock(folder, layer=tmp_path / "fine.usdc").release()


def test_what_a_dead_process_left_holds_nothing(tmp_path: Path):
    (tmp_path / LOCK).write_text("process 1 on elsewhere")
    assert not is_held(tmp_path)
    FolderLock(tmp_path, layer=tmp_path / "fine.usdc").release()


def test_who_waited_for_a_file_that_its_holder_removes_makes_one_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Between opening the file and holding it, the run that held it ends and removes it."""
    folder, hold = tmp_path / "frames", lock._hold
    first = FolderLock(folder, layer=tmp_path / "fine.usdc")

    def late(handle: int) -> None:
        monkeypatch.setattr(lock, "_hold", hold)
        first.release()
        hold(handle)

    monkeypatch.setattr(lock, "_hold", late)
    second = FolderLock(folder, layer=tmp_path / "fine.usdc")
    assert is_held(folder)
    second.release()


def test_a_disk_that_knows_no_locks_lets_everybody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def none(handle: int) -> None:
        raise OSError("no locks available")

    monkeypatch.setattr(lock, "_hold", none)
    for each in [FolderLock(tmp_path / "frames", layer=tmp_path / "fine.usdc") for _ in range(2)]:
        each.release()


def test_windows_holds_a_byte_in_place_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As far as it can be told here: with a stand-in for the module that only Windows has."""
    held: list[int] = []

    def locking(handle: int, mode: int, count: int) -> None:
        if held:
            raise PermissionError
        held.append(handle)

    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))
    monkeypatch.setattr(sys, "platform", "win32")
    spec = importlib.util.spec_from_file_location("physgraph_usd.shot.lock_of_windows", lock.__file__)
    assert spec is not None
    assert spec.loader is not None
    there = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(there)
    first = there.FolderLock(tmp_path / "frames", layer=tmp_path / "fine.usdc")
    assert there.is_held(tmp_path / "frames")
    first.release()
