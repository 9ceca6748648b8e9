"""Refined cloth beside the same cloth simulated finely, from one animation.

    python -m benchmarks.fidelity [--scenes curtain sleeve] [--fabrics silk] [--frames 30] [--save FOLDER]

Each scene is simulated by the solver's own potential and inertia (backward Euler, two increments a frame, no guide, no
contact), once at the cage's resolution and once at two subdivisions. The first is the animation that is refined, as a
shot is; the second is what a fine simulation of that fabric shows. Printed over the last half of the frames: curvature
of Loop subdivision, refined and simulated; amplitudes by wavelength, refined over simulated; the angle between their
folds, where both fold; the correlation of where they fold; the second difference in time of what is finer than the
cage, refined over simulated. The fine simulation has a history of its own: it sways out of step, and its folds need
not lie where the cage's do.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from benchmarks.loose_garment import lowpass, vertex_area
from benchmarks.rows import say
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.fabric import PRESETS, Fabric
from physgraph_usd.solver.forces import body_terms, elastic_terms
from physgraph_usd.solver.forces.base import ForceModule
from physgraph_usd.solver.forces.tether import Tether
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.frame.settings import SolveSettings
from physgraph_usd.solver.integrate.base import System
from physgraph_usd.solver.integrate.metric import Metric
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.solve import Budget, solve_level
from physgraph_usd.solver.level import Level, build_levels, hinge_geometry, refine_garments
from physgraph_usd.solver.scene import Frame, Garment, GarmentFrame, Grain, Scene

GRAVITY = np.array([0.0, 0.0, -9.81])
RATE, INCREMENTS = 24.0, 2
STEPS = 40
"""Quasi-Newton steps an increment, at most."""
BANDS = (0.3, 0.15, 0.08, 0.04, 0.02)
"""Ends of the bands of wavelengths [m]."""
PATCH = 0.1
"""Wavelength over which directions and densities of folds are averaged [m]."""
FOLDED = 0.5
"""Part of the cloth that counts as folding: the half with the densest folds, in both."""
FABRICS = ("jersey", "silk", "denim")
Motion = Callable[[float], np.ndarray]


@dataclass(frozen=True, eq=False)
class Stage:
    """A sheet that hangs from what moves.

    Attributes:
        faces: Quads, shape (F, 4).
        flat: Its material coordinates [m], shape (V, 2).
        rest: Rest positions [m], shape (V, 3).
        held: Which vertices are moved, shape (V,), bool.
        motion: Positions of all vertices at a time [s], of which those held count.
    """

    faces: np.ndarray
    flat: np.ndarray
    rest: np.ndarray
    held: np.ndarray
    motion: Motion


def grid(columns: int, rows: int, *, closed: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Quads of a grid, shape (F, 4), and the places of its vertices from 0 to 1, shape (V, 2)."""
    across = columns if closed else columns + 1
    u, v = np.meshgrid(np.arange(across) / columns, np.arange(rows + 1) / rows)
    number = np.arange(across * (rows + 1)).reshape(rows + 1, across)
    right = np.roll(number, -1, axis=1)
    corners = np.stack([number[:-1], right[:-1], right[1:], number[1:]], axis=2)
    return corners[:, :columns].reshape(-1, 4), np.stack([u.ravel(), v.ravel()], axis=1)


def curtain() -> Stage:
    """A curtain of 1 x 1 m whose top is gathered to 70% and swayed."""
    faces, uv = grid(32, 32)
    rest = np.stack([uv[:, 0], 0.0 * uv[:, 0], -uv[:, 1]], axis=1)

    def motion(time: float) -> np.ndarray:
        gather, sway = 0.3 * min(time / 0.4, 1.0), 0.1 * np.sin(2.0 * np.pi * 0.8 * time)
        waves = 0.01 * np.sin(2.0 * np.pi * 5.0 * uv[:, 0]) * min(time / 0.4, 1.0)
        return rest * [1.0 - gather, 1.0, 1.0] + np.stack([0 * waves + 0.3 * gather, waves + sway, 0 * waves], axis=1)

    return Stage(faces, uv, rest, uv[:, 1] == 0.0, motion)


