"""Milliseconds of the CPU's kernels for eight elements at once, beside those of the plain kernels, on one core.

    python -m benchmarks.step --kernels

A waved square sheet of triangles; parameters are random. The least of 40 runs in turns, and the largest difference of
the forces, or displacements, over the largest.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
import warp as wp
from torch import Tensor

from benchmarks.rows import say
from physgraph_usd.solver.forces import bending, membrane, stretch
from physgraph_usd.solver.integrate.base import System
from physgraph_usd.solver.integrate.eight_vertices import EightPhysgraph
from physgraph_usd.solver.integrate.fused import FusedPhysgraph
from physgraph_usd.solver.integrate.network import PhysgraphConfig
from physgraph_usd.solver.integrate.vertex_frame import VertexFrame
from physgraph_usd.solver.integrate.weights import random_network
from physgraph_usd.solver.mesh.simd import EIGHT
from physgraph_usd.solver.mesh.stencil import vectors
from physgraph_usd.solver.mesh.threads import Launch

REPEATS = 40


def compare(system: System, x: Tensor, config: PhysgraphConfig) -> None:
    """Print a row a kernel, at positions of a sheet [m]; the network is of a given size."""
    torch.set_num_threads(1)
    level = system.level
    assert level is not None
    six, four = level.hinges, level.hinges[:, [0, 1, 2, 4]]
    say("| kernel | items | plain | eight at once | difference |\n|---|---|---|---|---|")
    row("springs", len(level.springs), *elements(stretch._KERNELS, stretch._EIGHT, x, corners=level.springs))
    row("membrane", len(level.membrane), *elements(membrane._KERNELS, membrane._EIGHT, x, corners=level.membrane))
    row("hinges", len(four), *elements(bending._KERNELS, bending._EIGHT, x, corners=four))
    row("quads", len(six), *elements(bending._KERNELS_OF_QUADS, bending._EIGHT_OF_QUADS, x, corners=six))
    network, around = random_network(config, seed=1, scale=0.1), VertexFrame(level, x)
    two = FusedPhysgraph(network, len(x), 0.5, device="cpu", threads=1)
    bases = [0.001 * torch.randn(x.shape, generator=torch.Generator().manual_seed(1)) for _ in two.bases]
    calls = [
        lambda each=each: each(bases, system.spacing, system.reach, 3, frame=lambda: around)
        for each in (two, EightPhysgraph(network, len(x), 0.5, threads=1))
    ]
    row("network", len(x), *calls)


def elements(kernels: dict[torch.dtype, wp.Kernel], eight: wp.Kernel, x: Tensor, *, corners: Tensor) -> list[Callable]:
    """A call of each of two element kernels, returning forces."""
    count, width = corners.shape
    packed = wp.from_torch(corners.contiguous(), dtype=wp.types.vector(length=width, dtype=wp.int32))
    numbers = torch.rand((2, count, 4) if width == 3 else (2, count), generator=torch.Generator().manual_seed(1)) + 0.5
    parameters = [vectors(each) if width == 3 else wp.from_torch(each) for each in numbers]
    calls = []
    for kernel, at_once in ((kernels[torch.float32], 1), (eight, EIGHT)):
        energy, force = torch.zeros(count), torch.zeros((count * width, 3))
        inputs = [vectors(x), packed, *parameters, wp.from_torch(energy), vectors(force)]
        launch = Launch(kernel, count, inputs, device="cpu", at_once=at_once)
        calls.append(lambda launch=launch, force=force: (launch({}), force)[1])
    return calls


def row(name: str, items: int, plain: Callable[[], Tensor], eight: Callable[[], Tensor]) -> None:
    """Print the least times of two calls, and how far their results differ."""
    least, results = [float("inf")] * 2, [plain(), eight()]
    for _ in range(REPEATS):
        for place, call in enumerate((plain, eight)):
            start = time.perf_counter()
            call()
            least[place] = min(least[place], time.perf_counter() - start)
    off = float((results[0] - results[1]).abs().max() / results[0].abs().max())
    say(f"| {name} | {items:,} | {1e3 * least[0]:.2f} ms | {1e3 * least[1]:.2f} ms | {off:.1e} |")
