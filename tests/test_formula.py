"""Kernels made from one formula: that CUDA compiles them."""

from __future__ import annotations

from pathlib import Path

import pytest
import warp as wp

from physgraph_usd.solver.forces import base, bending, membrane, self_contact, stretch
from physgraph_usd.solver.integrate.fused import fused_kernel
from physgraph_usd.solver.integrate.network import VECTORS, PhysgraphConfig
from physgraph_usd.solver.mesh import stencil


@pytest.mark.slow
def test_every_formula_compiles_for_cuda(tmp_path: Path) -> None:
    """Needs no card: the compiler is in Warp."""
    tables = [stretch._KERNELS, membrane._KERNELS, bending._KERNELS, bending._KERNELS_OF_QUADS, self_contact._KERNELS]
    tables += [base._GATHER, stencil._GATHER]
    network = fused_kernel(PhysgraphConfig(vectors=VECTORS, width=16, depth=3))
    for kernel in (*(kernel for table in tables for kernel in table.values()), network):
        wp.compile_aot_module(kernel.module, device=None, arch=90, module_dir=str(tmp_path), use_ptx=True)
    assert len(list(tmp_path.glob("*.ptx"))) == 2 * len(tables) + 1
