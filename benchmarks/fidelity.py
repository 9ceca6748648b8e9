"""Refined cloth beside the same cloth simulated finely, from one animation.

    python -m benchmarks.fidelity [--newton PYTHON] [--short] [-o benchmarks/results/fidelity.md]
    python -m benchmarks.fidelity --paired [-o benchmarks/results/paired.md]

Each scene is simulated once at the cage's resolution and once at two subdivisions. The first is the animation that is
refined, as a shot is; the second is what a fine simulation of that fabric shows. Four scenes are simulated by the
solver's own potential and inertia (backward Euler, two increments a frame, no guide, no contact); where ``--newton``
names a Python that has newton, four more by Newton's Style3D solver, with its material, contact and friction
(`newton_cloth.py`), refined with bodies and contact. The page says what each column is. The fine simulation has a
history of its own: it sways out of step, and its folds need not lie where the cage's do.

With ``--paired`` the cage is instead every fourth vertex of our own fine simulation, those that subdivision keeps from
the cage, so the simulation shows where the folds of this very animation were. Each is refined with the usual guide and
with one ten times as stiff.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time as clock
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
import trimesh

from benchmarks.drawing import Thing, drawn, framing, upright
from benchmarks.fidelity_stages import SCENES, Body, Skin, Stage
from benchmarks.rows import say, table
from benchmarks.waves import lowpass, vertex_area
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.colliders.pose import Collider, Pose
from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.forces import body_terms, elastic_terms
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.forces.membrane import shear_stiffness
from physgraph_usd.solver.forces.tether import Tether
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.grain import axes
from physgraph_usd.solver.integrate.base import System
from physgraph_usd.solver.integrate.descend import solve_level
from physgraph_usd.solver.integrate.metric import Metric, laplacian
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.stop import Budget
from physgraph_usd.solver.level import Level, build_levels, hinge_geometry, refine_garments
from physgraph_usd.solver.mesh.elements import hinges_of
from physgraph_usd.solver.mesh.vectors import at_corners, dot
from physgraph_usd.solver.scene import Frame, Garment, GarmentFrame, Grain, Scene
from physgraph_usd.usd.read.motion import CageMotion

GRAVITY = np.array([0.0, 0.0, -9.81])
RATE, INCREMENTS = 24.0, 2
STEPS = 40
"""Quasi-Newton steps an increment, at most."""
SUBSTEPS = 20
"""Newton's steps a frame: with ten, a cage in silk had a quarter less curvature than with forty."""
ITERATIONS = (4, 40)
"""Its iterations of a step, and of the conjugate gradients in each: with ten of these a fine sheet falls too slowly."""
APART = 3e-3
"""Distance that its cloth keeps to itself [m]."""
OURS, NEWTON = ("curtain", "sleeve", "skirt", "flag"), ("curtain", "flag", "ball", "elbow")
"""Scenes by who simulates them."""
BANDS = (0.3, 0.15, 0.08, 0.04, 0.02)
"""Ends of the bands of wavelengths [m]."""
PATCH = 0.1
"""Wavelength over which directions and densities of folds are averaged [m]."""
FOLDED = 0.5
"""Part of the cloth that counts as folding: the half with the densest folds, in both."""
FABRICS = ("jersey", "silk", "denim")
LEVEL = 2
"""Subdivisions."""
PANEL, QUALITY = (300, 340), 60
"""A film's side [pixels], and its quality."""
STRIDE, SPEED = 2, 8
"""Frames from one picture to the next, and pictures a second."""
SIDES = {"cage": "Cage", "loop": "Loop subdivision", "refined": "Refined", "simulated": "Simulated finely"}
"""Titles of a film's sides."""
FILMED = [("curtain", "Newton", "jersey"), ("elbow", "Newton", "silk"), ("ball", "Newton", "denim")]
FILMED += [("flag", "Newton", "denim")]
PAGE = Path("benchmarks/results/fidelity.md")
PAIRED, PAIRED_PAGE = ("curtain", "flag", "skirt"), Path("benchmarks/results/paired.md")
"""Scenes whose cage is a part of the fine simulation, and their page."""
PAIRED_TEXT = """# Beside the fine simulation that the cage is every fourth vertex of

Written by `python -m benchmarks.fidelity --paired`. Means over the last half of the frames; without contact.

- **Guide** [N/m^3]: the default, and ten times as stiff.
- **Distance** [mm]: RMS, of the subdivided cage and of the refined cloth, from the simulation.
- **Correlation** of the detail, the difference from the linearly upsampled cage, with the simulation's.
- **Bands**: RMS of the detail in each band of wavelengths, refined / simulated.
- **Motion**: second difference in time of what is finer than the cage, refined / simulated.
"""
GUIDES = (2000.0, 20000.0)
"""Stiffnesses of the guide with `--paired` [N/m^3]."""
RATIO, ANGLE = 6, -3
"""Columns of the table: curvature refined over simulated, and the angle between folds."""
TEXT = """# Beside the same cloth simulated finely

Written by `python -m benchmarks.fidelity --newton PYTHON`. Each scene is simulated at the cage's resolution, which is
refined as a shot is, and at two subdivisions. Means over the last half of the frames.

- **Newton**: its Style3D solver (1.8.0, on a GPU) with its membrane, bending, contact and friction. Stiffnesses
  correspond: warp, weft and shear are the fabric's, without contraction across; bending is scaled so that a cylinder
  along warp or weft holds D k^2 / 2. **Ours**: our potential and inertia, no guide, no contact.
- **Curvature** [m]: total absolute mean curvature of Loop subdivision, refined, simulated.
- **Bands**: RMS of the positions' part of each band of wavelengths, refined over simulated.
- **Angle**: median angle between refined and simulated folds, where both are among their denser half. **Where**:
  correlation of the density of folds over patches of 100 mm.
- **Motion**: second difference in time of what is finer than the cage, refined over simulated.
"""


