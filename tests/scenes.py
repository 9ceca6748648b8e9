"""Eight scenes that all tests of contact share: garments, bodies and a few frames each, without a stage.

A refined scene is solved once in a process and must not be changed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import igl
import numpy as np
import torch
import trimesh
from bodies import BodyMesh, ball, together, tube
from cloth import DOWN, Answer, Solver, settings_of
from folds import EDGE, Cloth, folded, frame_with, named, square, strip
from meshes import mesh_of, quads_of

from physgraph_usd.solver.colliders.pose import Collider
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.level import refine_garments
from physgraph_usd.solver.mesh.subdivide import Refinement
from physgraph_usd.solver.scene import Frame, Garment, Scene


@dataclass(frozen=True)
class Shot:
    """A scene of garments and bodies that all of them feel, its frames, and whether its cages cross in some."""

    scene: Scene
    frames: tuple[Frame, ...]
    crossed: bool = False

    def refiner(
        self, *, level: int = 1, dtype: torch.dtype = torch.float32, threads: int = 1, **options: Any
    ) -> Solver:
        levels = [level] * len(self.scene.garments)
        return Solver(Refiner(self.scene, settings_of(**options), levels=levels, dtype=dtype, threads=threads))


def shot(garments: Sequence[Garment], cages: Sequence[Sequence[np.ndarray]], bodies: Sequence[BodyMesh] = ()) -> Shot:
    """A shot of garments, their cages in each frame [m] and, where there is one, a body in each frame."""
    colliders = (Collider("/World/Body", "mesh"),) if bodies else ()
    felt = tuple(replace(garment, colliders=tuple(range(len(colliders)))) for garment in garments)
    poses = [[body] for body in bodies] or [[] for _ in cages]
    frames = [
        frame_with(each, *pose, time=float(time)) for time, (each, pose) in enumerate(zip(cages, poses, strict=True))
    ]
    return Shot(Scene(felt, DOWN, tuple(map(float, range(len(frames)))), colliders), tuple(frames))


def sheet() -> Shot:
    """A curtain that is pinned along a side, pressed together and waved."""
    cloth = square(8, edge=0.5 * EDGE)
    x, z = cloth[1][:, 0], cloth[1][:, 2]
    cages = [
        [np.stack([(1 - 0.04 * t) * x, 0.01 * np.sin(30.0 * x + 10.0 * z + 0.2 * t), z], axis=1)] for t in (1, 2, 3)
    ]
    return shot([named(cloth, pin=(z < z.min() + 1e-9) * 1.0)], cages)


def fold() -> Shot:
    """A strip laid back over itself, its sides ever nearer to one another."""
    cloth = strip(12, 4)
    return shot([named(cloth)], [[folded(cloth[1], gap)] for gap in (0.02, 0.008, 0.004)])


def layers() -> Shot:
    """Three sheets over one another, from the inside out, on a ball that rises into them."""
    cloth = square(6)
    garments = [named(cloth, name) for name in "ABC"]
    cages = [[cloth[1] + [0.003 * number, 0.15 + 0.004 * number, 0.0] for number in range(3)]] * 3
    return shot(garments, cages, [ball(0.14, at=(0.0, lift, 0.0)) for lift in (0.0, 0.01, 0.02)])


def on_ball() -> Shot:
    """A sheet on a ball that turns and comes up into it."""
    cloth = square(8)
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    points, faces = ball(0.15, level=4)
    bodies = [(points @ np.linalg.matrix_power(turn, t) + [0.0, 0.01 * t, 0.0], faces) for t in range(3)]
    return shot([named(cloth)], [[cloth[1] + [0.0, 0.149, 0.0]]] * 3, bodies)


def sleeve(around: int = 12, rows: int = 8, *, edge: float = 0.03) -> Cloth:
    """An open tube of cloth about z, 12 cm wide."""
    angle = 2 * np.pi * np.arange(around) / around
    ring = 0.06 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points = np.concatenate([ring + np.array([0.0, 0.0, edge * (row - 0.5 * rows)]) for row in range(rows + 1)])
    quads = quads_of(around, rows + 1, closed=True)
    return mesh_of(quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).tolist()), points


def in_tube() -> Shot:
    """A sleeve about a closed arm that is wider in the middle from frame to frame."""
    cloth, arm = sleeve(), closed_tube()
    bulge = np.exp(-((arm[0][:, 2:] / 0.06) ** 2)) * [1.0, 1.0, 0.0]
    return shot(
        [named(cloth, bent_rest=True)], [[cloth[1]]] * 3, [(arm[0] * (1 + b * bulge), arm[1]) for b in (0, 0.1, 0.2)]
    )


def closed_tube() -> BodyMesh:
    """An arm of 11 cm about z with its ends closed, wound outward."""
    points, faces = tube(0.055, 0.4)
    middle = np.array([[0.0, 0.0, -0.2], [0.0, 0.0, 0.2]])
    first, last = np.arange(32), np.arange(len(points) - 32, len(points))
    caps = [np.stack([np.full(32, len(points)), np.roll(first, -1), first], axis=1)]
    caps += [np.stack([np.full(32, len(points) + 1), last, np.roll(last, -1)], axis=1)]
    return np.concatenate([points, middle]), np.concatenate([faces, *caps]).astype(np.int32)


def armpit() -> Shot:
    """A sheet between two balls of one body that close on it until there is less room than it is thick."""
    cloth = square(8)
    one = ball(0.05)
    gaps = (0.02, 0.005, 0.0005)
    sides = [np.array([0.0, 0.05 + 0.5 * gap, 0.0]) for gap in gaps]
    return shot([named(cloth)], [[cloth[1]]] * 3, [together((one[0] + s, one[1]), (one[0] - s, one[1])) for s in sides])


def torus() -> Shot:
    """A sheet pulled down through a ring that swells into it."""
    cloth = square(8)
    made = [trimesh.creation.torus(0.14, thick, major_sections=48, minor_sections=24) for thick in (0.05, 0.056, 0.06)]
    rings = [(np.asarray(m.vertices)[:, [0, 2, 1]], np.asarray(m.faces, np.int32)[:, ::-1]) for m in made]
    return shot([named(cloth)], [[_pulled(cloth[1], depth)] for depth in (0.0, 0.06, 0.12)], rings)


def _pulled(rest: np.ndarray, depth: float) -> np.ndarray:
    """A sheet whose middle is drawn down: a rounded funnel, the rest drawn inwards."""
    radius = np.linalg.norm(rest[:, [0, 2]], axis=1)
    drawn = np.maximum(radius - depth * np.clip(1.2 - radius / 0.3, 0.0, 1.0), 0.25 * radius)
    out = rest * [1.0, 0.0, 1.0] * (drawn / np.maximum(radius, 1e-9))[:, None]
    out[:, 1] = 0.055 - (depth + 0.05) / (1.0 + (drawn / 0.045) ** 4) * min(1.0, 20 * depth)
    return out


def tangle() -> Shot:
    """A sheet whose corner is through another one, and goes deeper."""
    one, other = square(8, edge=0.5 * EDGE), square(7, edge=0.5 * EDGE)
    upper = other[1] + [0.0037, 0.0, 0.0051]
    down = (0.5 * (upper[:, 0] + upper[:, 2] - 0.06)).clip(0.0)
    cages = [[one[1], upper + np.outer(0.015 - s * down, [0.0, 1.0, 0.0])] for s in (1.4, 1.5, 1.6)]
    return replace(shot([named(one, "A"), named(other, "B")], cages), crossed=True)


SCENES = {
    "sheet": sheet,
    "fold": fold,
    "layers": layers,
    "ball": on_ball,
    "tube": in_tube,
    "armpit": armpit,
    "torus": torus,
    "tangle": tangle,
}
BODIES = ("layers", "ball", "tube", "armpit", "torus")
"""Scenes with a body."""


@cache
def shot_of(name: str) -> Shot:
    return SCENES[name]()


@cache
def refined(name: str) -> tuple[Answer, ...]:
    """All frames of a scene, solved in order at level 1."""
    made = shot_of(name)
    return tuple(made.refiner().refine(made.frames))


def upsampled(name: str, frame: int, level: int = 1) -> list[np.ndarray]:
    """The cages of a frame, placed linearly at a level [m]."""
    cages = shot_of(name).frames[frame].garments
    return [steps[-1].linear @ cage.points for steps, cage in zip(_steps(name, level), cages, strict=True)]


def triangles(name: str, level: int = 1) -> list[np.ndarray]:
    return [steps[-1].mesh.triangulate().triangles.astype(np.int64) for steps in _steps(name, level)]


@cache
def _steps(name: str, level: int) -> list[tuple[Refinement, ...]]:
    garments = shot_of(name).scene.garments
    return refine_garments(garments, [level] * len(garments))


def soup_of(points: Sequence[np.ndarray], faces: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0, *map(len, points)])
    return np.concatenate(points), np.concatenate([each + start for each, start in zip(faces, starts, strict=False)])


def inside(name: str, frame: int, points: Sequence[np.ndarray], *, deeper: float = 0.0) -> np.ndarray:
    """Which vertices of all garments are inside a body by more than a distance [m], by libigl."""
    made, x = shot_of(name), np.concatenate(points)
    found = np.zeros(len(x), bool)
    for pose in made.frames[frame].colliders:
        assert pose is not None
        winding = igl.SIGNED_DISTANCE_TYPE_WINDING_NUMBER
        faces = pose.triangles.astype(np.int64)
        found |= np.asarray(igl.signed_distance(x, pose.points, faces, sign_type=winding)[0]) < -deeper
    return found