def sleeve() -> Stage:
    """A sleeve, 38 cm round and 40 cm long, whose lower end is twisted by a third of a turn and pushed up by 8%."""
    faces, uv = grid(36, 36, closed=True)
    angle = 2.0 * np.pi * uv[:, 0]
    rest = np.stack([0.06 * np.cos(angle), 0.06 * np.sin(angle), -0.4 * uv[:, 1]], axis=1)

    def motion(time: float) -> np.ndarray:
        part = min(time / 0.8, 1.0) * uv[:, 1]
        turned = angle + part * 2.0 * np.pi / 3.0
        height = -0.4 * uv[:, 1] + 0.032 * part
        return np.stack([0.06 * np.cos(turned), 0.06 * np.sin(turned), height], axis=1)

    return Stage(faces, uv * [0.377, 0.4], rest, (uv[:, 1] == 0.0) | (uv[:, 1] == 1.0), motion)


def skirt() -> Stage:
    """A flared skirt of 50 cm, its waist turned to and fro."""
    faces, uv = grid(60, 24, closed=True)
    angle, radius = 2.0 * np.pi * uv[:, 0], 0.13 + 0.22 * uv[:, 1]
    rest = np.stack([radius * np.cos(angle), radius * np.sin(angle), -0.45 * uv[:, 1]], axis=1)

    def motion(time: float) -> np.ndarray:
        turn = 0.8 * np.sin(2.0 * np.pi * 0.9 * time)
        c, s = np.cos(turn), np.sin(turn)
        return rest @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    return Stage(faces, uv * [1.5, 0.5], rest, uv[:, 1] == 0.0, motion)


def flag() -> Stage:
    """A flag of 90 x 60 cm whose pole is waved."""
    faces, uv = grid(36, 24)
    rest = np.stack([0.9 * uv[:, 0], 0.0 * uv[:, 0], -0.6 * uv[:, 1]], axis=1)

    def motion(time: float) -> np.ndarray:
        return rest + np.array([0.0, 0.25 * np.sin(2.0 * np.pi * time), 0.0])

    return Stage(faces, uv * [0.9, 0.6], rest, uv[:, 0] == 0.0, motion)


SCENES: dict[str, Callable[[], Stage]] = {"curtain": curtain, "sleeve": sleeve, "skirt": skirt, "flag": flag}


def garment_of(stage: Stage, level: int) -> Garment:
    """The stage's sheet as a garment, its warp hanging down."""
    garment = Garment.of("/Sheet", stage.faces, stage.rest, level=level)
    corners = stage.rest[stage.faces]
    down = corners[:, 3] - corners[:, 0]
    warp, one = down / np.linalg.norm(down, axis=1, keepdims=True), np.ones(len(stage.rest))
    return replace(garment, pin=stage.held.astype(float), grain=Grain(warp, one, 0.0 * one), self_contact=False)


def level_at(garment: Garment, subdivisions: int) -> Level:
    """The garment's sheet at a number of subdivisions, float32."""
    return build_levels([garment], refine_garments([garment], [subdivisions]))[-1]


def simulated(stage: Stage, fabric: Fabric, subdivisions: int, *, frames: int) -> Iterator[np.ndarray]:
    """Positions of each frame [m], shape (V, 3), of a simulation at a number of subdivisions, from rest."""
    level = level_at(garment_of(stage, subdivisions), subdivisions)
    terms = (
        *elastic_terms(level, [fabric], potential="continuum"),
        *body_terms(level, [fabric], gravity=GRAVITY, potential="continuum"),
    )
    h = 1.0 / (RATE * INCREMENTS)
    x = torch.as_tensor(level.from_coarse @ stage.rest).to(level.rest)
    inertia = Tether(level, torch.tensor([fabric.density]), h**-2, x.clone())
    module = ForceModule((*terms, inertia))
    metric = Metric(module.rest_matrix(), free=level.free, dtype=level.dtype)
    velocity, free = torch.zeros_like(x), level.free
    for frame in range(frames):
        for increment in range(INCREMENTS):
            time = (frame * INCREMENTS + increment + 1) * h
            moved = torch.as_tensor(level.from_coarse @ stage.motion(time)).to(x)
            inertia.aim(x + h * velocity, h**-2)
            start = torch.where(free, x + h * velocity, moved)
            system = System(ForceModule((*terms, inertia)), metric, free=free, spacing=level.spacing, level=level)
            after, _ = solve_level(system, QuasiNewton(), start, level=0, budget=Budget(STEPS, 1e-3))
            velocity, x = (after - x) / h, after
        yield x.double().numpy()


