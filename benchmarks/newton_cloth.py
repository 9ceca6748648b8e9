"""A sheet simulated by Newton's Style3D solver: run by a Python that has ``newton``.

    python benchmarks/newton_cloth.py problem.npz result.npz

The solver, its membrane (Baraff and Witkin 1998), its bending (Bergou et al. 2006), its contact and friction are
Newton's; of ours are the mesh, the numbers of the fabric, and where held vertices and bodies are. Imports nothing of
this package.

What the problem holds, with V vertices, T triangles, H held vertices and S steps: ``points`` [m], shape (V, 3);
``triangles``, (T, 3); ``panel``, material coordinates [m] of the triangles' corners, (T, 3, 2); ``stretch``, stiffness
along weft and warp and in shear [N/m], (3,); ``bend`` [N m] and ``density`` [kg/m^2]; ``held``, (H,), and
``targets`` [m], (S, H, 3); ``substeps`` and ``step`` [s]; ``capsules``, (C, 2), radius and half length [m], and
``poses``, (S, C, 7), positions [m] and quaternions x, y, z, w, the capsule's axis along its z. A capsule of no length
is a ball.
"""

from __future__ import annotations

import argparse
from typing import Any

import newton  # pyright: ignore[reportMissingImports]
import numpy as np
import warp as wp
from newton.solvers import style3d  # pyright: ignore[reportMissingImports]

wp.config.quiet = True  # pyright: ignore[reportAttributeAccessIssue]
CYLINDER = 3.0
"""Energy of their quadratic bending over D k^2 / 2 for a sheet of squares, halved by diagonals, that is bent along the
sides of its squares; along one diagonal it is three times that."""
ITERATIONS, LINEAR = 4, 40
"""Iterations of a step and of the conjugate gradients in each: with ten of these a fine sheet falls too slowly."""
FRICTION, CONTACT = 0.3, 10.0
"""Coefficient, and stiffness of what touches a body [N/m]."""
RADIUS = 2e-3
"""Distance from a body at which cloth is pushed off [m]."""


def build(problem: Any, device: str) -> Any:
    """The problem's sheet and bodies as a model."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
    newton.solvers.SolverStyle3D.register_custom_attributes(builder)
    stiffness = float(problem["bend"]) / CYLINDER
    style3d.add_cloth_mesh(
        builder,
        pos=wp.vec3(0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0),
        vertices=problem["points"].tolist(),
        indices=problem["triangles"].ravel().tolist(),
        density=float(problem["density"]),
        panel_verts=problem["panel"].reshape(-1, 2).tolist(),
        panel_indices=list(range(problem["triangles"].size)),
        tri_aniso_ke=wp.vec3(*problem["stretch"].tolist()),
        edge_aniso_ke=wp.vec3(stiffness),
        particle_radius=RADIUS,
    )
    for (radius, half), pose in zip(problem["capsules"], poses(problem, 0), strict=True):
        body = builder.add_body(xform=wp.transform(*pose), is_kinematic=True)
        builder.add_shape_capsule(body, radius=float(radius), half_height=float(half))
    model = builder.finalize(device=device)
    flags = model.particle_flags.numpy()
    flags[problem["held"]] &= ~int(newton.ParticleFlags.ACTIVE)
    model.particle_flags.assign(flags)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = CONTACT, 1e-5, FRICTION
    model.set_gravity((0.0, 0.0, -9.81))
    return model


def poses(problem: Any, step: int) -> np.ndarray:
    """Where bodies are in a step: positions [m] and quaternions x, y, z, w, shape (C, 7)."""
    made: Any = wp.quat_from_matrix
    turns = [made(wp.mat33(*each.ravel())) for each in problem["turns"][step]]
    return np.array([[*middle, *turn] for middle, turn in zip(problem["middles"][step], turns, strict=True)])


def place(state: Any, problem: Any, step: int) -> None:
    """Held vertices and bodies to where a step has them."""
    points = state.particle_q.numpy()
    points[problem["held"]] = problem["targets"][step]
    state.particle_q.assign(points)
    if len(problem["capsules"]):
        state.body_q.assign(poses(problem, step).astype(np.float32))


def simulate(problem: Any, device: str) -> np.ndarray:
    """Positions of each frame [m], shape (F, V, 3)."""
    model = build(problem, device)
    config = newton.solvers.SolverStyle3D.Config(iterations=ITERATIONS, linear_iterations=LINEAR)
    solver = newton.solvers.SolverStyle3D(model, config=config)
    state, after, control = model.state(), model.state(), model.control()
    pipeline = newton.CollisionPipeline(model)
    contacts, frames = pipeline.contacts(), []
    for step in range(len(problem["targets"])):
        place(state, problem, step)
        place(after, problem, step)
        pipeline.collide(state, contacts)
        state.clear_forces()
        solver.step(state, after, control, contacts, float(problem["step"]))
        state, after = after, state
        if (step + 1) % int(problem["substeps"]) == 0:
            frames.append(state.particle_q.numpy().copy())
    return np.array(frames)


def main() -> None:
    """Simulate and write positions."""
    parser = argparse.ArgumentParser()
    parser.add_argument("problem")
    parser.add_argument("result")
    parser.add_argument("--device", default="cuda" if wp.is_cuda_available() else "cpu")
    given = parser.parse_args()
    np.savez(given.result, frames=simulate(np.load(given.problem), given.device), newton=newton.__version__)


if __name__ == "__main__":
    main()