def garment_of(stage: Stage, level: int, *, touches: bool = False) -> Garment:
    """The stage's sheet as a garment, its warp along its second material coordinate; whether it touches anything."""
    feels = tuple(range(len(stage.bodies))) if touches else ()
    garment = Garment.of("/Sheet", stage.faces, stage.rest, level=level, colliders=feels)
    one = np.ones(len(stage.rest))
    return replace(garment, pin=stage.held.astype(float), grain=Grain(stage.warp, one, 0.0 * one), self_contact=touches)


def level_at(garment: Garment, subdivisions: int) -> Level:
    """The garment's sheet at a number of subdivisions, float32."""
    return build_levels([garment], refine_garments([garment], [subdivisions]))[-1]


def simulated(stage: Stage, fabric: Fabric, subdivisions: int, *, frames: int) -> Iterator[np.ndarray]:
    """Positions of each frame [m], shape (V, 3), of a simulation without contact at a level, from rest."""
    level = level_at(garment_of(stage, subdivisions), subdivisions)
    terms = (*elastic_terms(level, [fabric]), *body_terms(level, [fabric], gravity=GRAVITY))
    h = 1.0 / (RATE * INCREMENTS)
    x = torch.as_tensor(level.from_coarse @ stage.rest).to(level.rest)
    density = torch.tensor([fabric.density])
    module = ForceModule((*terms, Tether(level, density, h**-2, x)))
    matrix = laplacian(level.springs.numpy(), *module.rest_springs())
    metric = Metric(matrix, free=level.free, dtype=level.dtype)
    velocity, free = torch.zeros_like(x), level.free
    for frame in range(frames):
        for increment in range(INCREMENTS):
            time = (frame * INCREMENTS + increment + 1) * h
            moved = torch.as_tensor(level.from_coarse @ stage.motion(time)).to(x)
            inertia = Tether(level, density, h**-2, x + h * velocity)
            start = torch.where(free, x + h * velocity, moved)
            system = System(ForceModule((*terms, inertia)), metric, free=free, spacing=level.spacing, level=level)
            after, _ = solve_level(system, QuasiNewton(), start, level=0, budget=Budget(STEPS, 1e-3))
            velocity, x = (after - x) / h, after
        yield x.double().numpy()


def area_of(level: Level) -> float:
    """Area at rest [m^2]."""
    corners = level.rest.double().numpy()[level.triangles.numpy()]
    return float(0.5 * np.linalg.norm(np.cross(*(corners[:, 1:] - corners[:, :1]).swapaxes(0, 1)), axis=1).sum())


