"""Patches of cloth to train on, made from numbers alone: shapes, meshes, fabrics, borders and poses at random.

A patch is a sheet, a tube or a dome of 6 to 12 cage edges, irregular or in quads whose diagonals alternate. It is posed
by a smooth random deformation, and some patches are draped first: our own solver lets the cage hang from what is fixed.
No asset is read.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from ...shot.solve import prepare_device
from ...solver.fabric import Fabric
from ...solver.frame.group import Group
from ...solver.frame.settings import SolveSettings
from ...solver.integrate import METHODS
from ...solver.integrate.base import System
from ...solver.integrate.descend import solve_level
from ...solver.integrate.quasi_newton import QuasiNewton
from ...solver.integrate.saddle import leave_saddle
from ...solver.integrate.stop import Budget
from ...solver.level import refine_garments
from ...solver.mesh.topology import PolygonMesh, edges_of
from ...solver.scene import Garment, GarmentFrame
from ..samples.shapes import quad_grid

T = TypeVar("T")
BORDERS = ("fixed", "one side", "free")
DECADES = 3.0
"""Range of the stiffnesses in powers of ten; two thirds of them lie in the middle half."""


@dataclass(frozen=True)
class PatchConfig:
    """Values of generated patches.

    Attributes:
        levels: Least and most subdivisions.
        edges: Least and most cage edges along a side.
        elastic: Stretch and bending only, the border fixed, as in the paper; else gravity and guide too.
        most_vertices: Number of finest vertices beyond which a patch loses a level.
        reference_steps: Quasi-Newton steps a level behind the least energy known.
        skinned: Fraction of the poses that are bent as linear blend skinning bends, sharply and losing length.
        pulled: Fraction of poses stretched along a single direction.
    """

    count: int = 64
    levels: tuple[int, int] = (1, 3)
    edges: tuple[int, int] = (6, 12)
    elastic: bool = False
    most_vertices: int = 4000
    reference_steps: int = 150
    skinned: float = 0.0
    pulled: float = 0.0


@dataclass(eq=False)
class Patch:
    """A patch in a pose, on the CPU.

    Attributes:
        frame: Pose about the origin, and fabric.
        gravity: [m/s^2], shape (3,).
        words: Shape, mesh, border and levels in words.
        raw: Upsampled cage at each level [m], float32; a flat one, a saddle of the energy, is bent a little.
        start: Energy without leaving the saddle [J].
        least: Least energy known at each level [J].
        solved: Positions after some steps of nested quasi-Newton at each level [m], float32.
    """

    garment: Garment
    frame: GarmentFrame
    gravity: np.ndarray
    words: str
    raw: list[np.ndarray] = field(default_factory=list)
    start: list[float] = field(default_factory=list)
    least: list[float] = field(default_factory=list)
    solved: list[np.ndarray] = field(default_factory=list)

    @property
    def level(self) -> int:
        """Subdivisions of the cage."""
        return self.garment.level

    @cached_property
    def group(self) -> Group:
        """The solver's levels."""
        return group_of([self.garment], self.gravity, self.level)

    @cached_property
    def systems(self) -> list[System]:
        """A system per level, cage first."""
        return self.group.systems([self.frame])[0]

    def __getstate__(self) -> dict[str, Any]:
        """The fields without `group` and `systems`: they hold kernels, and are made on demand."""
        return {name: value for name, value in self.__dict__.items() if name not in ("group", "systems")}


def make_patches(config: PatchConfig, *, seed: int, workers: int = 1) -> list[Patch]:
    """Make patches, the same for a seed with any number of processes; those whose pose is near rest are made again."""
    return made_of_numbers(_numbered, config, seed, config.count, workers=workers)


def made_of_numbers(make: Callable[[Any, int, int], T], config: Any, seed: int, count: int, *, workers: int) -> list[T]:
    """Results of a function for a configuration, a seed and each number below a count, made in some processes."""
    jobs = [(config, seed, number) for number in range(count)]
    if workers <= 1 or len(jobs) < 2 * workers:
        return [make(*job) for job in jobs]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=prepare_device, initargs=("cpu",)) as pool:
        return list(pool.map(make, *zip(*jobs, strict=True)))


def _measure(patch: Patch, steps: int, *, presolve: int) -> None:
    """Find the energies between which a patch's levels move, by nested quasi-Newton of so many steps a level.

    The positions of a second, shorter solve of ``presolve`` steps a level are starts for training.
    """
    coarse = patch.group.systems([patch.frame])[1]
    x = short = coarse
    for index, (level, system) in enumerate(zip(patch.group.levels, patch.systems, strict=True)):
        upsampled = level.base.apply(coarse)
        raw = leave_saddle(system, level, upsampled, outward=torch.ones(1))
        x, short = (raw, raw) if level.from_below is None else map(level.from_below.apply, (x, short))
        x, report = solve_level(system, QuasiNewton(), x, level=index, budget=Budget(steps))
        short, _ = solve_level(system, QuasiNewton(), short, level=index, budget=Budget(presolve))
        patch.raw.append(raw.numpy())
        patch.start.append(system.energy_and_force(upsampled)[0])
        patch.least.append(report.energy_after)
        patch.solved.append(short.numpy())


