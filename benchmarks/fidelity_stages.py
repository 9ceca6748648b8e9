"""The sheets of `benchmarks.fidelity`: what they are, what holds them, and the bodies that they touch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from physgraph_usd.solver.colliders.pose import Pose
from physgraph_usd.solver.colliders.primitives import primitive
from physgraph_usd.usd.read.reader import open_shot

Motion = Callable[[float], np.ndarray]


@dataclass(frozen=True, eq=False)
class Body:
    """A capsule that moves, or a ball.

    Attributes:
        radius: [m].
        half: Half its length without caps [m]; 0 is a ball.
        ends: Its middle [m] and the direction of its axis, at a time [s].
    """

    radius: float
    half: float
    ends: Callable[[float], tuple[np.ndarray, np.ndarray]]

    @property
    def kind(self) -> str:
        """The collider's kind."""
        return "capsule" if self.half else "sphere"

    def place(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Its middle [m] and the matrix whose columns are its axes at a time [s], the third of them its own."""
        middle, axis = self.ends(time)
        side = np.cross([0.0, 1.0, 0.0], axis)
        side = side / np.linalg.norm(side)
        return middle, np.stack([side, np.cross(axis, side), axis], axis=1)

    def pose(self, time: float) -> Pose:
        """Its triangles at a time [s]."""
        middle, turn = self.place(time)
        return primitive(self.kind, np.array([self.radius, self.radius, self.half]), turn=turn, centre=middle)


@dataclass(frozen=True, eq=False)
class Skin:
    """A body that bends.

    Attributes:
        triangles: Shape (T, 3), int32.
        points: Positions of its vertices at a time [s].
    """

    triangles: np.ndarray
    points: Motion
    kind = "mesh"

    def pose(self, time: float) -> Pose:
        """Its triangles at a time [s]."""
        return Pose(self.points(time), self.triangles)


@dataclass(frozen=True, eq=False)
class Stage:
    """A sheet that hangs from what moves.

    Attributes:
        faces: Quads, shape (F, 4), whose fourth corner lies along the warp from the first; or triangles, shape (F, 3),
            whose warp hangs down.
        flat: Its material coordinates [m], shape (V, 2).
        rest: Rest positions [m], shape (V, 3).
        held: Which vertices are moved, shape (V,), bool.
        motion: Positions of all vertices at a time [s], of which those held count.
        bodies: What it touches.
        camera: Azimuth and elevation from which it is drawn [degrees].
    """

    faces: np.ndarray
    flat: np.ndarray
    rest: np.ndarray
    held: np.ndarray
    motion: Motion
    bodies: tuple[Body | Skin, ...] = ()
    camera: tuple[float, float] = (25.0, 8.0)

    @property
    def warp(self) -> np.ndarray:
        """Unit direction of the warp on each face, shape (F, 3); it need not lie in a triangle."""
        if self.faces.shape[1] == 3:
            return np.tile([0.0, 0.0, -1.0], (len(self.faces), 1))
        down = self.rest[self.faces[:, 3]] - self.rest[self.faces[:, 0]]
        return down / np.linalg.norm(down, axis=1, keepdims=True)


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


def ball() -> Stage:
    """A sheet of 80 x 80 cm that is laid over a ball of 36 cm and drawn over it by one side."""
    faces, uv = grid(28, 28)
    rest = np.stack([0.8 * uv[:, 0] - 0.5, 0.4 - 0.8 * uv[:, 1], 0.0 * uv[:, 0] + 0.005], axis=1)

    def motion(time: float) -> np.ndarray:
        return rest + np.array([0.3, 0.0, -0.25]) * min(time, 1.0)

    def ends(_: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([0.0, 0.0, -0.18]), np.array([0.0, 0.0, 1.0])

    return Stage(faces, 0.8 * uv, rest, uv[:, 0] == 1.0, motion, (Body(0.18, 0.0, ends),), (30.0, 22.0))


def elbow(degrees: float = 100.0) -> Stage:
    """A sleeve, 35 cm round and 40 cm long, held at the shoulder, on an arm that bends at the elbow by an angle."""
    faces, uv = grid(32, 36, closed=True)
    angle = 2.0 * np.pi * uv[:, 0]
    rest = np.stack([0.4 * uv[:, 1] - 0.2, 0.055 * np.cos(angle), 0.055 * np.sin(angle)], axis=1)

    def upper(_: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([-0.15, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])

    def lower(time: float) -> tuple[np.ndarray, np.ndarray]:
        turn = np.radians(degrees) * min(time / 0.7, 1.0)
        axis = np.array([np.cos(turn), 0.0, np.sin(turn)])
        return 0.15 * axis, axis

    arm = tuple(Body(0.042, 0.15, each) for each in (upper, lower))
    return Stage(faces, uv * [0.346, 0.4], rest, uv[:, 1] == 0.0, lambda _: rest, arm, (10.0, 12.0))


def dressed(file: str, garment: str, body: str) -> Stage:
    """A shot's garment on its body: it begins at rest as in the first frame, and its highest border is held as there.

    It is cut below that border: a waistband that is turned in rests flat and begins folded onto itself, so it springs
    open and tangles, each solver in its own way.

    Args:
        file: The shot, with Y up.
        garment: Prim path of the garment.
        body: Prim path of the body.
    """
    shot = open_shot(file, garments=(garment,), colliders=(body,))
    frames = [shot.frame(time) for time in shot.scene.times]
    shot.close()
    mesh, seconds, upright = shot.scene.garments[0].mesh, shot.scene.seconds, ([0, 2, 1], [1.0, -1.0, 1.0])
    cloth = np.array([each.garments[0].points for each in frames])[..., upright[0]] * upright[1]
    poses = [pose for each in frames for pose in each.colliders if pose is not None]
    skin = np.array([pose.points for pose in poses])[..., upright[0]] * upright[1]
    faces, height = np.asarray(mesh.indices).reshape(mesh.face_count, -1), cloth[0, :, 2]
    below = height < height[highest_border(faces, height)].min()
    kept, corners = np.unique(faces[below[faces].all(axis=1)], return_inverse=True)
    faces, cloth = corners.reshape(-1, faces.shape[1]), cloth[:, kept]

    def at(points: np.ndarray) -> Motion:
        def motion(time: float) -> np.ndarray:
            n, part = divmod(min(time / seconds, len(points) - 1.001), 1.0)
            return (1.0 - part) * points[int(n)] + part * points[int(n) + 1]

        return motion

    held = highest_border(faces, cloth[0, :, 2])
    return Stage(faces, cloth[0, :, :2], cloth[0], held, at(cloth), (Skin(poses[0].triangles, at(skin)),))


def highest_border(faces: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Which vertices are on the border that is highest on average, shape (V,), bool."""
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    found, uses = np.unique(sides, axis=0, return_counts=True)
    i, j = found[uses == 1].T
    count = len(height)
    _, part = connected_components(sp.coo_matrix((0.0 * i + 1.0, (i, j)), (count, count)), directed=False)
    mean = [height[part == part[each]].mean() for each in i]
    return part == part[i[np.argmax(mean)]]


SCENES: dict[str, Callable[[], Stage]] = {
    "curtain": curtain,
    "sleeve": sleeve,
    "skirt": skirt,
    "flag": flag,
    "ball": ball,
    "elbow": elbow,
}
"""Scenes by name."""