def panel_of(stage: Stage, level: Level) -> np.ndarray:
    """Each triangle laid flat with its weft along x and its warp along y [m], shape (T, 3, 2)."""
    corners = at_corners(level.rest.double().numpy(), level.triangles.numpy())
    spans = corners - corners[0]
    warp, across = axes(spans[1:], np.broadcast_to(stage.warp[0][:, None], spans[0].shape))
    return np.stack([-dot(spans, across), dot(spans, warp)]).T


def problem_of(
    stage: Stage, fabric: Fabric, subdivisions: int, *, frames: int, substeps: int = SUBSTEPS
) -> dict[str, np.ndarray]:
    """What `benchmarks/newton_cloth.py` is given: stiffnesses that correspond, and where held vertices and bodies are.

    Its membrane has the fabric's along weft, warp and in shear, no contraction across; its bending, alike in all
    directions, has the warp's. A stage may have one body that bends.
    """
    level, step = level_at(garment_of(stage, subdivisions), subdivisions), 1.0 / (RATE * substeps)
    held = np.flatnonzero(level.from_coarse @ stage.held.astype(float) > 1.0 - 1e-6)
    follows, times = level.from_coarse[held], step * np.arange(1, frames * substeps + 1)
    rigid = [body for body in stage.bodies if isinstance(body, Body)]
    places = [[body.place(time) for body in rigid] for time in times]
    skins = [body.pose(n / RATE) for body in stage.bodies if isinstance(body, Skin) for n in range(frames + 1)]
    weft = fabric.stretch if fabric.weft_stretch is None else fabric.weft_stretch
    return {
        "points": level.from_coarse @ stage.rest,
        "triangles": level.triangles.numpy(),
        "panel": panel_of(stage, level),
        "stretch": np.array([weft, fabric.stretch, shear_stiffness(fabric)]),
        "bend": np.array(fabric.bend),
        "density": np.array(fabric.density),
        "held": held,
        "targets": np.array([follows @ stage.motion(time) for time in times], np.float32),
        "substeps": np.array(substeps),
        "step": np.array(step),
        "iterations": np.array(ITERATIONS),
        "apart": np.array(APART),
        "spacing": np.array(np.sqrt(2.0 * area_of(level) / len(level.triangles))),
        "capsules": np.array([(body.radius, body.half) for body in rigid]).reshape(-1, 2),
        "middles": np.array([[middle for middle, _ in each] for each in places]).reshape(len(times), -1, 3),
        "turns": np.array([[turn for _, turn in each] for each in places]).reshape(len(times), -1, 3, 3),
        "skin": np.array([pose.points for pose in skins] or np.zeros((0, 0, 3))),
        "faces": skins[0].triangles if skins else np.zeros((0, 3), np.int32),
    }


def newton_result(python: str, problem: dict[str, np.ndarray], result: Path, *options: str) -> dict[str, np.ndarray]:
    """What `benchmarks/newton_cloth.py` writes; a result that is there is not simulated again.

    Args:
        python: One that has Newton.
        problem: As `problem_of` gives it.
        result: Where it is written.
        options: Of that program.
    """
    if not result.exists():
        given = result.with_suffix(".problem.npz")
        np.savez_compressed(given, allow_pickle=False, **problem)
        script = Path(__file__).with_name("newton_cloth.py")
        subprocess.run([python, "-P", script, given, result, *options], check=True, stdout=subprocess.DEVNULL)
    return dict(np.load(result))


def refined(
    stage: Stage, fabric: Fabric, cages: Sequence[np.ndarray], subdivisions: int, *, touches: bool = False
) -> list[np.ndarray]:
    """Positions of each frame [m], shape (V, 3), of the cages refined as a shot is."""
    return [points for points, _ in timed(stage, fabric, cages, subdivisions, touches=touches)]


def timed(
    stage: Stage,
    fabric: Fabric,
    cages: Sequence[np.ndarray],
    subdivisions: int,
    *,
    touches: bool,
    device: str = "cpu",
    **settings: Any,
) -> Iterator[tuple[np.ndarray, float]]:
    """Positions of each frame [m], shape (V, 3), of the cages refined as a shot is, and milliseconds of each."""
    bodies = enumerate(stage.bodies) if touches else ()
    colliders = tuple(Collider(f"/Body{number}", body.kind) for number, body in bodies)
    garment = garment_of(stage, subdivisions, touches=touches)
    refiner = Refiner(Scene((garment,), GRAVITY, (), colliders), SolveSettings(**settings), device=device)
    for n, cage in enumerate(cages):
        poses: tuple[Pose, ...] = tuple(body.pose((n + 1) / RATE) for body in stage.bodies) if touches else ()
        began = clock.perf_counter()
        points = refiner.solve(Frame(float(n), (GarmentFrame(cage, fabric),), poses)).garments[0].points
        assert points is not None  # The garment is in every frame.
        yield points, 1e3 * (clock.perf_counter() - began)


