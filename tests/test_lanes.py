"""Prepared launches: the number of lanes changes no bit, and no kernel is compiled for what nobody asks."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
import torch
import warp as wp

import physgraph_usd
from physgraph_usd.mesh.lanes import LEAST_PER_LANE
from physgraph_usd.mesh.stencil import Stencil


@pytest.mark.parametrize("rows", [3, LEAST_PER_LANE, 3 * LEAST_PER_LANE + 7])
def test_lanes_give_the_same_bits(rows: int) -> None:
    rng = np.random.default_rng(3)
    matrix = sp.csr_matrix(sp.random(rows, 50, density=0.1, random_state=rng))
    x = torch.as_tensor(rng.normal(size=(50, 3)), dtype=torch.float32)
    alone, shared = (Stencil(matrix, dtype=torch.float32, device="cpu", lanes=lanes).apply(x) for lanes in (1, 3))
    assert torch.equal(alone, shared)
    assert np.allclose(alone.numpy(), matrix @ x.numpy(), atol=1e-5)


def test_no_backward_pass_is_compiled() -> None:
    """Forces are written by hand: compiling derivatives of kernels took more than half of a first run's wait."""
    root = Path(physgraph_usd.__file__).parent
    files = [path for path in root.rglob("*.py") if "@wp.kernel" in path.read_text() and "peers" not in path.parts]
    names = [".".join((root.name, *path.relative_to(root).with_suffix("").parts)) for path in files]
    assert len(names) > 10
    options = {name: wp.get_module_options(import_module(name)) for name in names}
    assert not [name for name, each in options.items() if each["enable_backward"]]