def refined(stage: Stage, fabric: Fabric, cages: Sequence[np.ndarray], subdivisions: int) -> list[np.ndarray]:
    """Positions of each frame [m], shape (V, 3), of the cages refined as a shot is."""
    refiner = Refiner(Scene((garment_of(stage, subdivisions),), GRAVITY), SolveSettings())
    states = (refiner.solve(Frame(float(n), (GarmentFrame(cage, fabric),))) for n, cage in enumerate(cages))
    return [points for state in states for points in state.points if points is not None]


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
        angle, _, _, length = hinge_geometry(x, self.level.hinges.numpy())
        return float(0.5 * (np.abs(angle) * length).sum())

    def amplitudes(self, x: np.ndarray) -> np.ndarray:
        """RMS of the positions' part of each band of wavelengths [m]; the last has all that is shorter."""
        area = vertex_area(self.level)
        smooth = [each(x) for each in lowpass(self.level, BANDS)] + [x]
        parts = [short - long for long, short in pairwise(smooth)]
        return np.array([np.sqrt((area[:, None] * part**2).sum() / area.sum()) for part in parts])

    def folds(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Density of folds [1/m] and the angle [rad] of the direction in which they bend, at each vertex."""
        hinges = self.level.hinges.numpy()
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


def jerk(frames: Sequence[np.ndarray], smooth: Sequence[np.ndarray]) -> float:
    """RMS second difference in time of the detail [m]."""
    detail = np.array(frames) - np.array(smooth)
    return float(np.sqrt((np.diff(detail, n=2, axis=0) ** 2).sum(axis=2).mean()))


def row_of(name: str, fabric: str, *, frames: int, subdivisions: int) -> tuple[str, list[np.ndarray]]:
    """A row of the table, and the last frame: the cage, Loop subdivision, refined and simulated [m]."""
    stage, values = SCENES[name](), PRESETS[fabric]
    cages = list(simulated(stage, values, 0, frames=frames))
    truth = list(simulated(stage, values, subdivisions, frames=frames))
    fine = refined(stage, values, cages, subdivisions)
    level = level_at(garment_of(stage, subdivisions), subdivisions)
    loop = [level.smooth_from_coarse @ cage for cage in cages]
    judge, late = Judge(level, level.from_coarse @ stage.flat), slice(frames // 2, None)
    curvature = [np.mean([judge.curvature(x) for x in each[late]]) for each in (loop, fine, truth)]
    bands = [np.mean([judge.amplitudes(x) for x in each[late]], axis=0) for each in (fine, truth)]
    angle, where = np.mean([judge.compared(x, y) for x, y in zip(fine[late][::4], truth[late][::4], strict=True)], 0)
    moves = jerk(fine[late], loop[late]) / jerk(truth[late], loop[late])
    cells = [f"{each:.2f}" for each in curvature] + [f"{curvature[1] / curvature[2]:.2f}"]
    cells += [f"{ratio:.2f}" for ratio in bands[0] / bands[1]] + [f"{angle:.0f}", f"{where:.2f}", f"{moves:.2f}"]
    return f"| {name} | {fabric} | {' | '.join(cells)} |", [cages[-1], loop[-1], fine[-1], truth[-1]]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=sorted(SCENES), default=list(SCENES))
    parser.add_argument("--fabrics", nargs="+", choices=sorted(PRESETS), default=list(FABRICS))
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--level", type=int, default=2, help="Subdivisions.")
    parser.add_argument("--save", type=Path, help="Folder for the last frames' positions, as .npz.")
    given = parser.parse_args()
    prepare_device("cpu")
    ends = [f"{1e3 * a:g}-{1e3 * b:g} mm" for a, b in pairwise(BANDS)]
    names = ["scene", "fabric", "Loop, m", "refined, m", "simulated, m", "refined / simulated", *ends]
    names += [f"under {1e3 * BANDS[-1]:g} mm", "angle, degrees", "where", "motion"]
    say(f"| {' | '.join(names)} |\n|{'---|' * len(names)}")
    for name in given.scenes:
        for fabric in given.fabrics:
            row, last = row_of(name, fabric, frames=given.frames, subdivisions=given.level)
            say(row)
            if given.save:
                given.save.mkdir(parents=True, exist_ok=True)
                keys = ("cage", "loop", "refined", "simulated")
                np.savez(given.save / f"{name}_{fabric}.npz", **dict(zip(keys, last, strict=True)))


if __name__ == "__main__":
    main()
