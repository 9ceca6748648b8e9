"""Kernels of eight elements at once against the plain kernels beside them."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pytest
import scipy.sparse as sp
import torch
import warp as wp
from cloth import finest_system, group_of, sheet, wave
from torch import Tensor

from physgraph_usd.solver.forces import base, bending, membrane, stretch
from physgraph_usd.solver.integrate.eight_vertices import EightPhysgraph
from physgraph_usd.solver.integrate.fused import FusedPhysgraph
from physgraph_usd.solver.integrate.network import VECTORS, PhysgraphConfig
from physgraph_usd.solver.integrate.vertex_frame import VertexFrame
from physgraph_usd.solver.integrate.weights import random_network
from physgraph_usd.solver.mesh import stencil
from physgraph_usd.solver.mesh import threads as threads_module
from physgraph_usd.solver.mesh.kernels import KERNELS
from physgraph_usd.solver.mesh.simd import EIGHT, eight_elements
from physgraph_usd.solver.mesh.stencil import Stencil, incidence, vectors
from physgraph_usd.solver.mesh.threads import Launch

VERTICES = 500


@dataclass(frozen=True)
class Term:
    """A kernel pair; energies and forces differ by `most` of the largest, at most."""

    plain: dict[torch.dtype, wp.Kernel]
    eight: wp.Kernel
    corners: int
    numbers: int = 1
    most: float = 0.0


TERMS = {
    "stretch": Term(stretch._KERNELS, stretch._EIGHT, 2),
    "membrane": Term(membrane._KERNELS, membrane._EIGHT, 3, numbers=4),
    "bending": Term(bending._KERNELS, bending._EIGHT, 4, most=5e-7),
    "bending of quads": Term(bending._KERNELS_OF_QUADS, bending._EIGHT_OF_QUADS, 6, most=5e-7),
}


@dataclass(frozen=True, eq=False)
class Case:
    """Positions, corners and parameters of elements."""

    x: Tensor
    corners: Tensor
    parameters: list[Tensor]

    def where(self, kept: Tensor) -> Case:
        return Case(self.x, self.corners[kept].contiguous(), [each[kept].contiguous() for each in self.parameters])

    def launch(self, kernel: wp.Kernel, dtype: torch.dtype, *, threads: int = 1) -> tuple[Launch, Tensor, Tensor]:
        count, width = self.corners.shape
        energy = torch.full((count,), math.nan, dtype=dtype)
        force = torch.full((count * width, 3), math.nan, dtype=dtype)
        inputs = [
            vectors(self.x.to(dtype)),
            wp.from_torch(self.corners, dtype=wp.types.vector(length=width, dtype=wp.int32)),
            *(vectors(each) if each.ndim == 2 else wp.from_torch(each) for each in self._in(dtype)),
            wp.from_torch(energy),
            vectors(force),
        ]
        at_once = EIGHT if kernel in [each.eight for each in TERMS.values()] else 1
        return Launch(kernel, count, inputs, device="cpu", threads=threads, at_once=at_once), energy, force

    def evaluate(self, kernel: wp.Kernel, dtype: torch.dtype = torch.float32, **options: Any) -> tuple[Tensor, Tensor]:
        launch, energy, force = self.launch(kernel, dtype, **options)
        launch({})
        return energy, force

    def _in(self, dtype: torch.dtype) -> list[Tensor]:
        return [each.to(dtype) for each in self.parameters]


def case_of(name: str, count: int, seed: int = 0) -> Case:
    """Random elements; some with coincident corners, collinear corners, and hinges folded flat."""
    term, rng = TERMS[name], np.random.default_rng(seed)
    x = rng.normal(size=(VERTICES, 3)).astype(np.float32)
    x[1] = x[0]
    x[2] = 0.5 * (x[3] + x[4])
    x[5:9] = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 1, 0]]  # Hinges of 5, 6, 7 and 8 are half a turn from flat.
    corners = rng.integers(0, VERTICES, size=(count, term.corners))
    corners[::7] = rng.integers(0, 2, size=corners[::7].shape)
    corners[::11] = rng.integers(2, 5, size=corners[::11].shape)
    corners[::13] = [5, 6, 7, 8, 7, 8][: term.corners]
    size = (count,) if term.numbers == 1 else (count, term.numbers)
    parameters = [rng.uniform(0.1, 1.5, size=size).astype(np.float32) for _ in range(2)]
    own = [torch.as_tensor(each) for each in parameters]
    return Case(torch.as_tensor(x), torch.as_tensor(corners.astype(np.int32)), own)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 1003])
@pytest.mark.parametrize("name", TERMS)
def test_kernels_agree(name: str, count: int) -> None:
    term, case = TERMS[name], case_of(name, count)
    (e0, f0), (e1, f1) = (case.evaluate(kernel) for kernel in (term.plain[torch.float32], term.eight))
    assert bool(f1.isfinite().all())
    assert float((e1 - e0).abs().max()) <= term.most * float(e0.abs().max())
    assert float((f1 - f0).abs().max()) <= term.most * float(f0.abs().max())


@pytest.mark.parametrize("name", TERMS)
def test_errors_are_of_single_precision(name: str) -> None:
    """Against double precision the kernel of eight elements loses no more than the plain kernel."""
    term, case = TERMS[name], case_of(name, 1003)
    sound = torch.ones(1003, dtype=torch.bool)
    for every in (7, 11, 13):
        sound[::every] = False
    case = case.where(sound)
    exact = case.evaluate(term.plain[torch.float64], torch.float64)
    plain, eight = (case.evaluate(kernel) for kernel in (term.plain[torch.float32], term.eight))
    for of_plain, of_eight, value in zip(plain, eight, exact, strict=True):
        most = float(value.abs().max())
        assert float((of_eight - value).abs().max()) <= 1.5 * float((of_plain - value).abs().max()) + 1e-7 * most


@pytest.mark.parametrize("name", TERMS)
def test_elements_do_not_depend_on_their_neighbours(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither on the place in a block, nor on the number of threads."""
    monkeypatch.setattr(threads_module, "_item_seconds", defaultdict(lambda: 1.0))
    term, count = TERMS[name], 12_005
    case = case_of(name, count)
    energy, force = case.evaluate(term.eight)
    for threads in (2, 3):
        e, f = case.evaluate(term.eight, threads=threads)
        assert torch.equal(e, energy)
        assert torch.equal(f, force)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(1))
    e, f = case.where(order).evaluate(term.eight)
    assert torch.equal(e, energy[order])
    assert torch.equal(f.reshape(count, -1), force.reshape(count, -1)[order])


