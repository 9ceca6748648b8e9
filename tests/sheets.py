"""Flat sheets of several mesh kinds, and single levels built from them."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from meshes import grid
from scipy.spatial import Delaunay

from physgraph_usd.solver.level import Level, build_levels, refine_garments
from physgraph_usd.solver.mesh.subdivide import subdivide
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.scene import Garment, Grain

Sheet = tuple[np.ndarray, np.ndarray]
"""Points in the xy plane, shape (V, 3), and counter-clockwise triangles, shape (T, 3)."""


def triangle_mesh(triangles: np.ndarray, vertex_count: int) -> PolygonMesh:
    return PolygonMesh(np.full(len(triangles), 3), triangles.ravel(), vertex_count)


def garment_of(mesh: PolygonMesh, rest: np.ndarray, *, bent: bool = False, **painted: np.ndarray) -> Garment:
    """A garment with unit paint and no pins unless given."""
    one = np.ones(mesh.vertex_count)
    paint = {"stretch_scale": one, "bend_scale": one, "guide_scale": one, "detail_scale": one, "pin": 0 * one}
    values: dict[str, Any] = paint | painted
    return Garment("/World/Sheet", mesh, rest, 0, bent, **values)


def level_of(
    rest: np.ndarray,
    triangles: np.ndarray,
    *,
    dtype: torch.dtype = torch.float64,
    bent: bool = False,
    warp: np.ndarray | None = None,
    **painted: np.ndarray,
) -> Level:
    """The cage level of one garment of triangles; ``warp`` is the direction of its warp."""
    mesh = triangle_mesh(np.asarray(triangles), len(rest))
    garment = garment_of(mesh, np.asarray(rest), bent=bent, **painted)
    if warp is not None:
        one, along = np.ones(len(rest)), np.broadcast_to(warp, (mesh.face_count, 3))
        garment = replace(garment, grain=Grain(along, one, 0.0 * one))
    return build_levels([garment], [()], dtype=dtype)[0]


def equilateral(length: float, width: float, edge: float) -> Sheet:
    """Equilateral triangles, rows along x; the short sides are jagged by half an edge."""
    columns, rows = round(length / edge), max(1, round(width / (edge * np.sqrt(0.75))))
    points = np.array(
        [
            [edge * (c + 0.5 * (r % 2)), edge * np.sqrt(0.75) * r, 0.0]
            for r in range(rows + 1)
            for c in range(columns + 1)
        ]
    )
    faces = []
    for r in range(rows):
        for c in range(columns):
            a, d = r * (columns + 1) + c, (r + 1) * (columns + 1) + c
            faces += [[a, a + 1, d], [a + 1, d + 1, d]] if r % 2 == 0 else [[a, d + 1, d], [a, a + 1, d + 1]]
    return points, np.array(faces)


def irregular(length: float, width: float, edge: float) -> Sheet:
    """Delaunay triangles of a jittered equilateral lattice in a rectangle; every quality is over 0.3."""
    rng = np.random.default_rng(7)
    columns, rows = round(length / edge), max(1, round(width / (edge * np.sqrt(0.75))))
    inner = [
        [(c + 0.5 * (r % 2)) / columns * length, r / rows * width]
        for r in range(1, rows)
        for c in range(columns + 1)
        if 0.4 < c + 0.5 * (r % 2) < columns - 0.4
    ]
    points = np.array(inner).reshape(-1, 2)
    points = points + rng.uniform(-0.22, 0.22, points.shape) * edge
    along, across = np.linspace(0, length, columns + 1), np.linspace(0, width, rows + 1)[1:-1]
    rim = [[x, y] for x in along for y in (0.0, width)] + [[x, y] for y in across for x in (0.0, length)]
    points = np.concatenate([points, rim])
    faces = Delaunay(points).simplices.astype(np.int64)
    flat = quality(points, faces) > 1e-6
    return np.column_stack([points, np.zeros(len(points))]), faces[flat]


def quad_cage(length: float, width: float, edge: float) -> tuple[PolygonMesh, np.ndarray]:
    """Squares of twice the edge."""
    cage, points = grid(max(1, round(length / (2 * edge))), max(1, round(width / (2 * edge))))
    return cage, points * np.array([length, width, 0.0]) / np.maximum(np.ptp(points, axis=0), 1e-300)


def quads_refined(length: float, width: float, edge: float) -> Sheet:
    """Squares as one subdivision of a quad cage gives them: diagonals alternate."""
    cage, points = quad_cage(length, width, edge)
    refinement = subdivide(cage)
    return refinement.linear @ points, refinement.mesh.triangulate().triangles.astype(np.int64)


def quads_one_way(length: float, width: float, edge: float) -> Sheet:
    """Squares triangulated before they came to us, all diagonals one way."""
    mesh, points = grid(round(length / edge), max(1, round(width / edge)), "triangles")
    scale = np.array([length, width, 0.0]) / np.maximum(np.ptp(points, axis=0), 1e-300)
    return points * scale, mesh.indices.reshape(-1, 3).astype(np.int64)


KINDS: dict[str, Callable[[float, float, float], Sheet]] = {
    "equilateral": equilateral,
    "irregular": irregular,
    "quads": quads_refined,
    "quads, one way": quads_one_way,
}
"""Sheets of a length, a width and an edge length, by the name of their mesh kind."""


def level_of_kind(
    kind: str,
    size: tuple[float, float, float],
    *,
    start: float = 0.0,
    pinned: Callable[[np.ndarray], np.ndarray] | None = None,
    warp: np.ndarray | None = None,
) -> Level:
    """A sheet of a mesh kind, and a length, width and edge; quads are refined: the level knows them for quads."""
    shift = np.array([start, 0.0, 0.0])
    if kind != "quads":
        points, triangles = KINDS[kind](*size)
        points = points + shift
        pin = np.zeros(len(points)) if pinned is None else pinned(points) * 1.0
        return level_of(points, triangles, pin=pin, warp=warp)
    cage, points = quad_cage(*size)
    points = points + shift
    garment = garment_of(cage, points, pin=np.zeros(len(points)) if pinned is None else pinned(points) * 1.0)
    return build_levels([garment], refine_garments([garment], [1]), dtype=torch.float64)[-1]


def quality(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """4 sqrt(3) area / sum of squared sides: 1 for equilateral triangles, 0 for collapsed ones."""
    a, b, c = (points[triangles[:, corner], :2] for corner in range(3))
    double = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    squares = sum(((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a)))
    return 2 * np.sqrt(3) * double / squares


def rotation(seed: int) -> np.ndarray:
    """A random rotation, shape (3, 3)."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))
