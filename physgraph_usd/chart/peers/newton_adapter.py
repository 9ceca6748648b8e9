"""Newton's VBD or XPBD as a quasi-static solver of our potential: run by a Python with ``newton`` and ``scipy``.

    python newton_adapter.py problem.npz result.npz --solver vbd --steps 1,2,4 --repeats 3 --most-ms 5000

The springs and hinges are ours, so is the potential that they minimise. What neither has a term for, the guide and
gravity, is an external force that is renewed every step. Particles stop before each step, so a step is a proximal one:
its masses only bound the guide's stiffness, and no time passes.
Imports nothing of this package.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import Any

import newton  # pyright: ignore[reportMissingImports]
import numpy as np
import scipy.sparse as sp

ITERATIONS = 3
"""Iterations of the solver in each step, between two looks at the external force: ten gained less per millisecond."""
MASS = {"vbd": 0.15, "xpbd": 0.5}
"""A particle's mass, at least, over the sum of its springs' constants. A compressed spring's Hessian is indefinite in
VBD: with 0.1 a sleeve compressed by a fifth flew apart at first, with 0.3 and more it only crept. XPBD moves every
particle by the sum of what its springs ask for, all at once: with 0.2 six of them asked for too much, and with 0.3 a
T-shirt swung."""
COARSE_STEPS = 4
"""Steps of a coarse level for each step of the finest, as ours."""


@dataclass
class Level:
    """One level's problem, built once."""

    solver: Any
    states: list[Any]
    control: Any
    base: np.ndarray
    load: np.ndarray
    stiffness: sp.csr_matrix

    def solve(self, x: np.ndarray, steps: int) -> np.ndarray:
        """Make steps from positions [m]."""
        here, there = self.states
        here.particle_q.assign(x.astype(np.float32))
        for _ in range(steps):
            x = here.particle_q.numpy().astype(np.float64)
            here.particle_qd.zero_()
            here.particle_f.assign((self.load - self.stiffness @ (x - self.base)).astype(np.float32))
            self.solver.step(here, there, self.control, None, 1.0)
            here, there = there, here
        return here.particle_q.numpy().astype(np.float64)


def build(problem: Any, index: int, solver: str) -> Level:
    """One level as a Newton model."""

    def own(name: str) -> np.ndarray:
        return problem[f"{name}{index}"]

    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    base, free = own("base"), own("free")
    # In a step of one second a mass is a stiffness: as much as the guide's, so that its lag cannot swing.
    mass = np.where(free, np.maximum(own("bound"), MASS[solver] * own("diagonal")), 0.0)
    points, still = base.tolist(), np.zeros_like(base).tolist()
    # XPBD pushes particles apart that are nearer than their radii, by default a decimetre.
    builder.add_particles(points, still, mass.tolist(), radius=[0.0] * len(base))
    builder.spring_indices += own("edges").ravel().tolist()
    builder.spring_rest_length += own("rest_length").tolist()
    builder.spring_stiffness += own("spring").tolist()
    builder.spring_damping += [0.0] * len(own("spring"))
    builder.spring_control += [0.0] * len(own("spring"))
    i, j, k, ell = own("hinges").T
    weight = own("hinge").tolist()
    builder.add_edges(k, ell, i, j, rest=own("rest_angle").tolist(), edge_ke=weight, edge_kd=[0.0] * len(weight))
    builder.edge_rest_length[:] = [1.0] * len(weight)
    builder.color(include_bending=True)
    model = builder.finalize()
    solvers = {"vbd": newton.solvers.SolverVBD, "xpbd": newton.solvers.SolverXPBD}
    made = solvers[solver](model, iterations=ITERATIONS)
    count = len(base)
    stiffness = sp.csr_matrix((own("values"), own("columns"), own("starts")), shape=(count, count))
    return Level(made, [model.state(), model.state()], model.control(), base, own("load"), stiffness)


def solve(levels: list[Level], maps: list[sp.csr_matrix], steps: int, *, nested: bool) -> np.ndarray:
    """All levels, or the finest alone."""
    first = 0 if nested else len(levels) - 1
    x = levels[first].base
    for index in range(first, len(levels)):
        if index > first:
            x = maps[index] @ x
        x = levels[index].solve(x, steps if index == len(levels) - 1 else COARSE_STEPS * steps)
    return x


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
    given = parser.parse_args()
    clock = time.process_time if given.clock == "cpu" else time.perf_counter
    problem = np.load(given.problem)
    count = int(problem["levels"])
    levels = [build(problem, index, given.solver) for index in range(count)]
    maps = [sp.identity(len(levels[0].base), format="csr")]
    maps += [
        sp.csr_matrix((problem[f"map_values{i}"], problem[f"map_columns{i}"], problem[f"map_starts{i}"]))
        for i in range(1, count)
    ]
    found: dict[str, Any] = {}
    for nested in (False, True):
        solve(levels, maps, 1, nested=nested)
        for steps in map(int, given.steps.split(",")):
            spent, x = [], levels[-1].base
            for _ in range(given.repeats):
                began = clock()
                x = solve(levels, maps, steps, nested=nested)
                spent.append(1e3 * (clock() - began))
            found[f"x_{nested:d}_{steps}"], found[f"ms_{nested:d}_{steps}"] = x, np.array(spent)
            if 2.0 * min(spent) > given.most_ms:
                break
    np.savez(given.result, **found)


if __name__ == "__main__":
    main()
