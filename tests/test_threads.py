"""Prepared launches: the number of threads changes no bit, and no kernel is compiled for what nobody asks."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportArgumentType=false

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
import torch
import warp as wp

import physgraph_usd
from physgraph_usd.solver.mesh.stencil import Stencil
from physgraph_usd.solver.mesh.threads import LEAST_PER_THREAD, LEAST_QUERIES, Launch


@pytest.mark.parametrize("rows", [3, LEAST_PER_THREAD, 3 * LEAST_PER_THREAD + 7])
def test_threads_give_the_same_bits(rows: int) -> None:
    rng = np.random.default_rng(3)
    matrix = sp.csr_matrix(sp.random(rows, 50, density=0.1, random_state=rng))
    x = torch.as_tensor(rng.normal(size=(50, 3)), dtype=torch.float32)
    alone, shared = (Stencil(matrix, dtype=torch.float32, device="cpu", threads=threads).apply(x) for threads in (1, 3))
    assert torch.equal(alone, shared)
    assert np.allclose(alone.numpy(), matrix @ x.numpy(), atol=1e-5)


class TestSlices:
    @pytest.mark.parametrize("size", [500, 501, 12345, 300_200])
    def test_each_item_is_in_one(self, size: int):
        counts = self.counted(size, least=LEAST_QUERIES)
        assert bool((counts == 1).all())

    @staticmethod
    def counted(size: int, *, least: int, threads: int = 2) -> torch.Tensor:
        """How often each item is met."""
        wp.init()
        out = torch.zeros(size, dtype=torch.int32)
        Launch(_meet, size, [wp.from_torch(out)], device="cpu", threads=threads, least=least)({})
        return out


@wp.kernel
def _meet(first: wp.int32, out: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    out[i] = out[i] + 1


def test_no_backward_pass_is_compiled() -> None:
    """Forces are written by hand: compiling derivatives of kernels took more than half of a first run's wait."""
    root = Path(physgraph_usd.__file__).parent
    files = [path for path in root.rglob("*.py") if "@wp.kernel" in path.read_text() and "peers" not in path.parts]
    names = [".".join((root.name, *path.relative_to(root).with_suffix("").parts)) for path in files]
    assert len(names) > 10
    options = {name: wp.get_module_options(import_module(name)) for name in names}
    assert not [name for name, each in options.items() if each["enable_backward"]]
