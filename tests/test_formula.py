"""Kernels made from one formula: single against double precision, blocks, threads, and that CUDA compiles them."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
import torch
import warp as wp
from torch import Tensor

from physgraph_usd.solver.forces import base, bending, membrane, self_contact, stretch
from physgraph_usd.solver.integrate.fused import fused_kernel
from physgraph_usd.solver.integrate.network import VECTORS, PhysgraphConfig
from physgraph_usd.solver.mesh import stencil
from physgraph_usd.solver.mesh import threads as threads_module
from physgraph_usd.solver.mesh.formula import block_size
from physgraph_usd.solver.mesh.stencil import Stencil, incidence, vectors
from physgraph_usd.solver.mesh.threads import Launch

VERTICES = 500
KERNELS_OF = {
    "stretch": (stretch._KERNELS, 2, 1),
    "membrane": (membrane._KERNELS, 3, 4),
    "bending": (bending._KERNELS, 4, 1),
    "bending of quads": (bending._KERNELS_OF_QUADS, 6, 1),
    "contact": (self_contact._KERNELS, 4, 4),
}
"""Kernels, corners of an element, and numbers in a parameter."""


@dataclass(frozen=True, eq=False)
class Case:
    """Positions, corners and parameters of elements."""

    name: str
    x: Tensor
    corners: Tensor
    parameters: list[Tensor]

    def where(self, kept: Tensor) -> Case:
        parameters = [each[kept].contiguous() for each in self.parameters]
        return Case(self.name, self.x, self.corners[kept].contiguous(), parameters)

    def evaluate(self, dtype: torch.dtype = torch.float32, *, threads: int = 1) -> tuple[Tensor, Tensor]:
        count, width = self.corners.shape
        energy = torch.full((count,), math.nan, dtype=dtype)
        force = torch.full((count * width, 3), math.nan, dtype=dtype)
        own = [each.to(dtype) for each in self.parameters]
        inputs = [
            vectors(self.x.to(dtype)),
            wp.from_torch(self.corners, dtype=wp.types.vector(length=width, dtype=wp.int32)),
            *(vectors(each) if each.ndim == 2 else wp.from_torch(each) for each in own),
            wp.from_torch(energy),
            vectors(force),
        ]
        kernel = KERNELS_OF[self.name][0][dtype]
        Launch(kernel, count, inputs, device="cpu", threads=threads, at_once=block_size("cpu"))({})
        return energy, force


def case_of(name: str, count: int, seed: int = 0) -> Case:
    """Random elements; some with coincident corners, collinear corners, and hinges folded flat."""
    (_, width, numbers), rng = KERNELS_OF[name], np.random.default_rng(seed)
    x = rng.normal(size=(VERTICES, 3)).astype(np.float32)
    x[1] = x[0]
    x[2] = 0.5 * (x[3] + x[4])
    x[5:9] = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 1, 0]]  # Hinges of 5, 6, 7 and 8 are half a turn from flat.
    corners = rng.integers(0, VERTICES, size=(count, width))
    corners[::7] = rng.integers(0, 2, size=corners[::7].shape)
    corners[::11] = rng.integers(2, 5, size=corners[::11].shape)
    corners[::13] = [5, 6, 7, 8, 7, 8][:width]
    size = (count,) if numbers == 1 else (count, numbers)
    parameters = [torch.as_tensor(rng.uniform(0.1, 1.5, size=size).astype(np.float32)) for _ in range(2)]
    return Case(name, torch.as_tensor(x), torch.as_tensor(corners.astype(np.int32)), parameters)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 1003])
@pytest.mark.parametrize("name", KERNELS_OF)
def test_single_precision_is_double_precision_rounded(name: str, count: int) -> None:
    case = case_of(name, count)
    energy, force = case.evaluate()
    assert bool(energy.isfinite().all())
    assert bool(force.isfinite().all())
    sound = torch.ones(count, dtype=torch.bool)
    for every in (7, 11, 13):
        sound[::every] = False
    if sound.any():
        case = case.where(sound)
        for value, exact in zip(case.evaluate(), case.evaluate(torch.float64), strict=True):
            assert float((value - exact).abs().max()) <= 1e-5 * float(exact.abs().max())


@pytest.mark.parametrize("name", KERNELS_OF)
def test_elements_do_not_depend_on_their_neighbours(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither on the place in a block, nor on the number of threads."""
    monkeypatch.setattr(threads_module, "_item_seconds", defaultdict(lambda: 1.0))
    count = 12_005
    case = case_of(name, count)
    energy, force = case.evaluate()
    for threads in (2, 3):
        e, f = case.evaluate(threads=threads)
        assert torch.equal(e, energy)
        assert torch.equal(f, force)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(1))
    e, f = case.where(order).evaluate()
    assert torch.equal(e, energy[order])
    assert torch.equal(f.reshape(count, -1), force.reshape(count, -1)[order])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_vertices_gather_their_corners(dtype: torch.dtype) -> None:
    rng = np.random.default_rng(4)
    corners = torch.as_tensor(rng.integers(0, VERTICES, size=(2000, 4)).astype(np.int32))
    starts, slots = incidence(corners, VERTICES)
    corner_force = torch.as_tensor(rng.normal(size=(8001, 3))).to(dtype)[:-1]
    total = torch.ones(VERTICES, 3, dtype=dtype)
    inputs = [wp.from_torch(starts), wp.from_torch(slots), vectors(corner_force), vectors(total)]
    Launch(base._GATHER[dtype], VERTICES, inputs, device="cpu")({})
    right = torch.ones_like(total).index_add_(0, corners.reshape(-1).long(), corner_force)
    torch.testing.assert_close(total, right, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_stencil_is_its_matrix(dtype: torch.dtype) -> None:
    rng = np.random.default_rng(5)
    matrix = sp.csr_matrix(sp.random(300, VERTICES, density=0.02, random_state=rng))
    x = torch.as_tensor(rng.normal(size=(VERTICES, 3))).to(dtype)
    right = torch.as_tensor(matrix @ x.double().numpy()).to(dtype)
    torch.testing.assert_close(Stencil(matrix, dtype=dtype, device="cpu").apply(x), right, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_every_formula_compiles_for_cuda(tmp_path: Path) -> None:
    """Needs no card: the compiler is in Warp."""
    tables = [*(kernels for kernels, *_ in KERNELS_OF.values()), base._GATHER, stencil._GATHER]
    network = fused_kernel(PhysgraphConfig(vectors=VECTORS, width=16, depth=3))
    for kernel in (*(kernel for table in tables for kernel in table.values()), network):
        wp.compile_aot_module(kernel.module, device=None, arch=90, module_dir=str(tmp_path), use_ptx=True)
    assert len(list(tmp_path.glob("*.ptx"))) == 2 * len(tables) + 1