@dataclass(frozen=True, eq=False)
class Judge:
    """Measures of positions on a scene's fine mesh.

    Attributes:
        level: The mesh.
        flat: Material coordinates of its vertices [m], shape (V, 2).
    """

    level: Level
    flat: np.ndarray

    @cached_property
    def smooth(self) -> list[Callable[[np.ndarray], np.ndarray]]:
        """Filters that leave out what is shorter than each end of the bands."""
        return lowpass(self.level, BANDS)

    def curvature(self, x: np.ndarray) -> float:
        """Total absolute mean curvature [m]: half the sum of the hinges' angles times their lengths."""
        angle, _, _, length = hinge_geometry(x, hinges_of(self.level.triangles.numpy()))
        return float(0.5 * (np.abs(angle) * length).sum())

    def amplitudes(self, x: np.ndarray) -> np.ndarray:
        """RMS of each band of wavelengths of a field, shape (V, C), such as positions; the last has all the rest."""
        area = vertex_area(self.level)
        smooth = [each(x) for each in self.smooth] + [x]
        parts = [short - long for long, short in pairwise(smooth)]
        return np.array([np.sqrt((area[:, None] * part**2).sum() / area.sum()) for part in parts])

    def bending(self, x: np.ndarray) -> np.ndarray:
        """Mean curvature at each vertex [1/m], shape (V, 1): half of what its hinges turn, 0 on a flat sheet."""
        hinges = hinges_of(self.level.triangles.numpy())
        angle, _, _, length = hinge_geometry(x, hinges)
        turned = np.bincount(hinges[:, :2].ravel(), np.repeat(0.25 * angle * length, 2), self.level.vertex_count)
        return (turned / vertex_area(self.level))[:, None]

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
        python: One that has Newton, which simulates; "" where we do.
        kept: Folder in which Newton's problems and results stay; a result that is there is not simulated again.
    """

    scene: str
    fabric: str
    frames: int
    python: str = ""
    kept: Path | None = None

    @property
    def who(self) -> str:
        """Who simulates."""
        return "Newton" if self.python else "ours"

    def by_newton(self, subdivisions: int) -> list[np.ndarray]:
        """Positions of each frame [m], shape (V, 3), by Newton's Style3D solver."""
        problem = problem_of(SCENES[self.scene](), PRESETS[self.fabric], subdivisions, frames=self.frames)
        with tempfile.TemporaryDirectory() as folder:
            result = (self.kept or Path(folder)) / f"{self.scene}_{self.fabric}_{subdivisions}.npz"
            return list(newton_result(self.python, problem, result)["frames"].astype(float))


Sides = dict[str, np.ndarray]
"""Positions of each frame [m], shape (F, V, 3), by the keys of `SIDES`."""


def filmed(task: Task) -> Sides:
    """Simulate the cage and the fine cloth, and refine the cage."""
    prepare_device("cpu")
    stage, values = SCENES[task.scene](), PRESETS[task.fabric]

    def moved(subdivisions: int) -> list[np.ndarray]:
        if task.python:
            return task.by_newton(subdivisions)
        return list(simulated(stage, values, subdivisions, frames=task.frames))

    cages, truth = moved(0), moved(LEVEL)
    fine = refined(stage, values, cages, LEVEL, touches=bool(task.python))
    level = level_at(garment_of(stage, LEVEL), LEVEL)
    loop = [level.smooth_from_coarse @ cage for cage in cages]
    return dict(zip(SIDES, map(np.array, (cages, loop, fine, truth)), strict=True))


