"""Milliseconds of one integration step by number of springs, forces and metric solve included.

    python -m benchmarks.step [--most 1000000]
    python -m benchmarks.step --device cuda --json benchmarks/results/step_cuda.json      on a machine with a GPU

A waved square sheet of triangles. Untrained networks of the sizes that ship: time does not depend on the weights.
Medians: on CUDA of wall time, the device waited for after each step, the forces alone, quasi-Newton's and `physgraph`'s
steps replayed as graphs of kernels; on the CPU of the time of all threads together. The paper's times are of its own
network on an RTX A6000. The page of the paper's results reads the figures of a GPU from the file that the second form
writes.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from benchmarks.rows import Row, commit, say, under
from physgraph_usd.lab.methods.paper_network import PaperConfig
from physgraph_usd.lab.methods.random_networks import random_network
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.frame.group import Group
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.integrate import METHODS
from physgraph_usd.solver.integrate.base import Integrator, System
from physgraph_usd.solver.integrate.network import PhysgraphConfig
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.weights import integrator_of, shipped_network
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.scene import Garment, GarmentFrame

PAPER_MS = {1_000: (0.037, 7.13), 10_000: (0.042, 9.74), 100_000: (0.051, 37.74), 1_000_000: (0.078, 343.08)}
"""The paper's forces and integrator by number of springs [ms]."""
CUDA = Path("benchmarks/results/step_cuda.json")
MOST = {True: (100_000, 1_000), False: (1_000_000, 10_000)}
"""Most edges of ours and of the paper's network on a CPU, by whether the form is the short one."""
OURS, THEIRS, CLASSIC = "physgraph", "physgraph-paper", "quasi-newton"
SHIPPED = cast(PhysgraphConfig, shipped_network(OURS).config)
METHOD: dict[str, Callable[[], Integrator]] = {
    CLASSIC: QuasiNewton,
    OURS: lambda: integrator_of(random_network(SHIPPED, seed=1, scale=0.01)),
    THEIRS: lambda: integrator_of(random_network(PaperConfig(), seed=1, scale=0.01)),
}
WARM, REPEATS = 6, 15


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one row a size, and write them as JSON where that is asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--most", type=int, default=max(PAPER_MS), help="most edges")
    parser.add_argument("--paper-most", type=int, default=max(PAPER_MS), help="most edges for the paper's network")
    parser.add_argument("--json", type=Path, default=None, help="file for the figures")
    given = parser.parse_args(arguments)
    prepare_device(given.device)
    names = ["edges", "forces", "metric solve", *METHOD]
    say("| " + " | ".join(names) + " | the paper |\n" + "|---" * (len(names) + 1) + "|")
    lines = []
    for line in timed(given.device, given.most, given.paper_most):
        cells = ["-" if line[name] is None else f"{line[name]:,}" for name in names]
        say("| " + " | ".join(cells) + f" | {PAPER_MS[size_of(line)][1]} |")
        lines.append(line)
    if given.json:
        name = torch.cuda.get_device_name(given.device) if given.device.startswith("cuda") else "CPU"
        command = f"python -m benchmarks.step --device {given.device}"
        known = {"device": name, "command": command, "commit": commit(), "rows": lines}
        given.json.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


def timed(device: str, most: int, paper_most: int) -> Iterator[dict[str, Any]]:
    """Edges, and milliseconds of forces, a metric solve and a step of each method, by size; None is not measured."""
    for size in (each for each in PAPER_MS if each <= most):
        system, x = sheet(size, device)
        assert system.level is not None
        force = system.energy_and_force(x)[1]
        line: dict[str, Any] = {"edges": len(system.level.edges)}
        line["forces"] = milliseconds(partial(system.energy_and_force, x), device)
        line["metric solve"] = milliseconds(lambda s=system, f=force: s.apply_metric_inverse(f), device)
        for name, build in METHOD.items():
            late = name == THEIRS and size > paper_most
            line[name] = None if late else stepped(build(), system, x, device=device)
        yield {name: value if value is None else round(value, 2) for name, value in line.items()}


def measure(short: bool) -> list[Row]:
    """The CPU's times beside the paper's, and those of a GPU where they are known."""
    lines = list(timed("cpu", *MOST[short]))
    rows = [under_paper(f"{name} on this CPU", line, name) for name in (CLASSIC, OURS) for line in lines]
    if not CUDA.exists():
        return [*rows, Row("forces and integrators on a GPU", "not measured", "as above", "as the paper", False)]
    known = json.loads(CUDA.read_text(encoding="utf-8"))
    for line in known["rows"]:
        what = f"forces on {known['device']}, {line['edges']:,} springs"
        rows.append(under(what, line["forces"], PAPER_MS[size_of(line)][0], unit=" ms"))
        rows += [under_paper(f"{name} on {known['device']}", line, name) for name in METHOD]
    return rows


def under_paper(what: str, line: dict[str, Any], name: str) -> Row:
    """A step beside the paper's."""
    most, value = PAPER_MS[size_of(line)][1], line.get(name)
    value = math.nan if value is None else value
    return under(f"{what}, {line['edges']:,} springs", value, most, unit=" ms", paper=f"{most} ms")


def size_of(line: dict[str, Any]) -> int:
    """The paper's number of springs that a line stands for."""
    return min(PAPER_MS, key=lambda size: abs(math.log(size / line["edges"])))


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


if __name__ == "__main__":
    with torch.no_grad():
        main()
