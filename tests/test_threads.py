"""Kernels: any number of threads gives the same bits, and what nobody asks for is never compiled."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportArgumentType=false

import errno
import os
from collections import defaultdict
from pathlib import Path

import pytest
import torch
import warp as wp
from shots import cloth_shot, command

from physgraph_usd.errors import PhysGraphError
from physgraph_usd.solver.mesh import threads as threads_module
from physgraph_usd.solver.mesh.kernels import start_warp
from physgraph_usd.solver.mesh.threads import Launch


@pytest.fixture(autouse=True)
def slow_items(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each item counts as a second of work, so that launches use all threads."""
    monkeypatch.setattr(threads_module, "_item_seconds", defaultdict(lambda: 1.0))


class TestSlices:
    @pytest.mark.parametrize("size", [1, 7, 500, 501, 12345, 300_200])
    def test_each_item_is_in_one(self, size: int):
        out = torch.zeros(size, dtype=torch.int32)
        launch = Launch(_meet, size, [wp.from_torch(out)], device="cpu", threads=2)
        launch({})
        assert bool((out == 1).all())
        launch({})
        assert bool((out == 2).all())


@wp.kernel
def _meet(first: wp.int32, out: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    out[i] = out[i] + 1


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