def row_of(task: Task, sides: Sides) -> list[str]:
    """A row of the table."""
    stage = SCENES[task.scene]()
    level = level_at(garment_of(stage, LEVEL), LEVEL)
    judge, late = Judge(level, level.from_coarse @ stage.flat), slice(task.frames // 2, None)
    loop, fine, truth = (sides[name][late] for name in ("loop", "refined", "simulated"))
    curvature = [np.mean([judge.curvature(x) for x in each]) for each in (loop, fine, truth)]
    bands = [np.mean([judge.amplitudes(x) for x in each], axis=0) for each in (fine, truth)]
    angle, where = np.mean([judge.compared(x, y) for x, y in zip(fine[::4], truth[::4], strict=True)], 0)
    cells = [f"{each:.2f}" for each in (*curvature, curvature[1] / curvature[2], *(bands[0] / bands[1]))]
    cells += [f"{angle:.0f}", f"{where:.2f}", f"{jerk(fine, loop) / jerk(truth, loop):.2f}"]
    return [task.scene, task.who, task.fabric, *cells]


def made(task: Task) -> tuple[list[str], Sides]:
    """A row of the table, and what it is of."""
    torch.set_num_threads(1)
    sides = filmed(task)
    return row_of(task, sides), sides


def paired_rows(scene: str, fabric: str, *, frames: int) -> list[list[str]]:
    """Rows of the table with `--paired`, one for each of `GUIDES`."""
    stage, values = SCENES[scene](), PRESETS[fabric]
    level = level_at(garment_of(stage, LEVEL), LEVEL)
    truth = np.array(list(simulated(stage, values, LEVEL, frames=frames)))
    cages = truth[:, kept_from_cage(level.from_coarse)]
    times, edges = [*map(float, range(len(cages)))], garment_of(stage, LEVEL).mesh.half_edges.edges
    motion = CageMotion(times, lambda time: cages[int(time)], edges=edges, frame=1.0, seconds=1.0 / RATE)
    felt = [motion.felt(float(n), cage) for n, cage in enumerate(cages)]
    late, judge = slice(frames // 2, None), Judge(level, level.from_coarse @ stage.flat)
    maps = level.from_coarse, level.smooth_from_coarse
    linear, smooth = (np.array([each @ cage for cage in cages[late]]) for each in maps)
    true_detail, rows = truth[late] - linear, []
    for guide in GUIDES:
        pairs = zip(cages, felt, strict=True)
        inputs = [GarmentFrame(cage, values, guide, acceleration=pushed) for cage, pushed in pairs]
        refiner = Refiner(Scene((garment_of(stage, LEVEL),), GRAVITY), SolveSettings())
        results = refiner.refine(Frame(float(n), (one,)) for n, one in enumerate(inputs))
        fine = np.array([result.garments[0].points for result in results])[late]
        detail = fine - linear
        bands = [np.mean([judge.amplitudes(x) for x in field], axis=0) for field in (detail, true_detail)]
        far = [1e3 * np.sqrt(((x - truth[late]) ** 2).sum(axis=2).mean()) for x in (smooth, fine)]
        correlation = (detail * true_detail).sum() / np.sqrt((detail**2).sum() * (true_detail**2).sum())
        motion = jerk(fine, smooth) / jerk(truth[late], smooth)
        figures = (*far, correlation, *(bands[0] / bands[1]), motion)
        rows.append([scene, fabric, f"{guide:,.0f}", *(f"{figure:.2f}" for figure in figures)])
    return rows


def kept_from_cage(from_coarse: sp.csr_matrix) -> np.ndarray:
    """The fine vertex at each vertex of the cage, shape (C,): it depends on that one alone."""
    matrix = sp.coo_matrix(from_coarse)
    alone = matrix.data == 1.0
    out = np.empty(from_coarse.shape[1], np.int64)
    out[matrix.col[alone]] = matrix.row[alone]
    return out


def heading() -> list[str]:
    """The table's head."""
    names = ["scene", "simulated by", "fabric", "Loop, m", "refined, m", "simulated, m", "refined / simulated"]
    return [*names, *band_names(), "angle, degrees", "where", "motion"]


def band_names() -> list[str]:
    """Names of the bands."""
    ends = [f"{1e3 * a:g}-{1e3 * b:g} mm" for a, b in pairwise(BANDS)]
    return [*ends, f"under {1e3 * BANDS[-1]:g} mm"]


def body_at(body: Body | Skin, time: float) -> Thing:
    """A body's surface at a time [s]."""
    if isinstance(body, Skin):
        return Thing(upright(body.points(time)), body.triangles, cloth=False)
    if body.half:
        mesh = trimesh.creation.capsule(height=2.0 * body.half, radius=0.97 * body.radius)
    else:
        mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.99 * body.radius)
    (middle, turn), points = body.place(time), np.asarray(mesh.vertices)
    points = points - 0.5 * (points.min(axis=0) + points.max(axis=0))
    return Thing(upright(points @ turn.T + middle), np.asarray(mesh.faces, np.int32), cloth=False)


def triangles_of(stage: Stage, subdivisions: int) -> np.ndarray:
    """Corners of the sheet's triangles, shape (T, 3)."""
    return level_at(garment_of(stage, subdivisions), subdivisions).triangles.numpy()


def panels_at(
    stage: Stage, sides: Sides, frame: int, *, meshes: tuple[np.ndarray, np.ndarray]
) -> list[tuple[str, list[Thing]]]:
    """Panels of a frame; meshes are the triangles of the cage and of what is fine."""
    bodies = [body_at(body, (frame + 1) / RATE) for body in stage.bodies]
    return [
        (title, [Thing(upright(sides[name][frame]), meshes[name != "cage"]), *bodies]) for name, title in SIDES.items()
    ]


def film(task: Task, sides: Sides, out: Path) -> None:
    """Draw the sides as a loop."""
    stage = SCENES[task.scene]()
    meshes = triangles_of(stage, 0), triangles_of(stage, LEVEL)
    frames = [panels_at(stage, sides, frame, meshes=meshes) for frame in range(1, len(sides["cage"]), STRIDE)]
    view, floor = framing([each for panels in frames for _, things in panels for each in things], PANEL, stage.camera)
    first, *others = [drawn(panels, view, size=PANEL, floor=floor) for panels in frames]
    moving = {"save_all": True, "append_images": others, "duration": 1000 // SPEED, "loop": 0}
    first.save(out, quality=QUALITY, method=4, **moving)
    say(f"{out}: {out.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    """Write the page and the films."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path)
    parser.add_argument("--paired", action="store_true", help="The cage as every fourth vertex of our simulation.")
    parser.add_argument("--newton", default="", metavar="PYTHON", help="A Python that has newton.")
    parser.add_argument("--short", action="store_true", help="Ten frames in jersey alone.")
    parser.add_argument("--kept", type=Path, help="Folder of Newton's problems and results, which are used again.")
    parser.add_argument("--jobs", type=int, default=2, help="Rows made at once.")
    given = parser.parse_args()
    given.out = given.out or (PAIRED_PAGE if given.paired else PAGE)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    fabrics, frames = (FABRICS[:1], 10) if given.short else (FABRICS, 24)
    if given.paired:
        prepare_device("cpu")
        pairs = product(PAIRED, [each for each in fabrics if each != "silk"])
        rows = [row for pair in pairs for row in paired_rows(*pair, frames=frames)]
        head = ["scene", "fabric", "guide", "subdivided, mm", "refined, mm", "correlation", *band_names(), "motion"]
        given.out.write_text(f"{PAIRED_TEXT}\n{table(head, rows)}\n", encoding="utf-8")
        return
    foreign = product(NEWTON if given.newton else (), fabrics)
    tasks = [Task(*each, frames, given.newton, given.kept) for each in foreign]
    tasks += [Task(*each, frames) for each in product(OURS, fabrics)]
    rows = []
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        for task, (row, sides) in zip(tasks, pool.map(made, tasks), strict=True):
            say(" ".join(row))
            rows.append(row)
            if (task.scene, task.who, task.fabric) in FILMED:
                film(task, sides, given.out.with_name(f"fidelity_{task.scene}_{task.fabric}.webp"))
    shown = [f"![{scene}, {fabric}](fidelity_{scene}_{fabric}.webp)" for scene, _, fabric in FILMED]
    middle = [f"{np.median([float(row[column]) for row in rows]):.2f}" for column in (RATIO, ANGLE)]
    said = "\nMedians: curvature refined / simulated {}, angle {} degrees. ".format(*middle)
    said += "From left: cage, Loop subdivision, refined, simulated.\n"
    text = "\n".join([TEXT, table(heading(), rows), said, *shown])
    given.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
