"""Newton's VBD or XPBD as a quasi-static solver of our potential: run by a Python with ``newton`` and ``scipy``.

    python newton_adapter.py problem.npz result.npz --solver vbd --steps 1,2,4 --repeats 3 --most-ms 5000 --device cpu

The springs and hinges are ours, so is the potential that they minimise. What neither has a term for, the guide and
gravity, is an external force that is renewed every step. Particles stop before each step, so a step is a proximal one:
its masses only bound the guide's stiffness, and no time passes. On CUDA a step is recorded once and replayed.
Imports nothing of this package.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false
from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import newton  # pyright: ignore[reportMissingImports]
import numpy as np
import scipy.sparse as sp
import warp as wp

wp.set_module_options({"enable_backward": False})

ITERATIONS = 3
"""Iterations of the solver in each step, between two looks at the external force: ten gained less per millisecond."""
MASS = {"vbd": 0.15, "xpbd": 0.5}
"""A particle's mass, at least, over the sum of its springs' constants. A compressed spring's Hessian is indefinite in
VBD: with 0.1 a sleeve compressed by a fifth flew apart at first, with 0.3 and more it only crept. XPBD moves every
particle by the sum of what its springs ask for, all at once: with 0.2 six of them asked for too much, and with 0.3 a
T-shirt swung."""
COARSE_STEPS = 4
"""Steps of a coarse level for each step of the finest, as ours."""


@wp.kernel
def pull(
    starts: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    values: wp.array(dtype=wp.float32),
    load: wp.array(dtype=wp.vec3),
    base: wp.array(dtype=wp.vec3),
    x: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.vec3),
):
    """Force of the guide and of gravity on each particle: load - K (x - base)."""
    i = wp.tid()
    total = load[i]
    for k in range(starts[i], starts[i + 1]):
        total -= values[k] * (x[columns[k]] - base[columns[k]])
    out[i] = total


@dataclass
class Level:
    """A level's problem, built once; ``pulled`` holds the arguments of `pull` before the positions."""

    solver: Any
    states: tuple[Any, Any]
    control: Any
    base: np.ndarray
    pulled: list[wp.array]
    graph: Any = None

    def solve(self, x: np.ndarray, steps: int) -> np.ndarray:
        """Make steps from positions [m]."""
        here, _ = self.states
        here.particle_q.assign(x.astype(np.float32))
        for _ in range(steps):
            if self.graph is None:
                self.step()
            else:
                wp.capture_launch(self.graph)
        return here.particle_q.numpy().astype(np.float64)

    def step(self) -> None:
        """Make a step, with the result in the state of the start."""
        here, there = self.states
        here.particle_qd.zero_()
        inputs = [*self.pulled, here.particle_q, here.particle_f]
        wp.launch(pull, dim=len(self.base), inputs=inputs, device=here.particle_q.device)
        self.solver.step(here, there, self.control, None, 1.0)
        wp.copy(here.particle_q, there.particle_q)

    def record(self) -> None:
        """Record a step for CUDA."""
        self.solve(self.base, 1)
        with wp.ScopedCapture(device=self.states[0].particle_q.device) as capture:
            self.step()
        self.graph = capture.graph


def build(problem: Any, index: int, solver: str, device: str) -> Level:
    """One level as a Newton model on a device."""

    def array(name: str) -> np.ndarray:
        return problem[f"{name}{index}"]

    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    base, free = array("base"), array("free")
    # In a step of one second a mass is a stiffness: as much as the guide's, so that its lag cannot swing.
    mass = np.where(free, np.maximum(array("bound"), MASS[solver] * array("diagonal")), 0.0)
    points, still = base.tolist(), np.zeros_like(base).tolist()
    # XPBD pushes particles apart that are nearer than their radii, by default a decimetre.
    builder.add_particles(points, still, mass.tolist(), radius=[0.0] * len(base))
    builder.spring_indices += array("springs").ravel().tolist()
    builder.spring_rest_length += array("rest_length").tolist()
    builder.spring_stiffness += array("spring").tolist()
    builder.spring_damping += [0.0] * len(array("spring"))
    builder.spring_control += [0.0] * len(array("spring"))
    i, j, k, ell = array("hinges").T
    weight = array("hinge").tolist()
    builder.add_edges(k, ell, i, j, rest=array("rest_angle").tolist(), edge_ke=weight, edge_kd=[0.0] * len(weight))
    builder.edge_rest_length[:] = [1.0] * len(weight)
    builder.color(include_bending=True)
    model = builder.finalize(device=device)
    solvers = {"vbd": newton.solvers.SolverVBD, "xpbd": newton.solvers.SolverXPBD}
    solver_made = solvers[solver](model, iterations=ITERATIONS)
    pulled = [wp.array(array(name), dtype=wp.int32, device=device) for name in ("starts", "columns")]
    pulled.append(wp.array(array("values"), dtype=wp.float32, device=device))
    pulled += [wp.array(array(name), dtype=wp.vec3, device=device) for name in ("load", "base")]
    level = Level(solver_made, (model.state(), model.state()), model.control(), base, pulled)
    if wp.get_device(device).is_cuda:
        level.record()
    return level


def solve(levels: list[Level], maps: list[sp.csr_matrix], steps: int, *, nested: bool) -> np.ndarray:
    """All levels, or the finest alone."""
    first = 0 if nested else len(levels) - 1
    x = levels[first].base
    for index in range(first, len(levels)):
        if index > first:
            x = maps[index] @ x
        x = levels[index].solve(x, steps if index == len(levels) - 1 else COARSE_STEPS * steps)
    return x


def measured(
    levels: list[Level],
    maps: list[sp.csr_matrix],
    budgets: list[int],
    *,
    clock: Callable[[], float],
    repeats: int,
    most_ms: float,
) -> dict[str, Any]:
    """Positions [m] and times [ms] of each budget, on the finest level alone and nested, by name."""
    arrays: dict[str, Any] = {}
    for nested in (False, True):
        solve(levels, maps, 1, nested=nested)
        for steps in budgets:
            spent, x = [], levels[-1].base
            for _ in range(repeats):
                began = clock()
                x = solve(levels, maps, steps, nested=nested)
                spent.append(1e3 * (clock() - began))
            arrays[f"x_{nested:d}_{steps}"], arrays[f"ms_{nested:d}_{steps}"] = x, np.array(spent)
            if 2.0 * min(spent) > most_ms:
                break
    return arrays


def main() -> None:
    """Solve with every budget and write positions and times."""
    parser = argparse.ArgumentParser()
    parser.add_argument("problem")
    parser.add_argument("result")
    parser.add_argument("--solver", choices=list(MASS), default="vbd")
    parser.add_argument("--steps", required=True)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--most-ms", type=float, default=1e4)
    parser.add_argument("--clock", choices=["wall", "cpu"], default="wall")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    clock = time.process_time if arguments.clock == "cpu" else time.perf_counter
    problem = np.load(arguments.problem)
    count = int(problem["levels"])
    levels = [build(problem, index, arguments.solver, arguments.device) for index in range(count)]
    maps = [sp.identity(len(levels[0].base), format="csr")]
    maps += [
        sp.csr_matrix((problem[f"map_values{i}"], problem[f"map_columns{i}"], problem[f"map_starts{i}"]))
        for i in range(1, count)
    ]
    budgets = [int(steps) for steps in arguments.steps.split(",")]
    arrays = measured(levels, maps, budgets, clock=clock, repeats=arguments.repeats, most_ms=arguments.most_ms)
    np.savez(arguments.result, **arrays)


if __name__ == "__main__":
    main()
