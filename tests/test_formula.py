"""Kernels made from one formula: that CUDA compiles them."""

from pathlib import Path

import pytest
import warp as wp

from physgraph_usd.solver.forces import base, bending, gravity, membrane, self_contact, stretch
from physgraph_usd.solver.integrate import secants
from physgraph_usd.solver.integrate.fused import fused_kernel, pack_kernel
from physgraph_usd.solver.integrate.network import VECTORS, PhysgraphConfig
from physgraph_usd.solver.mesh import stencil


@pytest.mark.slow
def test_every_formula_compiles_for_cuda(tmp_path: Path) -> None:
    """Needs no card: the compiler is in Warp."""
    tables = [stretch._KERNELS, membrane._KERNELS, bending._KERNELS, bending._KERNELS_OF_QUADS, self_contact._KERNELS]
    tables += [gravity._KERNELS, {kind: kernel for (on_card, kind), kernel in base._SUM.items() if on_card}]
    tables += [stencil._GATHER]
    config = PhysgraphConfig(vectors=VECTORS, width=16, depth=3)
    alone = fused_kernel(config), pack_kernel(VECTORS), secants._PRODUCTS_KERNEL, secants._TURN_KERNEL
    for kernel in (*(kernel for table in tables for kernel in table.values()), *alone):
        wp.compile_aot_module(kernel.module, device=None, arch=90, module_dir=str(tmp_path), use_ptx=True)
    assert len(list(tmp_path.glob("*.ptx"))) == 2 * len(tables) + len(alone)
