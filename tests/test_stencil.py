"""Sparse maps on vertex arrays against scipy's product."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from hypothesis import given
from hypothesis import strategies as st

from physgraph_usd.solver.mesh.stencil import Stencil


@given(rows=st.integers(1, 8), columns=st.integers(1, 8), density=st.floats(0, 1), seed=st.integers(0, 2**16))
def test_apply_is_the_product(rows: int, columns: int, density: float, seed: int):
    rng = np.random.default_rng(seed)
    matrix = sp.csr_matrix(np.where(rng.random((rows, columns)) < density, rng.normal(size=(rows, columns)), 0.0))
    x = rng.normal(size=(columns, 3))
    for dtype, tolerance in ((torch.float64, 1e-13), (torch.float32, 1e-5)):
        stencil = Stencil(matrix, dtype=dtype, device="cpu")
        assert stencil.shape == (rows, columns)
        image = stencil.apply(torch.as_tensor(x, dtype=dtype))
        assert np.allclose(image.numpy(), matrix @ x, atol=tolerance)
        assert image.dtype == dtype
        assert torch.equal(image, stencil.apply(torch.as_tensor(x, dtype=dtype)))


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (0, 0)])
def test_empty_maps(shape: tuple[int, int]):
    image = Stencil(sp.csr_matrix(shape), dtype=torch.float32, device="cpu").apply(torch.ones((shape[1], 3)))
    assert image.shape == (shape[0], 3)
    assert not image.any()


def test_unsorted_rows_are_summed_in_one_order():
    """In single precision 1e8 + 1 - 1e8 is 0 and 1e8 - 1e8 + 1 is 1."""
    matrix = sp.csr_matrix((np.array([1e8, -1e8, 1.0]), np.array([0, 2, 1]), np.array([0, 3])), shape=(1, 3))
    ordered = matrix.copy()
    ordered.sort_indices()
    images = [Stencil(m, dtype=torch.float32, device="cpu").apply(torch.ones((3, 3))) for m in (matrix, ordered)]
    assert torch.equal(*images)
    assert images[0].tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.gpu
def test_cuda_gives_the_same():
    rng = np.random.default_rng(1)
    matrix = sp.csr_matrix(np.where(rng.random((50, 40)) < 0.2, 1.7, 0.0))
    x = torch.randn((40, 3), dtype=torch.float64)
    here = Stencil(matrix, dtype=torch.float64, device="cpu").apply(x)
    there = Stencil(matrix, dtype=torch.float64, device="cuda").apply(x.cuda())
    assert torch.allclose(here, there.cpu(), rtol=1e-13)
