"""The T-shirt with what is rendered: a mesh with thickness, buttons on the chest and piping round the hem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...solver.mesh.subdivide import smooth, subdivide
from ...solver.mesh.topology import PolygonMesh
from ...usd.mesh.bind import closest
from ...usd.write.plain import Look, PlainMesh, PlainStage
from . import tshirt
from .shapes import Solid, join, lathe, mesh, quad_grid, rings

THICKNESS = 2.5e-3
"""Of the render mesh [m]."""
FINE = 3
"""Subdivisions from the garment to the render mesh."""
BUTTONS, ACROSS, TALL = 5, 6e-3, 2.5e-3
"""Number, radius [m] and height [m] of the buttons."""
PIPING = 2e-3
"""Radius of the piping [m]."""


def build() -> PlainStage:
    """The T-shirt's shot; what is rendered stands still in the pose in which the shirt was modelled."""
    shot = tshirt.build()
    shirt, body = shot.meshes
    faces, points = _smoothed(shirt)
    trims = (_shell(faces, points), _buttons(faces, points), _piping(faces, points))
    doc = "A T-shirt whose render mesh, buttons and piping follow the refined cloth"
    return replace(shot, name="TrimsShot", doc=doc, meshes=(replace(shirt, level=2), body, *trims))


def _smoothed(shirt: PlainMesh) -> tuple[np.ndarray, np.ndarray]:
    """Quads, shape (F, 4), and points [m] of the shirt, smoothly subdivided."""
    polygons, points = PolygonMesh(shirt.counts, shirt.indices, len(shirt.points)), shirt.points
    for _ in range(FINE):
        step = subdivide(polygons)
        polygons, points = step.mesh, smooth(polygons, step) @ points
    return polygons.indices.reshape(-1, 4), points


def _normals(faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    a, b, c, d = points[faces].swapaxes(0, 1)
    areas, total = np.cross(c - a, d - b), np.zeros_like(points)
    for corner in faces.T:
        np.add.at(total, corner, areas)
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def _rims(faces: np.ndarray) -> list[np.ndarray]:
    """Vertices of each open border in order, along the border's faces."""
    sides = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    side_set = {tuple(side) for side in sides.tolist()}
    after = {a: b for a, b in sides.tolist() if (b, a) not in side_set}
    loops = []
    while after:
        start, loop = next(iter(after)), []
        while start in after:
            loop.append(start)
            start = after.pop(start)
        loops.append(np.array(loop))
    return loops


def _shell(faces: np.ndarray, points: np.ndarray) -> PlainMesh:
    normals, count = _normals(faces, points), len(points)
    both = np.concatenate([points + 0.5 * THICKNESS * normals, points - 0.5 * THICKNESS * normals])
    rims = [
        np.stack([loop, loop + count, np.roll(loop, -1) + count, np.roll(loop, -1)], axis=1) for loop in _rims(faces)
    ]
    quads = np.concatenate([faces, faces[:, ::-1] + count, *rims])
    return mesh("Render", quads, both, Look("Cotton", (0.20, 0.40, 0.33)), role="trim")


def _buttons(faces: np.ndarray, points: np.ndarray) -> PlainMesh:
    """Buttons down the middle of the chest, as one mesh of closed pieces."""
    triangles = np.concatenate([faces[:, :3], faces[:, [0, 2, 3]]])
    wanted = np.column_stack([np.zeros(BUTTONS), np.linspace(0.14, 0.42, BUTTONS), np.full(BUTTONS, 0.3)])
    nearest = closest(wanted, points, triangles)
    corners = triangles[nearest.triangle]
    positions = np.einsum("nk,nkx->nx", nearest.weights, points[corners])
    directions = np.einsum("nk,nkx->nx", nearest.weights, _normals(faces, points)[corners])
    discs = join(*map(_button, positions, directions))
    return PlainMesh(
        "Buttons", discs.counts, discs.indices, discs.points, Look("Horn", (0.30, 0.20, 0.12), 0.4), "trim"
    )


def _button(centre: np.ndarray, normal: np.ndarray) -> Solid:
    """A disc that lies on the shirt's outer face."""
    normal = normal / np.linalg.norm(normal)
    side = np.cross(normal, [0.0, 1.0, 0.0])
    side = side / np.linalg.norm(side)
    low = 0.5 * THICKNESS
    heights = low + TALL * np.array([1.0, 0.8, 0.2, 0.0])
    radius = ACROSS * np.array([0.8, 1.0, 1.0, 0.8])
    disc = lathe(rings(radius, heights, radius, 16), np.array([[0.0, low + TALL, 0.0], [0.0, low, 0.0]]))
    axes = np.stack([side, normal, np.cross(side, normal)])
    return replace(disc, points=disc.points @ axes + centre)


def _piping(faces: np.ndarray, points: np.ndarray) -> PlainMesh:
    """A tube round the hem, the lowest of the borders."""
    hem = min(_rims(faces), key=lambda loop: points[loop, 1].mean())
    middle, normals = points[hem], _normals(faces, points)[hem]
    along = np.roll(middle, -1, axis=0) - np.roll(middle, 1, axis=0)
    across = np.cross(normals, along / np.linalg.norm(along, axis=1, keepdims=True))
    angle = 2.0 * np.pi * np.arange(8) / 8
    tube = middle[:, None] + PIPING * (
        np.cos(angle)[:, None] * normals[:, None] + np.sin(angle)[:, None] * across[:, None]
    )
    rows = quad_grid(len(hem) + 1, 8, closed=True) % (8 * len(hem))
    return mesh("Piping", rows, tube.reshape(-1, 3), Look("Cord", (0.78, 0.66, 0.40)), role="trim")
