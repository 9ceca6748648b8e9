"""A sheet simulated by Newton's Style3D or VBD solver: run by a Python that has ``newton``.

    python benchmarks/newton_cloth.py problem.npz result.npz [--solver vbd] [--lock FILE]

The solver, its membrane, its bending, its contact and friction are Newton's; of ours are the mesh, the numbers of the
fabric, and where held vertices and bodies are. On CUDA two steps are recorded once and replayed. With a lock, only one
such program simulates at a time. Imports nothing of this package.

What the problem holds, with V vertices, T triangles, H held vertices and S steps: ``points`` [m], shape (V, 3);
``triangles``, (T, 3); ``panel``, material coordinates [m] of the triangles' corners, (T, 3, 2); ``stretch``, stiffness
along weft and warp and in shear [N/m], (3,); ``bend`` [N m] and ``density`` [kg/m^2]; ``held``, (H,), and
``targets`` [m], (S, H, 3); ``substeps`` and ``step`` [s]; ``iterations`` of a step, and of the conjugate gradients in
each, (2,); ``apart``, the distance [m] that cloth keeps to itself; ``spacing``, between parallel edges [m];
``capsules``, (C, 2), radius and half length [m], and ``middles`` [m], (S, C, 3), and ``turns``, (S, C, 3, 3), of them,
the capsule's axis along its z; a capsule of no length is a ball; ``skin``, a body that bends, at the start and in
each frame [m], (F + 1, B, 3), and ``faces``, its triangles; (0, 0, 3) without one. S is even.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false
from __future__ import annotations

import argparse
import fcntl
import time
from typing import Any

import newton  # pyright: ignore[reportMissingImports]
import numpy as np
import warp as wp
from newton.solvers import style3d  # pyright: ignore[reportMissingImports]

wp.config.quiet = True  # pyright: ignore[reportAttributeAccessIssue]
CYLINDER = 3.0
"""Energy of Style3D's quadratic bending over D k^2 / 2 for a sheet of squares, halved by diagonals, that is bent along
the sides of its squares; along one diagonal it is three times that."""
FRICTION, CONTACT = 0.3, 10.0
"""Coefficient, and stiffness of what touches a body [N/m]."""
RADIUS = 2e-3
"""Distance from a body at which cloth is pushed off [m]."""
STILL: dict[str, Any] = {"pos": wp.vec3(0.0), "rot": wp.quat_identity(), "vel": wp.vec3(0.0), "particle_radius": RADIUS}


@wp.kernel
def place(
    step: wp.array(dtype=wp.int32),
    which: wp.array(dtype=wp.int32),
    targets: wp.array2d(dtype=Any),
    here: wp.array(dtype=Any),
    there: wp.array(dtype=Any),
):
    """Held vertices, or bodies, to where a step has them, in both states."""
    i = wp.tid()
    here[which[i]] = targets[step[0], i]
    there[which[i]] = targets[step[0], i]


@wp.kernel
def bend(
    step: wp.array(dtype=wp.int32),
    substeps: wp.int32,
    frames: wp.array2d(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
):
    """Vertices of a body that bends to where a step has them: linear between frames."""
    i = wp.tid()
    n = (step[0] + 1) // substeps
    part = float((step[0] + 1) % substeps) / float(substeps)
    points[i] = wp.lerp(frames[n, i], frames[wp.min(n + 1, frames.shape[0] - 1), i], part)


@wp.kernel
def count(step: wp.array(dtype=wp.int32)):
    """On to the next step."""
    step[0] = step[0] + 1


def add_style3d(builder: Any, problem: Any) -> None:
    """The sheet with Style3D's membrane (Baraff and Witkin 1998) and bending (Bergou et al. 2006)."""
    newton.solvers.SolverStyle3D.register_custom_attributes(builder)
    style3d.add_cloth_mesh(
        builder,
        **STILL,
        vertices=problem["points"].tolist(),
        indices=problem["triangles"].ravel().tolist(),
        density=float(problem["density"]),
        panel_verts=problem["panel"].reshape(-1, 2).tolist(),
        panel_indices=list(range(problem["triangles"].size)),
        tri_aniso_ke=wp.vec3(*problem["stretch"].tolist()),
        edge_aniso_ke=wp.vec3(float(problem["bend"]) / CYLINDER),
    )


def add_plain(builder: Any, problem: Any) -> None:
    """The sheet with bending by angles, its membrane neo-Hookean, as stiff as weft and warp on average."""
    weft, warp = problem["stretch"][:2].tolist()
    builder.add_cloth_mesh(
        **STILL,
        scale=1.0,
        vertices=problem["points"].tolist(),
        indices=problem["triangles"].ravel().tolist(),
        density=float(problem["density"]),
        tri_ke=0.25 * (weft + warp),
        tri_ka=0.0,
        tri_kd=0.0,
        edge_ke=float(problem["bend"]) / float(problem["spacing"]),
        edge_kd=0.0,
    )


