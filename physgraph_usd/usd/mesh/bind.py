"""Points bound to a surface of triangles: trims and render meshes that follow cloth.

A point x_0 is bound to the closest point c_0 of the surface in a bind pose. With its barycentric weights w, corners p
and the corners' frames F, which turn from F_0, a bound point is

    x = sum_k w_k (p_k + R_k (c_0 - p_k0) / 2) + |o| u / |u|,
    u = sum_k w_k R_k o,    o = x_0 - c_0,    R_k = F_k^T F_k0:

half way from the triangle to the blend of its corners' rigid motions, which puts points of a sheet rolled from flat on
the arc between the corners (the triangle lies as far within as the blend beyond); and the distance from the surface
kept. It is exact for motions of the whole, and facets do not show, because a corner's frame is that of all triangles
round it. A frame's first two axes are the
least-squares deformation gradient of the tangents, made orthonormal without preferring either; the third is the normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import cKDTree

from ...solver.mesh.topology import edges_of
from ...solver.rigid import Rigid, best_motion

NEAREST = 8
"""Number of triangles tested for the closest point, nearest by centroid."""
AT_ONCE = 50_000
"""Points searched at a time."""
COLLINEAR = 1e-10
"""Regularisation of a vertex's least squares, relative to the trace: its edges may lie on a line."""
_TINY = 1e-30


@dataclass(frozen=True, eq=False)
class Closest:
    """Closest points on a surface.

    Attributes:
        triangle: Number of the triangle, shape (N,).
        weights: Barycentric coordinates, shape (N, 3).
        distance: Distance, shape (N,).
    """

    triangle: Int[np.ndarray, " points"]
    weights: Float[np.ndarray, "points 3"]
    distance: Float[np.ndarray, " points"]


