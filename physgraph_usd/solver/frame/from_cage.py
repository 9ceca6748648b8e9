"""Carries the last frame's detail along with the cage, and places all vertices not moved by the solve.

Detail is x - S x_c, with S the smooth map from the cage. Each cage vertex has an orthonormal frame from its normal and
a tangent. The tangent is a fixed linear combination of the triangles' edges, so frames rotate with the surface. The
rotation of the frames is interpolated to the fine vertices, not the frames: tangents of neighbours may point in any
direction, even opposite, and have no mean.

Fixed vertices are placed by the cage, corners of faces without area follow the neighbouring cloth, and rigid parts the
cloth below.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from torch import Tensor

from ..level import PIN_MARGIN, Level, Placed
from ..mesh.recorded import Recordings
from ..mesh.stencil import Stencil, add_at
from ..mesh.topology import PolygonMesh
from ..rigid import best_motion
from ..scene import Garment

SAME_POINT = 1e-6
"""Distance below which points count as coincident, in edge lengths."""
LEAST_FOLLOWED = 12
"""Fewest cloth vertices followed by a part."""


class MovingFrames:
    """The frames of a cage and their map to the fine vertices.

    Attributes:
        edge: Mean edge of the cage [m].
    """

    def __init__(self, cage: Level, finest: Level) -> None:
        """Fix each cage vertex's tangent in the rest shape."""
        self._level, self._triangles = finest, cage.triangles.long()
        triangles, rest = cage.triangles.cpu().numpy(), cage.rest.double().cpu().numpy()
        self._tangent = Stencil(tangent_operator(triangles, rest), dtype=finest.dtype, device=finest.device)
        self.edge, self._recordings = mean_edge(triangles, rest), Recordings()

    def frames(self, coarse: Float[Tensor, "coarse 3"]) -> Float[Tensor, "coarse 3 3"]:
        """Orthonormal frames at the cage vertices; columns are tangent, bitangent, normal."""
        corner = coarse[self._triangles]
        area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal = add_at(torch.zeros_like(coarse), self._triangles.T.reshape(-1), area.repeat(3, 1))
        return orthonormal(normal, self._tangent.apply(coarse))

    def predict(
        self, before: Float[Tensor, "coarse 3"], fine: Float[Tensor, "vertices 3"], coarse: Float[Tensor, "coarse 3"]
    ) -> tuple[Float[Tensor, "vertices 3"], Float[Tensor, "vertices 3 3"], float, float, float]:
        """Carry detail to new cage positions; vertices that are not free go to the cage's.

        Args:
            before: Cage positions in the last frame [m].
            fine: Fine positions in the last frame [m].
            coarse: Cage positions now [m].

        Returns:
            Predicted fine positions [m], the rotation at each, the RMS motion of the cage in mean cage edges, its RMS
            turn [rad], and its largest move [m].
        """
        placed, rotation, far = self._recordings.run("predict", self._predict, before, fine, coarse)
        motion, turn, farthest = far.tolist()
        return placed, rotation, motion / self.edge, turn, farthest

    def _predict(self, before: Tensor, fine: Tensor, coarse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Predicted fine positions [m] and rotations, and RMS motion [m], RMS turn [rad] and largest move [m] of the
        cage."""
        detail, last, frames = fine - self._level.smooth_base.apply(before), self.frames(before), self.frames(coarse)
        rotation = self._turned(last, frames)
        moved = torch.einsum("vij,vj->vi", rotation, detail)
        motion = (coarse - before).square().sum(dim=1).mean().sqrt()
        cosine = (torch.einsum("cij,cij->c", frames, last) - 1.0) / 2.0
        turn = torch.arccos(cosine.clamp(-1.0, 1.0)).square().mean().sqrt()
        moves = (coarse - before).norm(dim=1)
        farthest = moves.max() if len(moves) else moves.sum()
        placed = self._level.smooth_base.apply(coarse) + moved
        placed = torch.where(self._level.free, placed, self._level.base.apply(coarse))
        return placed, rotation, torch.stack([motion, turn, farthest])

    def scaled(
        self, coarse: Float[Tensor, "coarse 3"], fine: Float[Tensor, "vertices 3"], gain: np.ndarray
    ) -> Float[Tensor, "vertices 3"]:
        """Scale the detail of free vertices by a gain at each cage vertex, shape (C,); 1 everywhere changes nothing."""
        if np.all(gain == 1.0):
            return fine
        factor = torch.as_tensor(self._level.from_coarse @ gain).to(fine).unsqueeze(1)
        smooth = self._level.smooth_base.apply(coarse)
        return torch.where(self._level.free, smooth + factor * (fine - smooth), fine)

    def _turned(
        self, before: Float[Tensor, "coarse 3 3"], after: Float[Tensor, "coarse 3 3"]
    ) -> Float[Tensor, "vertices 3 3"]:
        """Rotation of the cage frames, interpolated to the fine vertices; identity if either frame is degenerate."""
        turned = torch.einsum("cij,ckj->cik", after, before)
        volume = (torch.linalg.cross(turned[:, 0], turned[:, 1]) * turned[:, 2]).sum(dim=1)
        sound = (volume > 0.5).unsqueeze(1).unsqueeze(2)
        turned = torch.where(sound, turned, torch.eye(3, dtype=turned.dtype, device=turned.device))
        first, last = (self._level.base.apply(turned[:, :, column].contiguous()) for column in (0, 2))
        return orthonormal(last, first)


class Followers:
    """Fixed vertices, and corners of faces without area; the latter follow their neighbours, weighted by nearness."""

    def __init__(self, level: Level, garments: Sequence[Garment], meshes: Sequence[PolygonMesh]) -> None:
        """Find the followers of a level; ``meshes`` are the garments' polygons."""
        self._rigid = RigidParts(level, garments)
        idle = ((level.vertex_area == 0) & (level.pin < 1.0 - PIN_MARGIN)).cpu().numpy()
        parts = [(mesh, span) for mesh, span in zip(meshes, level.spans, strict=True) if idle[span].any()]
        edges = [mesh.half_edges.edges.astype(np.int64) + span.start for mesh, span in parts]
        edges = np.concatenate([np.empty((0, 2), np.int64), *edges])
        ends = np.concatenate([edges, edges[:, ::-1]])
        ends = ends[idle[ends[:, 0]] & (ends[:, 0] != ends[:, 1])]
        self._idle, row = np.unique(ends[:, 0], return_inverse=True)
        rest = level.rest.double().cpu().numpy()
        length = np.linalg.norm(rest[ends[:, 0]] - rest[ends[:, 1]], axis=1)
        near = 1.0 / np.maximum(length, SAME_POINT * float(level.spacing.mean()))
        beside = sp.csr_matrix((near, (row, ends[:, 1])), shape=(len(self._idle), level.vertex_count))
        # Parts without any adjacent cloth stay: the margin makes the matrix invertible.
        degree = sp.diags(np.bincount(row, near, len(self._idle)) * (1.0 + 1e-9))
        self._inverse = splu(sp.csc_matrix(degree - beside[:, self._idle])) if len(row) else None
        self._fixed = np.flatnonzero(~level.free.cpu().numpy().ravel())
        self._place_fixed = sp.csr_matrix(level.from_coarse[self._fixed])
        self._beside, self._from_coarse = sp.csr_matrix(beside @ sp.diags(1.0 - idle)), level.from_coarse

    def placed(self, x: Placed, origin: np.ndarray, coarse: np.ndarray) -> np.ndarray:
        """World positions [m], shape (V, 3), with followers placed by the cage and by the solved vertices.

        Fixed vertices take the upsampled cage's positions; a corner's offset from the cage is the mean of its
        neighbours'.

        Args:
            x: Positions of the cloth, about the origin [m].
            origin: World position [m], shape (3,).
            coarse: The cage's world positions [m], shape (C, 3).
        """
        out = x.double().cpu().numpy() + origin
        out[self._fixed] = self._place_fixed @ coarse
        if self._inverse is not None:
            base = self._from_coarse @ coarse
            out[self._idle] = base[self._idle] + self._inverse.solve(self._beside @ (out - base))
        self._rigid.place(out, self._from_coarse, coarse)
        return out


def orthonormal(
    normal: Float[Tensor, "vertices 3"], tangent: Float[Tensor, "vertices 3"]
) -> Float[Tensor, "vertices 3 3"]:
    """Frames from normals and rough tangents, columns are tangent, bitangent, normal; arbitrary if both vanish."""
    normal = torch.nn.functional.normalize(normal, dim=1, eps=1e-30)
    tangent = tangent - (tangent * normal).sum(dim=1, keepdim=True) * normal
    tangent = torch.nn.functional.normalize(tangent, dim=1, eps=1e-30)
    return torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], dim=2)


