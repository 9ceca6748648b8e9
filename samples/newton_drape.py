"""A shawl that Newton drapes over a ball, with piping round its hem: run by a Python that has newton and usd-core.

    python samples/newton_drape.py out/drape.usdc
    physgraph-usd refine out/drape.usdc -o out/drape.refined.usdc

Newton's Style3D solver makes the coarse cloth; the layer tags it as a garment and the ball as a body, and binds the
piping, which stands still as it was modelled. Imports nothing of this package.
"""

from __future__ import annotations

import sys
from pathlib import Path

import newton  # pyright: ignore[reportMissingImports]
import numpy as np
import warp as wp
from newton.solvers import style3d  # pyright: ignore[reportMissingImports]
from pxr import Sdf, Usd, UsdGeom, Vt

CELLS, SIDE, RADIUS = 32, 0.9, 0.2
"""Squares along a side, the side and the ball's radius [m]."""
FRAMES, RATE, SUBSTEPS = 30, 24.0, 20


def sheet() -> tuple[np.ndarray, np.ndarray]:
    """Level positions just above the ball [m], shape (V, 3), Z up, and quads, shape (F, 4)."""
    line = np.linspace(-0.5 * SIDE, 0.5 * SIDE, CELLS + 1)
    y, x = (each.ravel() for each in np.meshgrid(line, line, indexing="ij"))
    number = np.arange((CELLS + 1) ** 2).reshape(CELLS + 1, -1)
    quads = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1)
    return np.stack([x + 0.06, y, 0.0 * x + RADIUS + 0.01], axis=1), quads.reshape(-1, 4)


def simulate(points: np.ndarray, quads: np.ndarray) -> list[np.ndarray]:
    """Positions of each frame [m], shape (V, 3)."""
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
    newton.solvers.SolverStyle3D.register_custom_attributes(builder)
    style3d.add_cloth_mesh(
        builder,
        pos=wp.vec3(0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0),
        vertices=points.tolist(),
        indices=triangles.ravel().tolist(),
        density=0.2,
        panel_verts=points[triangles.ravel(), :2].tolist(),
        panel_indices=list(range(triangles.size)),
        tri_aniso_ke=wp.vec3(100.0, 100.0, 10.0),
        edge_aniso_ke=wp.vec3(2e-5),
        particle_radius=4e-3,
    )
    builder.add_shape_sphere(-1, radius=RADIUS)
    model = builder.finalize()
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 10.0, 1e-5, 0.4
    solver = newton.solvers.SolverStyle3D(model, config=newton.solvers.SolverStyle3D.Config(iterations=4))
    state, after, control = model.state(), model.state(), model.control()
    pipeline = newton.CollisionPipeline(model)
    contacts, frames = pipeline.contacts(), [points]
    for step in range((FRAMES - 1) * SUBSTEPS):
        pipeline.collide(state, contacts)
        state.clear_forces()
        solver.step(state, after, control, contacts, 1.0 / (RATE * SUBSTEPS))
        state, after = after, state
        if (step + 1) % SUBSTEPS == 0:
            frames.append(state.particle_q.numpy().copy())
    return frames


def write(path: Path, frames: list[np.ndarray], quads: np.ndarray) -> None:
    """The shot: shawl, ball and piping."""
    stage = Usd.Stage.CreateNew(str(path))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/shot").GetPrim())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetTimeCodesPerSecond(RATE)
    shawl = UsdGeom.Mesh.Define(stage, "/shot/shawl")
    shawl.CreateFaceVertexCountsAttr([4] * len(quads))
    shawl.CreateFaceVertexIndicesAttr(quads.ravel().tolist())
    points = shawl.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(frames[0].astype(np.float32)))
    for number, each in enumerate(frames):
        points.Set(Vt.Vec3fArray.FromNumpy(each.astype(np.float32)), number + 1.0)
    shawl.GetPrim().AddAppliedSchema("PhysGraphGarmentAPI")
    ball = UsdGeom.Sphere.Define(stage, "/shot/ball")
    ball.CreateRadiusAttr(RADIUS)
    ball.GetPrim().AddAppliedSchema("PhysGraphColliderAPI")
    rows = np.arange((CELLS + 1) ** 2).reshape(CELLS + 1, -1)
    hem = np.concatenate([rows[0, :-1], rows[:-1, -1], rows[-1, :0:-1], rows[:0:-1, 0]])
    piping = UsdGeom.BasisCurves.Define(stage, "/shot/piping")
    piping.CreateTypeAttr(UsdGeom.Tokens.linear)
    piping.CreateWrapAttr(UsdGeom.Tokens.periodic)
    piping.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(frames[0][hem].astype(np.float32)))
    piping.CreateCurveVertexCountsAttr([len(hem)])
    piping.CreateWidthsAttr([4e-3])
    piping.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    shawl.GetPrim().CreateRelationship("physgraph:bind:targets", False).SetTargets([Sdf.Path("/shot/piping")])
    stage.SetStartTimeCode(1.0)
    stage.SetEndTimeCode(float(len(frames)))
    stage.Save()


if __name__ == "__main__":
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/drape.usdc")
    out.parent.mkdir(parents=True, exist_ok=True)
    start, faces = sheet()
    write(out, simulate(start, faces), faces)
    sys.stdout.write(f"{out}\n")
