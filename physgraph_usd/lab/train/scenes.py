"""Small moving scenes to train on, made from numbers alone: cloth on bodies, on itself, in layers, and free.

| kind | cloth | what moves |
|---|---|---|
| ball | a sheet over an ellipsoid, up to three sheets over one another | the ellipsoid rises into it and turns |
| tube | a sleeve about an arm | both bend at an elbow; the arm swells out and in |
| fold | a strip laid back over itself | its sides come nearer |
| free | a patch of `patches` | from one pose towards another |

No asset is read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ...solver.colliders.pose import Collider, Pose
from ...solver.fabric import Fabric
from ...solver.mesh.topology import PolygonMesh
from ...solver.scene import Frame, Garment, GarmentFrame, Scene
from ..samples.shapes import Solid, ellipsoid, lathe, quad_grid, rings
from .patches import PatchConfig, patch_of, posed

KINDS = ("ball", "tube", "fold", "free")
DOWN = np.array([0.0, 0.0, -9.81])
MOVES = (0.02, 0.5)
"""How far a body or a cage goes from frame to frame, in cage edges."""


@dataclass(frozen=True, eq=False)
class Moving:
    """A scene and some frames of it in order."""

    words: str
    scene: Scene
    frames: tuple[Frame, ...]


def moving_scene(rng: np.random.Generator, *, kind: str, frames: int, most_vertices: int) -> Moving:
    """A scene of a kind out of `KINDS`.

    Args:
        most_vertices: Number of fine vertices beyond which cloth has a single subdivision, not two.
    """
    if kind == "free":
        return _free(rng, frames, most_vertices)
    edge = 10 ** rng.uniform(-1.9, -1.4)
    faces, rest, cages, bodies = {"ball": _ball, "tube": _tube, "fold": _fold}[kind](rng, frames)
    mesh = PolygonMesh(np.full(len(faces), faces.shape[1]), faces.ravel(), len(rest))
    if rng.random() < 0.5:
        triangles = mesh.triangulate().triangles
        mesh = PolygonMesh(np.full(len(triangles), 3), triangles.ravel().astype(np.int64), len(rest))
    one, level = np.ones(len(rest)), 2 if len(rest) * 16 <= most_vertices and rng.random() < 0.6 else 1
    felt = (0,) if bodies else ()
    bent = bool(rng.random() < 0.3)
    garment = Garment("/Cloth", mesh, edge * rest, level, bent, one, one, one, one, 0.0 * one, felt)
    stretch, bend = 100.0 * 10 ** rng.normal(0.0, 0.5), 5e-6 * 10 ** rng.normal(0.0, 0.5)
    fabric, guide = Fabric(stretch, bend, rng.uniform(0.08, 0.5)), 2000.0 * 10 ** rng.uniform(-0.5, 0.5)
    turn = Rotation.random(random_state=rng).as_matrix() if kind == "tube" else np.eye(3)
    colliders = (Collider("/Body", "mesh"),) if bodies else ()
    made = []
    for number, cage in enumerate(cages):
        pose = (Pose(edge * bodies[number].points @ turn.T, _triangles(bodies[0])),) if bodies else ()
        points = GarmentFrame(edge * cage @ turn.T, fabric, guide, offset=min(0.002, 0.2 * edge))
        made.append(Frame(float(number), (points,), pose))
    times = tuple(float(number) for number in range(frames))
    return Moving(f"{kind}, {level} levels", Scene((garment,), DOWN, times, colliders), tuple(made))


Motion = tuple[np.ndarray, np.ndarray, list[np.ndarray], list[Solid]]
"""Faces, rest shape, cage of each frame, and body of each frame or none; lengths in cage edges."""


def _ball(rng: np.random.Generator, frames: int) -> Motion:
    cells = int(rng.integers(7, 12))
    line = np.arange(cells + 1.0) - 0.5 * cells
    x, y = (coordinate.ravel() for coordinate in np.meshgrid(line, line))
    x, y = x + rng.uniform(-0.15, 0.15, x.shape), y + rng.uniform(-0.15, 0.15, y.shape)
    axes = cells * rng.uniform(0.25, 0.45, 3)
    sheets, gap = int(rng.integers(1, 4)), rng.uniform(0.08, 0.25)
    faces = quad_grid(cells + 1, cells + 1)
    faces = np.concatenate([faces + number * len(x) for number in range(sheets)])
    rest = np.concatenate([np.stack([x, y, 0.0 * x + number * gap], axis=1) for number in range(sheets)])
    height, rise = axes[2] * rng.uniform(0.3, 0.95), 10 ** rng.uniform(*np.log10(MOVES))
    spin, wave = rng.normal(0.0, 0.1), 0.3 * rng.normal(size=3)
    phase, press = rng.uniform(0.0, 6.0), rng.uniform(-0.15, 0.2)
    cages, bodies = [], []
    for number in range(frames):
        turn = Rotation.from_rotvec([0.0, 0.0, spin * number]).as_matrix()
        low = rest + np.array([0.0, 0.0, height - rise * number])
        low = low + 0.3 * np.sin(low[:, :2] @ wave[:2] + phase + 0.3 * number)[:, None] * [0.0, 0.0, 1.0]
        out = low @ turn / (axes + 0.1 + gap * np.repeat(np.arange(sheets), len(x))[:, None])
        size = np.linalg.norm(out, axis=1, keepdims=True)
        cages.append(low * np.maximum(1.0 / size, 1.0))
        ball = ellipsoid(axes + press, np.zeros(3), (28, 18))
        bodies.append(replace(ball, points=ball.points[:, [0, 2, 1]] * [1.0, -1.0, 1.0] @ turn.T))
    return faces, rest, cages, bodies


def _tube(rng: np.random.Generator, frames: int) -> Motion:
    around, rows = int(rng.integers(10, 16)), int(rng.integers(8, 14))
    radius = around / (2.0 * np.pi)
    angle = 2.0 * np.pi * np.arange(around) / around
    along = np.repeat(np.arange(rows + 1.0) - 0.5 * rows, around)
    ring = np.tile(np.stack([np.cos(angle), np.sin(angle)], axis=1), (rows + 1, 1))
    wide = radius * (1.0 + rng.uniform(-0.03, 0.03) * along)
    rest = np.stack([wide * ring[:, 0], along, -wide * ring[:, 1]], axis=1)
    squeeze, bend = rng.uniform(0.8, 1.02), rng.uniform(0.0, 1.6)
    move = 10 ** rng.uniform(*np.log10(MOVES)) / rows
    thin, swell, waves = rng.uniform(0.75, 0.98), rng.uniform(0.0, 0.2), rng.uniform(0.2, 0.8)
    faces = quad_grid(rows + 1, around, closed=True)
    height = np.linspace(-0.6 * rows, 0.6 * rows, 30)[::-1]
    cages, bodies = [], []
    for number in range(frames):
        bulge = thin + swell * np.sin(waves * height + 0.2 * number)
        arm = lathe(
            rings(radius * bulge, height, radius * bulge, 24),
            np.array([[0.0, height[0] + 0.5, 0.0], [0.0, height[-1] - 0.5, 0.0]]),
        )
        turn = bend + move * number
        cages.append(_bent(rest * [1.0, squeeze, 1.0], turn, radius))
        bodies.append(replace(arm, points=_bent(arm.points, turn, radius)))
    return faces, rest, cages, bodies


def _bent(points: np.ndarray, turn: float, radius: float) -> np.ndarray:
    """Skinned about the z axis over a band of a radius to either side of the middle."""
    weight = np.clip(0.5 + 0.5 * points[:, 1:2] / radius, 0.0, 1.0)
    return (1.0 - weight) * points + weight * Rotation.from_rotvec([0.0, 0.0, turn]).apply(points)


def _fold(rng: np.random.Generator, frames: int) -> Motion:
    length, width = int(rng.integers(12, 18)), int(rng.integers(5, 9))
    x, y = (coordinate.ravel() for coordinate in np.meshgrid(np.arange(length + 1.0), np.arange(width + 1.0)))
    faces, rest = quad_grid(width + 1, length + 1), np.stack([x, y, 0.0 * x], axis=1)
    first, last = sorted(rng.uniform(0.05, 0.8, 2))[::-1]
    middle, wave = length * rng.uniform(0.3, 0.5), 0.15 * rng.normal(size=2)
    cages = []
    for number in range(frames):
        gap = first + (last - first) * number / max(frames - 1, 1)
        past = x - middle
        turn = (2.0 * past / gap).clip(0.0, np.pi)
        back = (past - 0.5 * np.pi * gap).clip(0.0)
        u = np.where(past > 0.0, middle + 0.5 * gap * np.sin(turn) - back, x)
        z = 0.5 * gap * (1.0 - np.cos(turn)) + wave[0] * np.sin(0.8 * u + 0.1 * number) + wave[1] * np.cos(0.9 * y)
        cages.append(np.stack([u, y, z], axis=1))
    return faces, rest, cages, []


def _free(rng: np.random.Generator, frames: int, most_vertices: int) -> Moving:
    """A patch moving from a random pose towards a second pose."""
    config = PatchConfig(levels=(1, 2), most_vertices=most_vertices, skinned=0.3, pulled=0.2)
    patch = patch_of(config, rng)
    goal = posed(patch.garment.rest, rng, config)
    goal = goal - goal.mean(axis=0)
    apart = np.linalg.norm(goal - patch.frame.points, axis=1).mean()
    corners = patch.garment.mesh.indices[:2]
    edge = float(np.linalg.norm(np.diff(patch.garment.rest[corners], axis=0)))
    share = edge * 10 ** rng.uniform(*np.log10(MOVES)) / max(apart, 1e-9)
    points = [patch.frame.points + min(share * number, 1.0) * (goal - patch.frame.points) for number in range(frames)]
    made = tuple(Frame(float(n), (replace(patch.frame, points=cage),)) for n, cage in enumerate(points))
    times = tuple(float(number) for number in range(frames))
    return Moving(f"free {patch.words}", Scene((patch.garment,), patch.gravity, times), made)


def _triangles(solid: Solid) -> np.ndarray:
    return PolygonMesh(solid.counts, solid.indices, len(solid.points)).triangulate().triangles.astype(np.int32)