def tangent_operator(triangles: np.ndarray, rest: np.ndarray) -> sp.csr_matrix:
    """Sparse map from cage positions to one tangent per vertex.

    A vertex's reference direction at rest is projected into each incident triangle and written as a combination of the
    triangle's two edges; the same combination of the deformed edges is the triangle's vote.

    Args:
        triangles: Corner vertices, shape (T, 3).
        rest: Rest positions [m], shape (C, 3), float64.
    """
    count = len(rest)
    reference = _reference_directions(triangles, rest)
    rows, columns, values = [], [], []
    first, second = rest[triangles[:, 1]] - rest[triangles[:, 0]], rest[triangles[:, 2]] - rest[triangles[:, 0]]
    a, b, c = (np.einsum("tc,tc->t", u, v) for u, v in ((first, first), (first, second), (second, second)))
    determinant = a * c - b * b
    sound = determinant > 1e-12 * a * c
    inverse = np.where(sound, 1.0 / np.where(sound, determinant, 1.0), 0.0)
    area = np.sqrt(np.maximum(determinant, 0.0))
    for corner in range(3):
        vertex = triangles[:, corner]
        p = np.einsum("tc,tc->t", first, reference[vertex])
        q = np.einsum("tc,tc->t", second, reference[vertex])
        along_first, along_second = area * inverse * (c * p - b * q), area * inverse * (a * q - b * p)
        rows += [vertex] * 3
        columns += [triangles[:, 0], triangles[:, 1], triangles[:, 2]]
        values += [-along_first - along_second, along_first, along_second]
    triplets = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sp.csr_matrix(triplets, shape=(count, count))


