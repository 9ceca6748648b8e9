"""Small bodies for contact tests, and distances to them by another library."""

import igl
import numpy as np
import torch
import trimesh
from meshes import quads_of

from physgraph_usd.solver.colliders.mesh import MeshBody, MeshSurface
from physgraph_usd.solver.colliders.pose import Pose

BodyMesh = tuple[np.ndarray, np.ndarray]
"""Points, shape (V, 3), and triangles, shape (T, 3)."""


def ball(radius: float = 0.2, *, level: int = 3, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> BodyMesh:
    """A closed sphere wound outward."""
    mesh = trimesh.creation.icosphere(subdivisions=level, radius=radius)
    return np.asarray(mesh.vertices) + np.array(at), np.asarray(mesh.faces, np.int32)


def box(size: tuple[float, float, float] = (0.2, 0.2, 0.2)) -> BodyMesh:
    """A closed box of twelve triangles about the origin."""
    mesh = trimesh.creation.box(size)
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)


def tube(radius: float = 0.1, length: float = 0.4, *, around: int = 32, rows: int = 9) -> BodyMesh:
    """An open tube about z, wound outward."""
    a = 2 * np.pi * np.arange(around) / around
    z = np.linspace(-0.5 * length, 0.5 * length, rows)
    points = np.array([[radius * np.cos(t), radius * np.sin(t), h] for h in z for t in a])
    return points, halved(quads_of(around, rows, closed=True))


def halved(quads: np.ndarray) -> np.ndarray:
    """Each quad cut into two triangles, shape (2 F, 3)."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def pane(size: float = 1.0, cells: int = 4) -> BodyMesh:
    """An open level square at height zero whose front is up."""
    ticks = np.linspace(-0.5 * size, 0.5 * size, cells + 1)
    z, x = np.meshgrid(ticks, ticks)
    return np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1), halved(quads_of(cells + 1, cells + 1))


def together(*bodies: BodyMesh) -> BodyMesh:
    """Several bodies as one mesh."""
    starts = np.cumsum([0, *(len(points) for points, _ in bodies)])
    faces = [triangles + start for (_, triangles), start in zip(bodies, starts, strict=False)]
    return np.concatenate([points for points, _ in bodies]), np.concatenate(faces).astype(np.int32)


def flipped(body: BodyMesh, part: float = 1.0, seed: int = 0) -> BodyMesh:
    """The same body with some or all of its faces turned."""
    points, triangles = body
    turned = triangles.copy()
    which = np.random.default_rng(seed).random(len(triangles)) < part
    turned[which] = turned[which][:, ::-1]
    return points, turned


def split(body: BodyMesh) -> BodyMesh:
    """The same body with three vertices of its own for each face, as exporters split them at seams."""
    points, triangles = body
    return points[triangles.ravel()], np.arange(triangles.size, dtype=np.int32).reshape(-1, 3)


def surfaces(body: BodyMesh, side: str = "auto") -> tuple[MeshSurface, ...]:
    """The closed and the open part, posed."""
    return MeshBody(side=side, device="cpu", threads=1).pose(Pose(*body))


def signed(surface: MeshSurface, x: np.ndarray) -> np.ndarray:
    """Distances of world positions from a surface [m], negative inside or on the disallowed side."""
    at = torch.as_tensor(x - surface.origin)
    found = surface.closest(at, endless(len(x)))
    wrong = surface.inside(at) if surface.closed else found.is_behind(surface.fixed_side or 0.0)
    return torch.where(wrong, -found.distance, found.distance).numpy()


def distances(body: BodyMesh, x: np.ndarray) -> np.ndarray:
    """Unsigned distances by libigl."""
    return np.sqrt(igl.point_mesh_squared_distance(x, body[0], body[1].astype(np.int64))[0])


def around(body: BodyMesh, count: int = 400, seed: int = 1) -> np.ndarray:
    """Random points in and around a body."""
    rng = np.random.default_rng(seed)
    low, high = body[0].min(axis=0), body[0].max(axis=0)
    return rng.uniform(low - 0.3 * (high - low), high + 0.3 * (high - low), (count, 3))


def endless(count: int) -> torch.Tensor:
    """A reach without end for each point."""
    return torch.full((count,), float("inf"), dtype=torch.float64)
