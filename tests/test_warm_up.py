"""Kernels are compiled once, ahead of the first run."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from shots import cloth_shot, command

from physgraph_usd.errors import PhysGraphError
from physgraph_usd.solver.mesh.kernels import start_warp


def test_a_folder_that_cannot_be_made_for_kernels_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def init() -> None:
        raise OSError(errno.EROFS, "Read-only file system", "/cache/warp")

    monkeypatch.setattr("warp.init", init)
    with pytest.raises(
        PhysGraphError, match="/cache/warp: Read-only file system; WARP_CACHE_PATH names another folder"
    ):
        start_warp.__wrapped__()


@pytest.mark.slow
def test_after_warm_up_the_first_refine_compiles_nothing(tmp_path: Path) -> None:
    cache, shot = tmp_path / "cache", cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0))
    there = os.environ | {"WARP_CACHE_PATH": str(cache)}

    def files() -> set[Path]:
        return {file for file in cache.rglob("*") if file.is_file()}

    told = command("refine", shot, "-o", tmp_path / "cold.usdc", "--level", "1", "-v", env=there)
    assert "kernels are compiled" in told.stderr
    assert command("warm-up", env=there).returncode == 0
    compiled = files()
    assert len(compiled) > 10
    done = command("refine", shot, "-o", tmp_path / "out.usdc", "--level", "1", "-v", env=there)
    assert done.returncode == 0, done.stderr
    assert "kernels are compiled" not in done.stderr
    assert files() == compiled