def _reference_directions(triangles: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """One tangent direction per cage vertex in the rest shape: the vertex's first edge, projected."""
    normal = np.zeros_like(rest)
    area = np.cross(rest[triangles[:, 1]] - rest[triangles[:, 0]], rest[triangles[:, 2]] - rest[triangles[:, 0]])
    for corner in range(3):
        np.add.at(normal, triangles[:, corner], area)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    direction = np.zeros_like(rest)
    for corner in (2, 1, 0):
        direction[triangles[:, corner]] = rest[triangles[:, (corner + 1) % 3]] - rest[triangles[:, corner]]
    return direction - np.einsum("vc,vc->v", direction, normal)[:, None] * normal


def mean_edge(triangles: np.ndarray, rest: np.ndarray) -> float:
    """Mean edge of triangles [m]; 1 without triangles."""
    if not len(triangles):
        return 1.0
    sides = rest[triangles] - rest[np.roll(triangles, 1, axis=1)]
    return max(float(np.linalg.norm(sides, axis=2).mean()), 1e-12)


class RigidParts:
    """The rigid parts of a level, each with the vertices of the cloth below."""

    def __init__(self, level: Level, garments: Sequence[Garment]) -> None:
        """Find the cloth around each part's centre, within the part's radius plus an edge."""
        self._parts: list[tuple[np.ndarray, np.ndarray]] = []
        rest, spacing = level.rest.double().cpu().numpy(), float(level.spacing.mean())
        cloth = (level.vertex_area > 0).cpu().numpy()
        for garment, span in zip(garments, level.spans, strict=True):
            under = np.flatnonzero(cloth[span]) + span.start
            if garment.rigid is None or not len(under):
                continue
            tree = cKDTree(rest[under])
            for members in parts_of(level, garment.rigid, span):
                if not (level.pin[members] < 1.0 - PIN_MARGIN).all():
                    continue  # Pinned parts stay on the cage.
                middle = rest[members].mean(axis=0)
                radius = float(np.linalg.norm(rest[members] - middle, axis=1).max())
                near = tree.query(middle, k=min(LEAST_FOLLOWED, len(under)))[1].reshape(-1)
                around = np.asarray(tree.query_ball_point(middle, radius + spacing), np.int64)
                self._parts.append((members, under[np.union1d(near, around).astype(np.int64)]))

    def place(
        self, out: Float[np.ndarray, "vertices 3"], from_coarse: sp.csr_matrix, coarse: Float[np.ndarray, "coarse 3"]
    ) -> None:
        """Move the parts from their positions on the upsampled cage to the cloth [m]; ``out`` is modified in place.

        Each part follows the best rigid motion of the cloth below, and then moves away from the cloth until no vertex
        below is nearer to the part than on the cage.
        """
        for members, under in self._parts:
            base, cage = from_coarse[under] @ coarse, from_coarse[members] @ coarse
            motion = best_motion(base, out[under])
            part, before, after = motion(cage), motion(base), out[under]
            away = _normal(before, part)
            out[members] = part + max(0.0, float(((after - before) @ away).max())) * away


def _normal(cloth: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Unit normal of the plane that fits cloth best, on the side of a part, shape (3,)."""
    normal = np.linalg.svd(cloth - cloth.mean(axis=0))[2][2]
    return normal if float((part.mean(axis=0) - cloth.mean(axis=0)) @ normal) >= 0.0 else -normal


def parts_of(level: Level, rigid: np.ndarray, span: slice) -> list[np.ndarray]:
    """Vertices of each rigid part at a level, given the parts' numbers at the garment's cage vertices."""
    numbers = np.zeros(level.from_coarse.shape[1])
    columns = np.unique(level.from_coarse[span].indices)
    numbers[columns.min() : columns.min() + len(rigid)] = rigid
    part = np.asarray(level.from_coarse[span] @ numbers).ravel().round().astype(np.int64)
    return [np.flatnonzero(part == number) + span.start for number in range(int(rigid.max()) + 1)]