def _numbered(config: PatchConfig, seed: int, number: int) -> Patch:
    rng = np.random.default_rng([seed, number])
    while True:
        patch = patch_of(config, rng)
        _measure(patch, config.reference_steps, presolve=int(rng.choice([5, 10, 20, 40])))
        drop = [a - b for a, b in zip(patch.start, patch.least, strict=True)]
        if all(np.isfinite(drop)) and min(drop) > 1e-3 * abs(patch.start[-1]) + 1e-12:
            patch.__dict__ = patch.__getstate__()
            return patch


def group_of(garments: Sequence[Garment], gravity: np.ndarray, level: int, *, device: str = "cpu") -> Group:
    """The levels of garments with equal numbers of subdivisions, under a gravity [m/s^2]."""
    chains, settings = refine_garments(garments, [level] * len(garments)), SolveSettings(METHODS["quasi-newton"])
    return Group.of(garments, chains, gravity, settings, dtype=torch.float32, device=device)


def patch_of(config: PatchConfig, rng: np.random.Generator) -> Patch:
    """A patch in a random pose, its energies not yet measured."""
    mesh, flat, closed = _mesh(config, rng)
    shape = "tube" if closed else str(rng.choice(["sheet", "dome"]))
    edge = 10 ** rng.uniform(-2.3, -1.3)
    rest = edge * _rolled(flat, shape, rng)
    border = "fixed" if config.elastic else str(rng.choice(BORDERS, p=(0.25, 0.25, 0.5)))
    pin = _pinned(mesh, flat, border)
    fabric, guide, gravity = _material(config, rng, free=border == "free")
    one = np.ones(len(rest))
    levels = int(rng.integers(config.levels[0], config.levels[1] + 1))
    while levels > 1 and len(rest) * 4**levels > config.most_vertices:
        levels -= 1
    garment = Garment("/Patch", mesh, rest, levels, bool(rng.random() < 0.3), one, one, one, one, pin)
    points = posed(rest, rng, config)
    if rng.random() < 0.5 and pin.any():  # some steps of our own solver, softer than the cloth: it folds as a cage does
        soft = GarmentFrame(points, replace(fabric, bend=100.0 * fabric.bend), 0.1 * guide)
        systems, x = group_of([garment], gravity, 0).systems([soft])
        x, _ = solve_level(systems[0], QuasiNewton(), x, level=0, budget=Budget(int(rng.integers(2, 20))))
        points = x.double().numpy()
    frame = GarmentFrame(points - points.mean(axis=0), fabric, guide)
    words = f"{shape}, {'quads' if not mesh.is_triangles else 'triangles'}, border {border}, levels {levels}"
    return Patch(garment, frame, gravity, words)