def closest(
    points: Float[np.ndarray, "points 3"],
    surface: Float[np.ndarray, "vertices 3"],
    triangles: Int[np.ndarray, "triangles 3"],
) -> Closest:
    """The closest point of a surface for each of some points, among the triangles with the nearest centroids."""
    corners = surface[triangles]
    tree = cKDTree(corners.mean(axis=1))
    blocks = [_closest_of(points[start : start + AT_ONCE], corners, tree) for start in range(0, len(points), AT_ONCE)]
    if not blocks:
        return Closest(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
    return Closest(*(np.concatenate(block) for block in zip(*blocks, strict=True)))


def _closest_of(points: np.ndarray, corners: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangle, weights and distance of each point."""
    count = min(NEAREST, len(corners))
    tried = np.asarray(tree.query(points, k=count)[1]).reshape(len(points), count)
    weights = _weights(points[:, None], corners[tried])
    away = np.linalg.norm(np.einsum("nkc,nkcx->nkx", weights, corners[tried]) - points[:, None], axis=2)
    best, every = away.argmin(axis=1), np.arange(len(points))
    return tried[every, best], weights[every, best], away[every, best]


def _weights(point: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of the closest point of triangles, shape (..., 3), for corners of shape (..., 3, 3)."""
    first, ab, ac = corners[..., 0, :], *(corners[..., k, :] - corners[..., 0, :] for k in (1, 2))
    ap = point - first
    aa, bb, cc = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
    pb, pc = _dot(ap, ab), _dot(ap, ac)
    area = aa * cc - bb * bb
    v, w = (cc * pb - bb * pc) / np.maximum(area, _TINY), (aa * pc - bb * pb) / np.maximum(area, _TINY)
    inside = np.stack([1.0 - v - w, v, w], axis=-1)
    # On the sides: the closest of three segments where the foot of the perpendicular is outside.
    sides, aways = [], []
    for tail, head in ((0, 1), (1, 2), (2, 0)):
        start, side = corners[..., tail, :], corners[..., head, :] - corners[..., tail, :]
        part = np.clip(_dot(point - start, side) / np.maximum(_dot(side, side), _TINY), 0.0, 1.0)
        weights = np.zeros_like(inside)
        weights[..., tail], weights[..., head] = 1.0 - part, part
        sides.append(weights)
        gap = start + part[..., None] * side - point
        aways.append(_dot(gap, gap))
    best = np.stack(aways).argmin(axis=0)
    on_side = np.take_along_axis(np.stack(sides), best[None, ..., None], axis=0)[0]
    within = (inside >= 0.0).all(axis=-1) & (area > _TINY)
    return np.where(within[..., None], inside, on_side)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...x,...x->...", a, b)


class SurfaceFrames:
    """Frames of a surface's vertices, following the deformation from a bind pose."""

    def __init__(self, bind: Float[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "triangles 3"]) -> None:
        """Prepare the gradients along two tangents of each vertex in the bind pose."""
        count = len(bind)
        normals = _normals(bind, triangles)
        axis = np.eye(3)[np.abs(normals).argmin(axis=1)]
        first = _unit(np.cross(normals, axis))
        tangents = np.stack([first, np.cross(normals, first)], axis=1)
        directed = edges_of(triangles, count).vertices
        start, end = np.concatenate([directed, directed[:, ::-1]]).T
        flat = np.einsum("ntx,nx->nt", tangents[start], bind[end] - bind[start])
        squares = np.zeros((count, 2, 2))
        np.add.at(squares, start, flat[:, :, None] * flat[:, None])
        trace = np.einsum("ntt->n", squares)
        squares += (COLLINEAR * trace + (trace <= 0))[:, None, None] * np.eye(2)
        slopes = np.linalg.solve(squares[start], flat[:, :, None])[:, :, 0]
        self._gradients = [_gradient(start, end, slope, count) for slope in slopes.T]

    def __call__(self, points: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3 3"]:
        """Frames at positions: rows are the two tangents and the normal, orthonormal."""
        along, across = (gradient @ points for gradient in self._gradients)
        normal = _unit(np.cross(along, across))
        along, across = _unit(along), _unit(across)
        between, beside = _unit(along + across), _unit(along - across)
        first = _unit(between + beside)
        return np.stack([first, np.cross(normal, first), normal], axis=1)


def _gradient(start: np.ndarray, end: np.ndarray, slope: np.ndarray, count: int) -> sparse.csr_matrix:
    """The matrix of least-squares derivatives along one tangent, shape (V, V)."""
    rows = np.concatenate([start, np.arange(count)])
    columns = np.concatenate([end, np.arange(count)])
    values = np.concatenate([slope, -np.bincount(start, slope, count)])
    return sparse.csr_matrix((values, (rows, columns)), shape=(count, count))


def _normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals of vertices, weighted by area, shape (V, 3); of a vertex without area, the third axis."""
    a, b, c = points[triangles].swapaxes(0, 1)
    areas = np.cross(b - a, c - a)
    total = np.stack([np.bincount(triangles.ravel(), np.repeat(part, 3), len(points)) for part in areas.T], axis=1)
    flat = np.linalg.norm(total, axis=1) <= _TINY
    total[flat] = [0.0, 0.0, 1.0]
    return _unit(total)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.sqrt(_dot(vectors, vectors)), _TINY)[:, None]


@dataclass(frozen=True, eq=False)
class Binding:
    """Points bound to a surface.

    Attributes:
        bind: The points in the bind pose, shape (N, 3).
        corners: Vertices of each point's triangle, shape (N, 3).
        weights: Barycentric coordinates, shape (N, 3).
        within: Half the way from each corner to its closest point, in the corner's frame, shape (N, 3, 3).
        offsets: The point relative to its closest point, in each corner's frame, shape (N, 3, 3).
        turned: Frames in the bind pose, shape (V, 3, 3).
        rigid: Number of the rigid part of each point, or -1, shape (N,).
        distance: Distance from the surface in the bind pose, shape (N,).
    """

    bind: Float[np.ndarray, "points 3"]
    corners: Int[np.ndarray, "points 3"]
    weights: Float[np.ndarray, "points 3"]
    within: Float[np.ndarray, "points 3 3"]
    offsets: Float[np.ndarray, "points 3 3"]
    frames: SurfaceFrames
    turned: Float[np.ndarray, "vertices 3 3"]
    rigid: Int[np.ndarray, " points"]
    distance: Float[np.ndarray, " points"]

    @classmethod
    def of(
        cls,
        points: Float[np.ndarray, "points 3"],
        surface: Float[np.ndarray, "vertices 3"],
        triangles: Int[np.ndarray, "triangles 3"],
        *,
        rigid: Int[np.ndarray, " points"] | None = None,
    ) -> Binding:
        """Bind points to a surface, both in the bind pose; ``rigid`` as the attribute, None without rigid parts."""
        nearest, frames = closest(points, surface, triangles), SurfaceFrames(surface, triangles)
        corners, turned = triangles[nearest.triangle], frames(surface)
        base = np.einsum("nk,nkx->nx", nearest.weights, surface[corners])
        within = 0.5 * np.einsum("nkax,nkx->nka", turned[corners], base[:, None] - surface[corners])
        offsets = np.einsum("nkax,nx->nka", turned[corners], points - base)
        parts = np.full(len(points), -1) if rigid is None else np.asarray(rigid)
        return cls(points, corners, nearest.weights, within, offsets, frames, turned, parts, nearest.distance)

    def at(self, surface: Float[np.ndarray, "vertices 3"]) -> Follower:
        """The binding with the surface at other positions."""
        return Follower(self, surface, self.frames(surface))

    @cached_property
    def blend(self) -> sparse.csr_matrix:
        """The closest points by the surface's positions, then the axes of its frames, shape (N, 4 V)."""
        attachment = sparse.csr_matrix(
            (self.weights.ravel(), self.corners.ravel(), 3 * np.arange(len(self.bind) + 1)),
            shape=(len(self.bind), len(self.turned)),
        )
        return sparse.hstack([attachment, self._by_axes(self.within)]).tocsr()

    @cached_property
    def blend_offset(self) -> sparse.csr_matrix:
        """The points relative to their closest points by the axes of the frames, shape (N, 3 V)."""
        return self._by_axes(self.offsets)

    def _by_axes(self, local: np.ndarray) -> sparse.csr_matrix:
        """Blended vectors by the axes of the frames; local has shape (N, 3, 3)."""
        count = len(local)
        columns = (3 * self.corners[:, :, None] + np.arange(3)).reshape(count, 9)
        values = (self.weights[:, :, None] * local).reshape(count, 9)
        shape = (count, 3 * len(self.turned))
        return sparse.csr_matrix((values.ravel(), columns.ravel(), 9 * np.arange(count + 1)), shape=shape)

    @cached_property
    def parts(self) -> list[np.ndarray]:
        """Points of each rigid part."""
        order = np.argsort(self.rigid, kind="stable")
        order = order[self.rigid[order] >= 0]
        cuts = np.flatnonzero(np.diff(self.rigid[order])) + 1
        return np.split(order, cuts) if len(order) else []


@dataclass(frozen=True, eq=False)
class Follower:
    """A binding with its surface at a time: points and turns follow.

    Attributes:
        surface: Positions of the surface, shape (V, 3).
        frames: Frames of the surface, shape (V, 3, 3).
    """

    binding: Binding
    surface: Float[np.ndarray, "vertices 3"]
    frames: Float[np.ndarray, "vertices 3 3"]

    @cached_property
    def _motions(self) -> list[tuple[np.ndarray, Rigid]]:
        """Points and motion of each rigid part, by the best fit of the bound points."""
        before, current = self.binding.bind, self._soft
        return [(part, best_motion(before[part], current[part])) for part in self.binding.parts]

    @cached_property
    def _soft(self) -> np.ndarray:
        """Points, none of them rigid."""
        bound, axes = self.binding, self.frames.reshape(-1, 3)
        return bound.blend @ np.concatenate([self.surface, axes]) + bound.distance[:, None] * _unit(
            bound.blend_offset @ axes
        )

    @cached_property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The bound points."""
        points = self._soft if not self.binding.parts else self._soft.copy()
        for part, motion in self._motions:
            points[part] = motion(self.binding.bind[part])
        return points

    def turned(self, vectors: np.ndarray, owner: np.ndarray) -> np.ndarray:
        """Unit vectors turning with points, such as normals.

        Args:
            vectors: Vectors in the bind pose, shape (M, 3).
            owner: The point of each, shape (M,).
        """
        bound, coarse = self.binding, np.asarray(vectors, float)
        total = np.zeros_like(coarse)
        for k in range(3):
            corner = bound.corners[owner, k]
            local = np.einsum("nax,nx->na", bound.turned[corner], coarse)
            total += bound.weights[owner, k, None] * np.einsum("nax,na->nx", self.frames[corner], local)
        for part, motion in self._motions:
            mine = np.isin(owner, part)
            total[mine] = coarse[mine] @ motion.turn.T
        return _unit(total)