def build(problem: Any, solver: str, device: str) -> tuple[Any, Any]:
    """The problem's sheet and bodies as a model, and the mesh of the body that bends or None."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
    if solver == "style3d":
        add_style3d(builder, problem)
    else:
        add_plain(builder, problem)
    for (radius, half), at in zip(problem["capsules"], poses(problem)[0], strict=True):
        body = builder.add_body(xform=wp.transform(*at), is_kinematic=True)
        builder.add_shape_capsule(body, radius=float(radius), half_height=float(half))
    skin = newton.Mesh(problem["skin"][0], problem["faces"].ravel()) if len(problem["skin"]) else None
    if skin is not None:
        builder.add_shape_mesh(-1, mesh=skin)
    if solver == "vbd":
        builder.color(include_bending=True)
    model = builder.finalize(device=device)
    if skin is not None:  # Cloth out of a body's box is not looked at: it holds the body in all frames.
        model.shape_collision_aabb_lower.assign(problem["skin"].min(axis=(0, 1)).reshape(1, 3))
        model.shape_collision_aabb_upper.assign(problem["skin"].max(axis=(0, 1)).reshape(1, 3))
    flags = model.particle_flags.numpy()
    flags[problem["held"]] &= ~int(newton.ParticleFlags.ACTIVE)
    model.particle_flags.assign(flags)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = CONTACT, 1e-5, FRICTION
    model.set_gravity((0.0, 0.0, -9.81))
    return model, skin


def solver_of(model: Any, problem: Any, solver: str) -> Any:
    """The solver, which keeps cloth apart from itself."""
    iterations, linear = map(int, problem["iterations"])
    apart = float(problem["apart"])
    if solver == "style3d":
        config = newton.solvers.SolverStyle3D.Config(iterations=iterations, linear_iterations=linear)
        made = newton.solvers.SolverStyle3D(model, config=config)
        made.collision.radius = apart
        return made
    return newton.solvers.SolverVBD(
        model,
        iterations=iterations,
        integrate_with_external_rigid_solver=True,
        particle_enable_self_contact=True,
        particle_self_contact_margin=apart,
        particle_self_contact_gap=apart,
        particle_vertex_contact_buffer_size=64,
        particle_edge_contact_buffer_size=128,
    )


def poses(problem: Any) -> np.ndarray:
    """Where bodies are in each step: positions [m] and quaternions x, y, z, w, shape (S, C, 7)."""
    made: Any = wp.quat_from_matrix
    turns = [[[*made(wp.mat33(*turn.ravel()))] for turn in each] for each in problem["turns"]]
    return np.concatenate([problem["middles"], np.reshape(turns, (*problem["middles"].shape[:2], 4))], axis=2)


class Simulation:
    """A problem on a device; two steps at a time."""

    def __init__(self, problem: Any, solver: str, device: str) -> None:
        """Build it."""
        self.model, self.skin = build(problem, solver, device)
        self.solver, self.seconds = solver_of(self.model, problem, solver), float(problem["step"])
        self.states = (self.model.state(), self.model.state())
        self.control, self.pipeline = self.model.control(), newton.CollisionPipeline(self.model)
        self.contacts = self.pipeline.contacts()
        self.number = wp.zeros(1, dtype=wp.int32, device=device)
        self.held = wp.array(problem["held"], dtype=wp.int32, device=device)
        self.targets = wp.array(problem["targets"], dtype=wp.vec3, ndim=2, device=device)
        self.poses = wp.array(poses(problem), dtype=wp.transform, ndim=2, device=device)
        self.bodies = wp.array(np.arange(len(problem["capsules"])), dtype=wp.int32, device=device)
        self.skins = wp.array(problem["skin"], dtype=wp.vec3, ndim=2, device=device)
        self.substeps, self.graph = int(problem["substeps"]), None

    def step(self, here: Any, there: Any) -> None:
        """One step from a state into another."""
        device = here.particle_q.device
        moved = [(self.held, self.targets, here.particle_q, there.particle_q)]
        moved += [(self.bodies, self.poses, here.body_q, there.body_q)] if len(self.bodies) else []
        for which, *arrays in moved:
            wp.launch(place, dim=len(which), inputs=[self.number, which, *arrays], device=device)
        if self.skin is not None:
            inputs = [self.number, self.substeps, self.skins, self.skin.mesh.points]
            wp.launch(bend, dim=self.skins.shape[1], inputs=inputs, device=device)
            self.skin.mesh.refit()
        wp.launch(count, dim=1, inputs=[self.number], device=device)
        self.pipeline.collide(here, self.contacts)
        here.clear_forces()
        self.solver.step(here, there, self.control, self.contacts, self.seconds)

    def twice(self) -> None:
        """Two steps, back into the state that they began in."""
        self.step(*self.states)
        self.step(*self.states[::-1])

    def frame(self) -> np.ndarray:
        """Positions [m] after a frame's steps, shape (V, 3)."""
        for _ in range(self.substeps // 2):
            if self.graph is not None:
                wp.capture_launch(self.graph)
                continue
            self.twice()
            if self.states[0].particle_q.device.is_cuda:
                with wp.ScopedCapture(device=self.states[0].particle_q.device) as capture:
                    self.twice()
                self.graph = capture.graph
        return self.states[0].particle_q.numpy().copy()


def main() -> None:
    """Simulate and write positions of each frame [m], shape (F, V, 3), and milliseconds of each."""
    parser = argparse.ArgumentParser()
    parser.add_argument("problem")
    parser.add_argument("result")
    parser.add_argument("--solver", choices=["style3d", "vbd"], default="style3d")
    parser.add_argument("--device", default="cuda" if wp.is_cuda_available() else "cpu")
    parser.add_argument("--lock", default="")
    given = parser.parse_args()
    problem = dict(np.load(given.problem))
    simulation = Simulation(problem, given.solver, given.device)
    lock = open(given.lock or given.problem, "rb")  # Until the program ends.
    fcntl.flock(lock, fcntl.LOCK_EX)
    frames, spent = [], []
    for _ in range(len(problem["targets"]) // simulation.substeps):
        began = time.perf_counter()
        frames.append(simulation.frame())
        spent.append(1e3 * (time.perf_counter() - began))
    np.savez(given.result, frames=frames, milliseconds=spent, newton=newton.__version__)


if __name__ == "__main__":
    main()
