"""Painting: a brush on the refined cloth changes a map on the cage's vertices."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree
from trimesh.intersections import planes_lines
from trimesh.triangles import points_to_barycentric

from ..solver.mesh.topology import PolygonMesh, adjacency

PAINT, ERASE, SMOOTH, READ = "paint", "erase", "smooth", "read"


@dataclass(frozen=True)
class Brush:
    """A brush.

    Attributes:
        radius: Radius [m].
        value: Painted value.
        strength: Fraction of the way to the value per touch, 0 to 1.
        mode: `PAINT` or `ERASE`: towards the value; or `SMOOTH`: towards the mean of the neighbours.
        mirrored: Whether the other side is painted too, mirrored in the rest shape.
    """

    radius: float
    value: float
    strength: float = 0.5
    mode: str = PAINT
    mirrored: bool = False


@dataclass
class Stroke:
    """A map under the brush.

    Attributes:
        garment: Prim path.
        name: The map's short name.
        values: On the cage's vertices, shape (V,).
    """

    garment: str
    name: str
    values: np.ndarray
    _mirror: np.ndarray | None = field(default=None, repr=False)

    def touch(
        self,
        brush: Brush,
        at: np.ndarray,
        points: np.ndarray,
        *,
        mesh: PolygonMesh,
        rest: np.ndarray,
        right: np.ndarray,
    ) -> None:
        """Change the values near a place.

        Args:
            brush: The brush.
            at: The place [m], shape (3,).
            points: Positions of the cage's vertices [m], shape (V, 3).
            mesh: The cage.
            rest: Its rest positions [m], shape (V, 3).
            right: Direction across which it is mirrored, shape (3,).
        """
        near = np.clip(1.0 - np.linalg.norm(points - at, axis=1) / brush.radius, 0.0, 1.0)
        if brush.mirrored:
            if self._mirror is None:
                self._mirror = mirrored(rest, right)
            near = np.maximum(near, near[self._mirror])
        weight = brush.strength * near * near * (3.0 - 2.0 * near)
        towards = neighbour_mean(mesh, self.values) if brush.mode == SMOOTH else brush.value
        self.values = self.values + weight * (towards - self.values)


def mirrored(rest: np.ndarray, right: np.ndarray) -> np.ndarray:
    """For each vertex the one nearest to its mirror image across the middle of the rest shape, shape (V,)."""
    at = rest @ right
    image = rest + np.outer(at.max() + at.min() - 2.0 * at, right)
    return np.asarray(cKDTree(rest).query(image)[1])


def gradient(points: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Height of each vertex, 0 at the lowest and 1 at the highest, shape (V,); 1 everywhere in a level garment."""
    height = points @ up - (points @ up).min()
    return height / height.max() if height.max() > 0.0 else np.ones(len(points))


def neighbour_mean(mesh: PolygonMesh, values: np.ndarray) -> np.ndarray:
    """Mean over each vertex's neighbours, or the vertex's value without neighbours, shape (V,)."""
    near = adjacency(mesh.half_edges.edges, mesh.vertex_count)
    count = np.asarray(near.sum(axis=1)).ravel()
    return np.where(count > 0, near @ values / np.maximum(count, 1.0), values)


def hit(origin: np.ndarray, along: np.ndarray, points: np.ndarray, triangles: np.ndarray) -> np.ndarray | None:
    """The first intersection of a ray and a mesh [m], shape (3,); None without one.

    Args:
        origin: Origin of the ray [m], shape (3,).
        along: Direction, shape (3,).
        points: Positions [m], shape (V, 3).
        triangles: Shape (T, 3).
    """
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)
    rays = np.broadcast_to(origin, normals.shape), np.broadcast_to(along, normals.shape)
    at, meets, distance = planes_lines(corners[:, 0], normals, *rays, return_distance=True)
    inside = (points_to_barycentric(corners[meets], at) >= 0.0).all(axis=1) & (distance > 0.0)
    return origin + distance[inside].min() * along if inside.any() else None


def circle(points: np.ndarray, triangles: np.ndarray, at: np.ndarray, radius: float) -> np.ndarray:
    """Where a mesh cuts a sphere: line segments [m], shape (S, 2, 3).

    Args:
        points: Positions [m], shape (V, 3).
        triangles: Shape (T, 3).
        at: The sphere's middle [m], shape (3,).
        radius: Its radius [m].
    """
    beyond = np.linalg.norm(points - at, axis=1) - radius
    count = (beyond[triangles] > 0.0).sum(axis=1)
    cut = triangles[(count > 0) & (count < 3)]
    ends = np.stack([cut, np.roll(cut, -1, axis=1)], axis=2)  # Two of the three edges are cut.
    first, second = beyond[ends[..., 0]], beyond[ends[..., 1]]
    is_cut = (first > 0.0) != (second > 0.0)
    part = (first[is_cut] / (first[is_cut] - second[is_cut]))[:, None]
    start, end = points[ends[is_cut][:, 0]], points[ends[is_cut][:, 1]]
    return (start + part * (end - start)).reshape(-1, 2, 3)