def _mesh(config: PatchConfig, rng: np.random.Generator) -> tuple[PolygonMesh, np.ndarray, bool]:
    """A cage in the plane, in cage edges: topology, points of shape (V, 2), and whether its sides are joined."""
    columns, rows = (int(n) for n in rng.integers(config.edges[0], config.edges[1] + 1, 2))
    closed = rng.random() < 0.35
    if closed or rng.random() < 0.4:
        return (*_quads(columns, rows, rng, closed=closed), closed)
    points = np.stack(np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0)), axis=2).reshape(-1, 2)
    points[:, 0] += 0.5 * (points[:, 1] % 2)
    points[:, 1] *= np.sqrt(0.75)
    points += rng.uniform(-0.3, 0.3, points.shape) * rng.random()
    triangles = Delaunay(points).simplices
    a, b, c = (points[triangles[:, i]] for i in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    longest = np.max([np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    triangles = np.where((area < 0)[:, None], triangles[:, ::-1], triangles)[(np.abs(area) > 0.15) & (longest < 2.2)]
    used, corners = np.unique(triangles, return_inverse=True)
    return PolygonMesh(np.full(len(triangles), 3), corners.reshape(-1), len(used)), points[used], False


def _quads(columns: int, rows: int, rng: np.random.Generator, *, closed: bool) -> tuple[PolygonMesh, np.ndarray]:
    """A grid of quads, or of triangles with alternating diagonals; joined to a tube if closed."""
    columns = max(columns, 8) if closed else columns
    width = columns if closed else columns + 1
    v, u = np.meshgrid(np.arange(rows + 1.0), np.arange(float(width)), indexing="ij")
    cell_v, cell_u = np.divmod(np.arange(rows * columns), columns)
    quads = quad_grid(rows + 1, width, closed=closed).astype(np.int64)
    points = np.stack([u.ravel(), v.ravel()], axis=1)
    if rng.random() < 0.5:
        return PolygonMesh(np.full(len(quads), 4), quads.reshape(-1), len(points)), points
    turned = (cell_u + cell_v) % 2 == 1
    quads[turned] = np.roll(quads[turned], 1, axis=1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return PolygonMesh(np.full(len(triangles), 3), triangles.reshape(-1), len(points)), points


def _rolled(flat: np.ndarray, shape: str, rng: np.random.Generator) -> np.ndarray:
    u, v = flat.T
    if shape == "tube":
        columns = u.max() + 1.0
        radius = columns / (2 * np.pi) * (1.0 + rng.uniform(-0.03, 0.03) * (v - v.mean()))
        angle = 2 * np.pi * u / columns
        return np.stack([radius * np.cos(angle), v, -radius * np.sin(angle)], axis=1)
    centre, size = flat.mean(axis=0), np.ptp(flat, axis=0).max()
    height = 0.0 if shape == "sheet" else rng.uniform(0.05, 0.3)
    square = ((flat - centre) ** 2).sum(axis=1)
    return np.stack([u, v, -height * square / size], axis=1)


def posed(rest: np.ndarray, rng: np.random.Generator, config: PatchConfig) -> np.ndarray:
    """Squeezed or pulled, sheared, twisted, bent, waved and skinned at random, then turned anywhere."""
    centre, size = rest.mean(axis=0), float(np.ptp(rest, axis=0).max())
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    x = (rest - centre) @ frame / size
    squeeze = 1.0 + np.array([-rng.uniform(0.03, 0.3), rng.uniform(-0.15, 0.03), rng.uniform(-0.15, 0.03)])
    if config.pulled and rng.random() < config.pulled:
        squeeze[0] = rng.uniform(1.0, 1.3)
    x = x * squeeze[rng.permutation(3)]
    x[:, 0] += rng.normal(0.0, 0.08) * x[:, 1]
    turn = rng.normal(0.0, 0.7) * x[:, 1]
    cosine, sine = np.cos(turn), np.sin(turn)
    x = np.stack([cosine * x[:, 0] - sine * x[:, 2], x[:, 1], sine * x[:, 0] + cosine * x[:, 2]], axis=1)
    x[:, 2] += rng.normal(0.0, 0.3) * x[:, 1] ** 2
    for _ in range(int(rng.integers(1, 5))):
        direction, offset = rng.normal(size=3), rng.uniform(0, 2 * np.pi)
        wave = np.pi * rng.uniform(1.0, 4.0) * direction / np.linalg.norm(direction)
        amplitude = rng.normal(size=3) * 0.03 * np.pi / np.linalg.norm(wave) * rng.random()
        x += np.sin(x @ wave + offset)[:, None] * amplitude
    x += rng.normal(size=x.shape) * 0.1 * rng.random() ** 2 / np.sqrt(len(x))
    if config.skinned and rng.random() < config.skinned:
        x = _skinned(x, rng)
    return x @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T * size


def _skinned(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Bent about an axis by the mean of two poses, with weights that change over a narrow band; sizes are about 1."""
    axis, across = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    pivot = x[rng.integers(len(x))]
    weight = np.clip((x - pivot) @ across / rng.uniform(0.1, 0.5) + 0.5, 0.0, 1.0)[:, None]
    turn = Rotation.from_rotvec(rng.uniform(0.5, 2.0) * axis)
    return (1.0 - weight) * x + weight * (turn.apply(x - pivot) + pivot)


def _pinned(mesh: PolygonMesh, flat: np.ndarray, border: str) -> np.ndarray:
    pin = np.zeros(mesh.vertex_count)
    edges = edges_of(mesh.triangulate().triangles, mesh.vertex_count)
    rim = np.unique(edges.vertices[edges.face_count == 1])
    if border == "fixed":
        pin[rim] = 1.0
    elif border == "one side":
        pin[rim[flat[rim, 1] > flat[:, 1].max() - 0.5]] = 1.0
    return pin


def _material(config: PatchConfig, rng: np.random.Generator, *, free: bool) -> tuple[Fabric, float, np.ndarray]:
    half = 0.5 * DECADES
    stretch, bend = (m * 10 ** float(np.clip(rng.normal(0.0, 0.5 * half), -half, half)) for m in (100.0, 5e-6))
    # Poses are turned anywhere, so one direction of gravity is enough.
    down = np.array([0.0, 0.0, -9.81]) * (0.0 if config.elastic else float(rng.random() < 0.7))
    guide = 2000.0 * 10 ** rng.uniform(-0.7, 0.7) if free or rng.random() < 0.8 else 0.0
    return Fabric(stretch, bend, rng.uniform(0.08, 0.6)), 0.0 if config.elastic else guide, down


def describe(patches: Sequence[Patch]) -> list[str]:
    """A line per patch."""
    return [f"{p.words}, {p.group.levels[-1].vertex_count} vertices" for p in patches]
