"""Kernels: any number of threads gives the same bits, and what nobody asks for is never compiled."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportArgumentType=false

from __future__ import annotations

import errno
import os
from collections import defaultdict
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
import torch
import warp as wp
from shots import cloth_shot, command

import physgraph_usd
from physgraph_usd.errors import PhysGraphError
from physgraph_usd.solver.mesh import threads as threads_module
from physgraph_usd.solver.mesh.kernels import start_warp
from physgraph_usd.solver.mesh.stencil import Stencil
from physgraph_usd.solver.mesh.threads import Launch


@pytest.fixture(autouse=True)
def slow_items(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each item counts as a second of work, so that launches use all threads."""
    monkeypatch.setattr(threads_module, "_item_seconds", defaultdict(lambda: 1.0))


@pytest.mark.parametrize("rows", [3, 4000, 12_007])
def test_threads_give_the_same_bits(rows: int) -> None:
    rng = np.random.default_rng(3)
    matrix = sp.csr_matrix(sp.random(rows, 50, density=0.1, random_state=rng))
    x = torch.as_tensor(rng.normal(size=(50, 3)), dtype=torch.float32)
    alone, shared = (Stencil(matrix, dtype=torch.float32, device="cpu", threads=threads).apply(x) for threads in (1, 3))
    assert torch.equal(alone, shared)
    assert np.allclose(alone.numpy(), matrix @ x.numpy(), atol=1e-5)


class TestSlices:
    @pytest.mark.parametrize("size", [1, 7, 500, 501, 12345, 300_200])
    def test_each_item_is_in_one(self, size: int):
        out = torch.zeros(size, dtype=torch.int32)
        launch = Launch(_meet, size, [wp.from_torch(out)], device="cpu", threads=2)
        launch({})
        assert bool((out == 1).all())
        launch({})
        assert bool((out == 2).all())

    def test_a_launch_gets_threads_once_its_work_is_known_to_be_worth_them(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr(threads_module, "LEAST_SECONDS", 1e-3)
        asked: list[int] = []
        monkeypatch.setattr(Launch, "_shared", lambda _self, threads, _work: asked.append(threads) or 1.0)
        monkeypatch.setattr(threads_module, "_item_seconds", known := defaultdict(float))
        launch = Launch(_meet, 1000, [wp.zeros(1000, dtype=wp.int32, device="cpu")], device="cpu", threads=8)
        launch({})
        assert asked == []
        (name,) = known
        for seconds in (1e-6, 1.9e-6, 2.1e-6, 1.0):
            known[name] = seconds
            launch({})
        assert asked == [2, 8]


@wp.kernel
def _meet(first: wp.int32, out: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    out[i] = out[i] + 1


def test_no_backward_pass_is_compiled() -> None:
    """Forces are written by hand: compiling derivatives of kernels took more than half of a first run's wait."""
    root = Path(physgraph_usd.__file__).parent
    files = [path for path in root.rglob("*.py") if "@wp.kernel" in path.read_text() and "peers" not in path.parts]
    names = [".".join((root.name, *path.relative_to(root).with_suffix("").parts)) for path in files]
    assert len(names) > 5
    options = {name: wp.get_module_options(import_module(name)) for name in names}
    assert not [name for name, each in options.items() if each["enable_backward"]]


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
