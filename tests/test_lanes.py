"""Prepared launches: the number of lanes changes no bit."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import torch

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
