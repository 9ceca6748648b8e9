"""Milliseconds of one integration step against the number of edges, forces and metric solve included.

    python -m benchmarks.step [--device cuda] [--most 1000000]

A waved square sheet of triangles. Untrained networks of the sizes that ship: time does not depend on the weights.
Medians: on CUDA of wall time, the device waited for after each step, the forces alone, quasi-Newton's and `physgraph`'s
steps replayed as graphs of kernels; on the CPU of the time of all threads together. "Step by step" nothing is replayed.
The paper reports 7.1, 9.7, 37.7 and 343 ms for its network at 1e3, 1e4, 1e5 and 1e6 springs on an RTX A6000, another
GPU than yours. The last two columns are the least time that the layers' operations or bytes need at the peak rates of
--tflops and --gbytes; forces and metric are not in it.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import torch

from benchmarks.rows import say
from physgraph_usd.lab.methods.paper_network import PaperConfig
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.integrate import METHODS
from physgraph_usd.solver.integrate.base import Integrator, System
from physgraph_usd.solver.integrate.network import PhysgraphConfig
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.weights import integrator_of, random_network, shipped_network
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.scene import Garment, GarmentFrame

SIZES = (1_000, 10_000, 100_000, 1_000_000)
SHIPPED = cast(PhysgraphConfig, shipped_network("physgraph").config)
PAPER = PaperConfig()
WARM, REPEATS = 6, 15


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one row a size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--most", type=int, default=SIZES[-1], help="most edges")
    parser.add_argument("--paper-most", type=int, default=SIZES[-1], help="most edges for the paper's network")
    parser.add_argument("--tflops", type=float, default=0.1, help="peak rate of the layers [1e12/s]")
    parser.add_argument("--gbytes", type=float, default=20.0, help="peak rate of memory [1e9/s]")
    given = parser.parse_args(arguments)
    prepare_device(given.device)
    methods: dict[str, Callable[[], Integrator]] = {
        "quasi-newton": QuasiNewton,
        "quasi-newton, step by step": lambda: QuasiNewton(record=False),
        "physgraph": lambda: integrator_of(random_network(SHIPPED, seed=1, scale=0.01)),
        "physgraph-paper": lambda: integrator_of(random_network(PAPER, seed=1, scale=0.01)),
    }
    say("| edges | forces | metric solve | " + " | ".join(methods) + " | least, physgraph | least, physgraph-paper |")
    say("|---|" + "---|" * (len(methods) + 4))
    for size in (s for s in SIZES if s <= given.most):
        system, x = sheet(size, given.device)
        force = system.energy_and_force(x)[1]
        cells = [milliseconds(forces_of(system, x), given.device)]
        cells.append(milliseconds(lambda s=system, f=force: s.apply_metric_inverse(f), given.device))
        for name, build in methods.items():
            late = name == "physgraph-paper" and size > given.paper_most
            cells.append(float("nan") if late else stepped(build(), system, x, device=given.device))
        cells += [least(size, config, given.tflops, rate=given.gbytes) for config in (SHIPPED, PAPER)]
        say(f"| {len(system.level.edges) if system.level else 0} | " + " | ".join(f"{ms:.2f}" for ms in cells) + " |")


def sheet(edges: int, device: str) -> tuple[System, torch.Tensor]:
    """A square sheet of about so many edges, squeezed and waved."""
    side = round((edges / 3.0) ** 0.5)
    v, u = np.meshgrid(np.arange(side + 1.0), np.arange(side + 1.0), indexing="ij")
    rest = 0.005 * np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], axis=1)
    row, column = np.divmod(np.arange(side * side), side)
    a = row * (side + 1) + column
    triangles = np.concatenate(
        [np.stack([a, a + 1, a + side + 2], axis=1), np.stack([a, a + side + 2, a + side + 1], axis=1)]
    )
    mesh = PolygonMesh(np.full(len(triangles), 3), triangles.ravel(), len(rest))
    one = np.ones(len(rest))
    garment = Garment("/Sheet", mesh, rest, 0, False, one, one, one, one, 0 * one)
    settings = SolveSettings(METHODS["quasi-newton"])
    group = Group.of([garment], [()], np.zeros(3), settings, dtype=torch.float32, device=device, threads=2)
    points = rest * [0.9, 1.0, 1.0] + 0.004 * np.sin(40.0 * rest[:, :1]) * [0, 0, 1.0]
    systems, x = group.systems([GarmentFrame(points, PRESETS["jersey"])])
    return systems[0], x


def forces_of(system: System, x: torch.Tensor) -> Callable[[], object]:
    """A force evaluation; on CUDA recorded once and replayed, as `physgraph` does it."""
    if not x.is_cuda:
        return lambda: system.energy_and_force(x)
    system.field.energy_and_force(x)
    graph, side = torch.cuda.CUDAGraph(), torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        graph.capture_begin(capture_error_mode="relaxed")
        system.field.energy_and_force(x)
        graph.capture_end()
    torch.cuda.current_stream().wait_stream(side)
    return graph.replay


def stepped(integrator: Integrator, system: System, x: torch.Tensor, *, device: str) -> float:
    """Median time of a step after some of them [ms]."""
    carry = integrator.start(system, x)
    for _ in range(WARM):
        carry = integrator.step(system, carry)
    return milliseconds(lambda: integrator.step(system, carry), device)


def milliseconds(call: Callable[[], object], device: str) -> float:
    """Median time of a call [ms]: wall time on CUDA, that of all threads together on the CPU."""
    times = []
    clock = time.perf_counter if device.startswith("cuda") else time.process_time
    for _ in range(REPEATS):
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        began = clock()
        call()
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        times.append(clock() - began)
    return 1e3 * statistics.median(times)


def least(edges: int, config: PhysgraphConfig | PaperConfig, tflops: float, *, rate: float) -> float:
    """The larger of the times that operations and bytes of the layers take [ms]."""
    vertices = edges / 3.0
    if isinstance(config, PhysgraphConfig):
        count, w = len(config.vectors), config.width
        operations = 2 * vertices * (count * (count + 1) / 2 * w + w * w + w * count)
        moved = vertices * 4 * (3 * count + 4)
    else:
        w = config.latent
        operations = 2 * config.rounds * (2 * edges * 5 * w * w + vertices * 4 * w * w)
        moved = config.rounds * 4 * w * (2 * edges * 2 + vertices * 2)
    return 1e3 * max(operations / (1e12 * tflops), moved / (1e9 * rate))


if __name__ == "__main__":
    with torch.no_grad():
        main()
