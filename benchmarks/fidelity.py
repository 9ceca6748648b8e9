"""Refined cloth beside the same cloth simulated finely, from one animation.

    python -m benchmarks.fidelity [--scenes curtain sleeve] [--fabrics silk] [--frames 20] [--jobs 2] [--save FOLDER]
    python -m benchmarks.fidelity --newton PYTHON [...]      PYTHON is one that has newton

Each scene is simulated once at the cage's resolution and once at two subdivisions. The first is the animation that is
refined, as a shot is; the second is what a fine simulation of that fabric shows. Four scenes are simulated by the
solver's own potential and inertia (backward Euler, two increments a frame, no guide, no contact); with ``--newton``
four are by Newton's Style3D solver, with its material, contact and friction (`benchmarks/newton_cloth.py`), and what
it makes is refined with bodies and contact. Printed over the last half of the frames: curvature
of Loop subdivision, refined and simulated; amplitudes by wavelength, refined over simulated; the angle between their
folds, where both fold; the correlation of where they fold; the second difference in time of what is finer than the
cage, refined over simulated. The fine simulation has a history of its own: it sways out of step, and its folds need
not lie where the cage's do.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise, product
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

from benchmarks.fidelity_stages import SCENES, Stage
from benchmarks.loose_garment import lowpass, vertex_area
from benchmarks.rows import say
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.colliders.pose import Collider, ShapePose
from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.forces import body_terms, elastic_terms
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.forces.membrane import shear_stiffness
from physgraph_usd.solver.forces.tether import Tether
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.grain import axes
from physgraph_usd.solver.integrate.base import System
from physgraph_usd.solver.integrate.metric import Metric
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.solve import Budget, solve_level
from physgraph_usd.solver.level import Level, build_levels, hinge_geometry, refine_garments
from physgraph_usd.solver.mesh.elements import hinges_of
from physgraph_usd.solver.scene import Frame, Garment, GarmentFrame, Grain, Scene

GRAVITY = np.array([0.0, 0.0, -9.81])
RATE, INCREMENTS = 24.0, 2
STEPS = 40
"""Quasi-Newton steps an increment, at most."""
SUBSTEPS = 20
"""Newton's steps a frame: with ten, a cage in silk had a quarter less curvature than with forty."""
OURS, NEWTON = ("curtain", "sleeve", "skirt", "flag"), ("curtain", "flag", "ball", "elbow")
"""Scenes by who simulates them."""
BANDS = (0.3, 0.15, 0.08, 0.04, 0.02)
"""Ends of the bands of wavelengths [m]."""
PATCH = 0.1
"""Wavelength over which directions and densities of folds are averaged [m]."""
FOLDED = 0.5
"""Part of the cloth that counts as folding: the half with the densest folds, in both."""
FABRICS = ("jersey", "silk", "denim")


def garment_of(stage: Stage, level: int, *, touches: bool = False) -> Garment:
    """The stage's sheet as a garment, its warp along its second material coordinate; whether it touches anything."""
    feels = tuple(range(len(stage.bodies))) if touches else ()
    garment = Garment.of("/Sheet", stage.faces, stage.rest, level=level, colliders=feels)
    corners = stage.rest[stage.faces]
    down = corners[:, 3] - corners[:, 0]
    warp, one = down / np.linalg.norm(down, axis=1, keepdims=True), np.ones(len(stage.rest))
    return replace(garment, pin=stage.held.astype(float), grain=Grain(warp, one, 0.0 * one), self_contact=touches)


def level_at(garment: Garment, subdivisions: int) -> Level:
    """The garment's sheet at a number of subdivisions, float32."""
    return build_levels([garment], refine_garments([garment], [subdivisions]))[-1]