def test_gathers_agree() -> None:
    rng = np.random.default_rng(4)
    corners = torch.as_tensor(rng.integers(0, VERTICES, size=(2000, 4)).astype(np.int32))
    starts, slots = incidence(corners, VERTICES)
    corner_force = torch.as_tensor(rng.normal(size=(8001, 3)).astype(np.float32))[:-1]
    totals = torch.ones(2, VERTICES, 3)
    kernels = base._GATHER[torch.float32], cast(wp.Kernel, base._gather_corners_at_once)
    for kernel, total in zip(kernels, totals, strict=True):
        inputs = [wp.from_torch(starts), wp.from_torch(slots), vectors(corner_force), vectors(total)]
        Launch(kernel, VERTICES, inputs, device="cpu")({})
    assert torch.equal(*totals)


@pytest.mark.parametrize("count", [3, 8, 21])
@pytest.mark.parametrize(
    "config",
    [
        PhysgraphConfig(vectors=VECTORS, width=16, depth=3),
        PhysgraphConfig(vectors=("metric", "move1"), width=5),
        PhysgraphConfig(vectors=("metric", "secant", "secant.smooth"), width=20),
    ],
)
def test_networks_agree(config: PhysgraphConfig, count: int) -> None:
    """The network as one kernel and as two around products of matrices, also with displacements that are limited."""
    mesh, rest = sheet(count, 2)
    system, x = finest_system(group_of(mesh, rest, level=1, dtype=torch.float32), wave(rest))
    network, vertices = random_network(config, seed=3, scale=0.5), len(x)
    assert system.level is not None
    around = VertexFrame(system.level, x)
    rng = np.random.default_rng(2)
    sizes = rng.choice([0.0, 1e-5, 1e-3], size=(vertices, 1))
    two = FusedPhysgraph(network, vertices, 0.02, device="cpu", threads=1)
    ones = [EightPhysgraph(network, vertices, 0.02, threads=threads) for threads in (1, 3)]
    bases = [torch.as_tensor(sizes * rng.normal(size=(vertices, 3)), dtype=torch.float32) for _ in two.bases]
    plain, eight, shared = (each(bases, system.spacing, system.reach, 4, frame=lambda: around) for each in (two, *ones))
    assert torch.equal(eight, shared)
    assert float((eight - plain).abs().max()) <= 1e-5 * float(plain.abs().max())


def test_stencils_agree() -> None:
    rng = np.random.default_rng(5)
    matrix = sp.csr_matrix(sp.random(300, VERTICES, density=0.02, random_state=rng))
    x = torch.as_tensor(rng.normal(size=(VERTICES, 3)).astype(np.float32))
    out = torch.full((300, 3), math.nan)
    columns, starts = (torch.as_tensor(each.astype(np.int32)) for each in (matrix.indices, matrix.indptr))
    values = torch.as_tensor(matrix.data.astype(np.float32))
    arrays = [wp.from_torch(each) for each in (starts, columns, values)]
    Launch(stencil._GATHER[torch.float32], 300, [*arrays, vectors(x), vectors(out)], device="cpu")({})
    assert torch.equal(out, Stencil(matrix, dtype=torch.float32, device="cpu").apply(x))


def test_formulas_are_for_the_cpu_alone() -> None:
    """Compiled once, in a module without derivatives, and empty on CUDA."""
    kernel = eight_elements("eight_test", "store(load(parameter0), {corner(0)});", corners=1)
    assert kernel.module.options["enable_backward"] is False
    assert kernel.module.options["cpu_compiler_flags"] == KERNELS["cpu_compiler_flags"]