def simulated(stage: Stage, fabric: Fabric, subdivisions: int, *, frames: int) -> Iterator[np.ndarray]:
    """Positions of each frame [m], shape (V, 3), of a simulation without contact at a level, from rest."""
    level = level_at(garment_of(stage, subdivisions), subdivisions)
    terms = (*elastic_terms(level, [fabric]), *body_terms(level, [fabric], gravity=GRAVITY))
    h = 1.0 / (RATE * INCREMENTS)
    x = torch.as_tensor(level.from_coarse @ stage.rest).to(level.rest)
    inertia = Tether(level, torch.tensor([fabric.density]), h**-2, x.clone())
    terms = (*terms, inertia)
    module = ForceModule(terms)
    metric = Metric(module.rest_matrix(), free=level.free, dtype=level.dtype)
    velocity, free = torch.zeros_like(x), level.free
    for frame in range(frames):
        for increment in range(INCREMENTS):
            time = (frame * INCREMENTS + increment + 1) * h
            moved = torch.as_tensor(level.from_coarse @ stage.motion(time)).to(x)
            inertia.aim(x + h * velocity, h**-2)
            start = torch.where(free, x + h * velocity, moved)
            system = System(ForceModule(terms), metric, free=free, spacing=level.spacing, level=level)
            after, _ = solve_level(system, QuasiNewton(), start, level=0, budget=Budget(STEPS, 1e-3))
            velocity, x = (after - x) / h, after
        yield x.double().numpy()


def panel_of(stage: Stage, level: Level) -> np.ndarray:
    """Each triangle laid flat with its weft along x and its warp along y [m], shape (T, 3, 2)."""
    rest, triangles = level.rest.double().numpy(), level.triangles.numpy()
    corners = stage.rest[stage.faces[0]]
    down = np.broadcast_to(corners[3] - corners[0], (len(triangles), 3))
    warp, across = axes(rest, triangles, down / np.linalg.norm(down[0]))
    spans = rest[triangles] - rest[triangles][:, :1]
    return np.stack([-np.einsum("tcx,tx->tc", spans, across), np.einsum("tcx,tx->tc", spans, warp)], axis=2)


def problem_of(stage: Stage, fabric: Fabric, subdivisions: int, *, frames: int) -> dict[str, np.ndarray]:
    """What `benchmarks/newton_cloth.py` is given: stiffnesses that correspond, and where held vertices and bodies are.

    Its membrane has the fabric's along weft, warp and in shear, no contraction across; its bending, alike in all
    directions, has the warp's.
    """
    level, step = level_at(garment_of(stage, subdivisions), subdivisions), 1.0 / (RATE * SUBSTEPS)
    held = np.flatnonzero(level.from_coarse @ stage.held.astype(float) > 1.0 - 1e-6)
    times = step * np.arange(1, frames * SUBSTEPS + 1)
    poses = [[body.pose(time) for body in stage.bodies] for time in times]
    weft = fabric.stretch if fabric.weft_stretch is None else fabric.weft_stretch
    return {
        "points": level.from_coarse @ stage.rest,
        "triangles": level.triangles.numpy(),
        "panel": panel_of(stage, level),
        "stretch": np.array([weft, fabric.stretch, shear_stiffness(fabric)]),
        "bend": np.array(fabric.bend),
        "density": np.array(fabric.density),
        "held": held,
        "targets": np.array([(level.from_coarse @ stage.motion(time))[held] for time in times]),
        "substeps": np.array(SUBSTEPS),
        "step": np.array(step),
        "capsules": np.array([(body.radius, body.half) for body in stage.bodies]).reshape(-1, 2),
        "middles": np.array([[pose.centre for pose in each] for each in poses]),
        "turns": np.array([[pose.turn for pose in each] for each in poses]),
    }


def refined(
    stage: Stage, fabric: Fabric, cages: Sequence[np.ndarray], subdivisions: int, *, touches: bool = False
) -> list[np.ndarray]:
    """Positions of each frame [m], shape (V, 3), of the cages refined as a shot is."""
    kinds = [body.pose(0.0).kind for body in stage.bodies]
    colliders = tuple(Collider(f"/Body{number}", kind) for number, kind in enumerate(kinds)) if touches else ()
    garment = garment_of(stage, subdivisions, touches=touches)
    refiner = Refiner(Scene((garment,), GRAVITY, (), colliders), SolveSettings())
    found = []
    for n, cage in enumerate(cages):
        poses: tuple[ShapePose, ...] = tuple(body.pose((n + 1) / RATE) for body in stage.bodies) if touches else ()
        state = refiner.solve(Frame(float(n), (GarmentFrame(cage, fabric),), poses))
        found += [points for points in state.points if points is not None]
    return found


@dataclass(frozen=True, eq=False)
class Judge:
    """Measures of positions on a scene's fine mesh.

    Attributes:
        level: The mesh.
        flat: Material coordinates of its vertices [m], shape (V, 2).
    """

    level: Level
    flat: np.ndarray

    def curvature(self, x: np.ndarray) -> float:
        """Total absolute mean curvature [m]: half the sum of the hinges' angles times their lengths."""
        angle, _, _, length = hinge_geometry(x, hinges_of(self.level.triangles.numpy()))
        return float(0.5 * (np.abs(angle) * length).sum())

    def amplitudes(self, x: np.ndarray) -> np.ndarray:
        """RMS of the positions' part of each band of wavelengths [m]; the last has all that is shorter."""
        area = vertex_area(self.level)
        smooth = [each(x) for each in lowpass(self.level, BANDS)] + [x]
        parts = [short - long for long, short in pairwise(smooth)]
        return np.array([np.sqrt((area[:, None] * part**2).sum() / area.sum()) for part in parts])

    def folds(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Density of folds [1/m] and the angle [rad] of the direction in which they bend, at each vertex."""
        hinges = hinges_of(self.level.triangles.numpy())
        angle, _, _, length = hinge_geometry(x, hinges)
        along = self.flat[hinges[:, 1]] - self.flat[hinges[:, 0]]
        sound = np.linalg.norm(along, axis=1) < 2.0 * np.median(np.linalg.norm(along, axis=1))  # Not across the seam.
        weight = np.abs(angle) * length * sound
        twice = 2.0 * (np.arctan2(along[:, 1], along[:, 0]) + 0.5 * np.pi)
        field = np.zeros((self.level.vertex_count, 3))
        for side in (0, 1):
            np.add.at(
                field, hinges[:, side], np.stack([np.cos(twice), np.sin(twice), 1 + 0 * twice], 1) * weight[:, None]
            )
        smooth = lowpass(self.level, [PATCH])[0](field / vertex_area(self.level)[:, None])
        return smooth[:, 2], 0.5 * np.arctan2(smooth[:, 1], smooth[:, 0])

    def compared(self, x: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
        """Median angle [degrees] between folds where both fold, and the correlation of their densities."""
        (density, angle), (true_density, true_angle) = self.folds(x), self.folds(truth)
        both = (density > np.quantile(density, FOLDED)) & (true_density > np.quantile(true_density, FOLDED))
        apart = np.abs((angle - true_angle + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
        correlation = float(np.corrcoef(density, true_density)[0, 1])
        return float(np.degrees(np.median(apart[both]))) if both.any() else float("nan"), correlation


def jerk(frames: np.ndarray, smooth: np.ndarray) -> float:
    """RMS second difference in time of the detail [m]."""
    detail = frames - smooth
    return float(np.sqrt((np.diff(detail, n=2, axis=0) ** 2).sum(axis=2).mean()))


@dataclass(frozen=True)
class Task:
    """A row of the table that is to be made.

    Attributes:
        scene: Name of the scene.
        fabric: Name of the preset.
        frames: How many.
        subdivisions: How many.
        python: One that has Newton, which simulates; "" where we do.
        kept: Folder in which Newton's problems and results stay; a result that is there is not simulated again.
    """

    scene: str
    fabric: str
    frames: int
    subdivisions: int
    python: str = ""
    kept: Path | None = None

    def by_newton(self, subdivisions: int) -> list[np.ndarray]:
        """Positions of each frame [m], shape (V, 3), by Newton's Style3D solver."""
        with tempfile.TemporaryDirectory() as folder:
            place, name = self.kept or Path(folder), f"{self.scene}_{self.fabric}_{subdivisions}"
            problem, result = place / f"{name}.problem.npz", place / f"{name}.result.npz"
            if not result.exists():
                given = problem_of(SCENES[self.scene](), PRESETS[self.fabric], subdivisions, frames=self.frames)
                np.savez_compressed(problem, allow_pickle=False, **given)
                script = Path(__file__).with_name("newton_cloth.py")
                subprocess.run([self.python, script, problem, result], check=True, stdout=subprocess.DEVNULL)
            return list(np.load(result)["frames"].astype(float))


@dataclass(frozen=True, eq=False)
class Films:
    """Positions of each frame of the cage, Loop subdivision, refined and simulated [m], each shape (F, V, 3)."""

    cage: np.ndarray
    loop: np.ndarray
    refined: np.ndarray
    simulated: np.ndarray


def filmed(task: Task) -> Films:
    """Simulate the cage and the fine cloth, and refine the cage."""
    prepare_device("cpu")
    stage, values = SCENES[task.scene](), PRESETS[task.fabric]

    def moved(subdivisions: int) -> list[np.ndarray]:
        if task.python:
            return task.by_newton(subdivisions)
        return list(simulated(stage, values, subdivisions, frames=task.frames))

    cages, truth = moved(0), moved(task.subdivisions)
    fine = refined(stage, values, cages, task.subdivisions, touches=bool(task.python))
    level = level_at(garment_of(stage, task.subdivisions), task.subdivisions)
    loop = [level.smooth_from_coarse @ cage for cage in cages]
    return Films(np.array(cages), np.array(loop), np.array(fine), np.array(truth))


def row_of(task: Task, films: Films) -> str:
    """A row of the table."""
    stage, fine = SCENES[task.scene](), films.refined
    level = level_at(garment_of(stage, task.subdivisions), task.subdivisions)
    loop, truth = films.loop, films.simulated
    judge, late = Judge(level, level.from_coarse @ stage.flat), slice(task.frames // 2, None)
    curvature = [np.mean([judge.curvature(x) for x in each[late]]) for each in (loop, fine, truth)]
    bands = [np.mean([judge.amplitudes(x) for x in each[late]], axis=0) for each in (fine, truth)]
    angle, where = np.mean([judge.compared(x, y) for x, y in zip(fine[late][::4], truth[late][::4], strict=True)], 0)
    moves = jerk(fine[late], loop[late]) / jerk(truth[late], loop[late])
    cells = [f"{each:.2f}" for each in curvature] + [f"{curvature[1] / curvature[2]:.2f}"]
    cells += [f"{ratio:.2f}" for ratio in bands[0] / bands[1]] + [f"{angle:.0f}", f"{where:.2f}", f"{moves:.2f}"]
    who = "Newton" if task.python else "ours"
    return f"| {task.scene} | {who} | {task.fabric} | {' | '.join(cells)} |"


def made(task: Task) -> tuple[str, Films]:
    """A row of the table, and what it is of."""
    torch.set_num_threads(1)
    films = filmed(task)
    return row_of(task, films), films


def heading() -> str:
    """The table's head."""
    ends = [f"{1e3 * a:g}-{1e3 * b:g} mm" for a, b in pairwise(BANDS)]
    names = ["scene", "simulated by", "fabric", "Loop, m", "refined, m", "simulated, m", "refined / simulated", *ends]
    names += [f"under {1e3 * BANDS[-1]:g} mm", "angle, degrees", "where", "motion"]
    return f"| {' | '.join(names)} |\n|{'---|' * len(names)}"


def say_rows(tasks: Sequence[Task], *, jobs: int, save: Path | None) -> None:
    """Print the table, and save the positions of all frames."""
    say(heading())
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for task, (row, films) in zip(tasks, pool.map(made, tasks), strict=True):
            say(row)
            if save:
                save.mkdir(parents=True, exist_ok=True)
                who = "newton" if task.python else "ours"
                np.savez_compressed(save / f"{task.scene}_{who}_{task.fabric}.npz", **vars(films))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--newton", default="", metavar="PYTHON", help="Simulate by Newton, which this Python has.")
    parser.add_argument("--kept", type=Path, help="Folder of Newton's problems and results, which are used again.")
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES))
    parser.add_argument("--fabrics", nargs="+", choices=sorted(PRESETS), default=list(FABRICS))
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--level", type=int, default=2, help="Subdivisions.")
    parser.add_argument("--jobs", type=int, default=1, help="Rows made at once.")
    parser.add_argument("--save", type=Path, help="Folder for the positions of all frames, as .npz.")
    given = parser.parse_args()
    scenes = given.scenes or (NEWTON if given.newton else OURS)
    options = given.frames, given.level, given.newton, given.kept
    tasks = [Task(scene, fabric, *options) for scene, fabric in product(scenes, given.fabrics)]
    say_rows(tasks, jobs=given.jobs, save=given.save)


if __name__ == "__main__":
    main()
