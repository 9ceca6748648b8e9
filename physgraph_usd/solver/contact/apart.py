"""Untangling of cages that start with intersections: the smaller piece cut off by each contour moves back.

Springs shorten a contour step by step and stop when the cloth between is stretched. The smaller piece is taken to be on
the wrong side (Baraff, Witkin and Kass 2003): the piece's vertices are mirrored at the cloth that the piece passed
through, by at most a gap. A dent, a corner or half a sheet comes back at any depth. All pieces move at once.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from torch import Tensor

from ..collide.boxes import FAR
from ..collide.crossings import Crossings, crossings
from ..collide.distance import weights_on_triangle
from ..deadline import is_over
from ..level import Level
from ..mesh.kernels import KERNELS
from ..mesh.threads import run
from ..mesh.topology import joined_by
from .cloth_mesh import RINGS, ClothMesh

wp.set_module_options(KERNELS)

MIRROR_PASSES = 6
"""Largest number of passes that move pieces back: a pass may uncover further contours."""
SECOND_GAP = 0.25
"""Minimum gap of a second try, in mean edges: faces of curved cloth intersect if the gap is smaller than their sag."""


@dataclass(frozen=True, eq=False)
class _Through:
    """Vertices of pieces that passed through cloth.

    Attributes:
        vertices: Indices of the vertices, shape (N,), int64.
        depth: Vector from the closest point of the penetrated cloth to each vertex [m], shape (N, 3).
    """

    vertices: Int[Tensor, " vertices"]
    depth: Float[Tensor, "vertices 3"]

    def back(self, x: Tensor, gap: float) -> Tensor:
        """Positions with the vertices on the far side of the cloth, as high as they were deep, at most the gap [m]."""
        out, length = x.clone(), self.depth.norm(dim=1, keepdim=True)
        beyond = length.clamp_max(gap) / length.clamp_min(1e-30)
        out[self.vertices] = x[self.vertices] - ((1.0 + beyond) * self.depth).to(x)
        return out


def drawn_apart(
    mesh: ClothMesh,
    x: Float[Tensor, "vertices 3"],
    start: Crossings,
    *,
    gap: float,
    queried: Bool[Tensor, " vertices"] | None = None,
) -> tuple[Float[Tensor, "vertices 3"], int]:
    """Move cut-off pieces back to their side, as long as the number of crossings falls.

    Args:
        x: Positions [m].
        gap: Largest final distance from the penetrated cloth [m]; a fraction of an edge is used instead if it leaves
            fewer crossings.
        queried: As for `crossings`.

    Returns:
        Positions [m], x itself if nothing improves, and their number of crossings.
    """
    best, first = (x, start), None
    for least in (0.0, SECOND_GAP):
        if not best[1].count or is_over():
            break
        first = _gone_through(mesh, start, x) if first is None else first
        wide = max(gap, least * float(mesh.level.spacing.mean()))
        at, remaining, through = x, start, first
        for _ in range(MIRROR_PASSES):
            moved = through.back(at, wide)
            after = crossings(mesh.parts, moved, queried)
            if after.count >= remaining.count:
                break
            at, remaining = moved, after
            if not remaining.count or is_over():
                break
            through = _gone_through(mesh, remaining, at)
        best = (at, remaining) if remaining.count < best[1].count else best
    return best[0], best[1].count


def _gone_through(mesh: ClothMesh, contours: Crossings, x: Tensor) -> _Through:
    """Vertices of the smallest piece at each contour, and their depths through the cloth."""
    piece, met = _chosen(mesh, contours)
    count = met.shape[0]
    inside = torch.as_tensor(piece >= 0, device=x.device) & mesh.level.free[:, 0]
    vertices = torch.nonzero(inside).squeeze(1)
    rows = torch.as_tensor(piece, device=x.device)[vertices]
    members = sp.csr_matrix(
        (np.ones(int((piece >= 0).sum()), np.float32), (piece[piece >= 0], np.flatnonzero(piece >= 0))), shape=met.shape
    )
    rings = np.ceil(np.sqrt(np.bincount(piece[piece >= 0], minlength=count))).astype(int) + RINGS
    barrier = _grown(mesh, met, rings) - _grown(mesh, members, np.full(count, RINGS))
    barrier = sp.csr_matrix(barrier > 0)
    depth = displacements_to(mesh.level, x, vertices, rows, _faces_of(mesh, barrier))
    deep = torch.nonzero((depth != 0).any(dim=1)).squeeze(1)
    return _Through(vertices[deep], depth[deep])


def pieces_of(mesh: ClothMesh, contours: Crossings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Connected pieces into which contours cut the cloth.

    Returns:
        The piece of each vertex; True for pieces that are cut off (smaller than the largest piece of their connected
        component of the uncut cloth); and the areas of the pieces [m^2].
    """
    count = mesh.level.vertex_count
    ends = mesh.parts.links.cpu().numpy()
    uncut = np.ones(len(ends), bool)
    uncut[contours.edge.cpu().numpy()] = False
    component, piece = joined_by(ends, count), joined_by(ends[uncut], count)
    area = np.bincount(piece, mesh.level.vertex_area.double().cpu().numpy())
    first = np.unique(piece, return_index=True)[1]
    largest = np.zeros(int(component.max()) + 1)
    np.maximum.at(largest, component[first], area)
    return piece, area < largest[component[first]], area


def _chosen(mesh: ClothMesh, contours: Crossings) -> tuple[Int[np.ndarray, " vertices"], sp.csr_matrix]:
    """The smallest piece at each contour.

    Returns:
        The row of each vertex's piece, -1 outside all chosen pieces, and the vertices that each piece crosses, shape
        (pieces, V).
    """
    piece, off, area = pieces_of(mesh, contours)
    rank = np.empty(len(area), np.int64)
    rank[np.argsort(area, kind="stable")] = np.arange(len(area))
    corners = mesh.corners_of(contours).cpu().numpy()
    pieces = piece[corners]
    of_edge = (pieces[:, :, None] == pieces[:, None, :2]).any(axis=2)
    of_face = (pieces[:, :, None] == pieces[:, None, 2:]).any(axis=2)
    order = np.where(off[pieces] & (of_edge ^ of_face), rank[pieces], len(area))
    column = order.argmin(axis=1)
    has = np.flatnonzero(order.min(axis=1) < len(area))
    numbers, row = np.unique(pieces[has, column[has]], return_inverse=True)
    # A piece pierces the face if the crossing edge is part of the piece, and is pierced by the edge otherwise.
    by_edge = of_edge[has, column[has]]
    pierced = np.where(by_edge[:, None], corners[has][:, [2, 3, 4]], corners[has][:, [0, 1, 1]])
    met = sp.csr_matrix(
        (np.ones(pierced.size, np.float32), (np.repeat(row, 3), pierced.ravel())),
        shape=(len(numbers), mesh.level.vertex_count),
    )
    rows = np.full(len(area), -1, np.int64)
    rows[numbers] = np.arange(len(numbers))
    return rows[piece], met


def _grown(mesh: ClothMesh, sets: sp.csr_matrix, rings: np.ndarray) -> sp.csr_matrix:
    """Each row's vertices grown by the row's number of rings; ones, float32."""
    grown = sp.csr_matrix(sets > 0).astype(np.float32)
    for ring in range(int(rings.max(initial=0))):
        added = sp.diags((rings > ring).astype(np.float32)) @ grown @ mesh.beside
        grown = sp.csr_matrix(grown + added > 0).astype(np.float32)
    return grown


def _faces_of(mesh: ClothMesh, vertices: sp.csr_matrix) -> sp.csr_matrix:
    """Faces with all corners among each row's vertices, shape (rows, T)."""
    triangles = mesh.level.triangles.cpu().numpy()
    columns = sp.csc_matrix(vertices.astype(np.float32))
    a, b, c = (columns[:, triangles[:, corner]] for corner in range(3))
    out = sp.csr_matrix(a.multiply(b).multiply(c))
    out.eliminate_zeros()
    return out


@wp.func
def holds(members: wp.array(dtype=wp.int32), begin: wp.int32, end: wp.int32, wanted: wp.int32):
    """True if an ascending list contains a number."""
    low, high = wp.int32(0) + begin, wp.int32(0) + end
    while low < high:
        half = (low + high) // 2
        if members[half] < wanted:
            low = half + 1
        else:
            high = half
    return low < end and members[low] == wanted


@wp.kernel
def _closest_of(
    first: wp.int32,
    x: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    tree: wp.uint64,
    queried: wp.array(dtype=wp.int32),
    rows: wp.array(dtype=wp.int32),
    begin: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    radius: wp.float64,
    out: wp.array(dtype=wp.vec3d),
):
    n = first + wp.tid()
    at, row = x[queried[n]], rows[n]
    begins, ends = begin[row], begin[row + 1]
    least, within, k = wp.float64(0.0) + FAR, wp.float64(0.5) * radius, wp.int32(0)
    while begins < ends and least > within:
        within = within * wp.float64(2.0)
        reach = wp.vec3d(within)
        query = wp.bvh_query_aabb(tree, wp.vec3f(at - reach), wp.vec3f(at + reach))
        while wp.bvh_query_next(query, k):
            if holds(members, begins, ends, k):
                t = faces[k]
                weight = weights_on_triangle(at, x[t[0]], x[t[1]], x[t[2]])
                displacement = at + weight[1] * x[t[0]] + weight[2] * x[t[1]] + weight[3] * x[t[2]]
                if wp.length(displacement) < least:
                    least = wp.length(displacement)
                    out[n] = displacement


def displacements_to(
    level: Level,
    x: Float[Tensor, "vertices 3"],
    queried: Int[Tensor, " queried"],
    rows: Int[Tensor, " queried"],
    sets: csr_matrix,
) -> Float[Tensor, "queried 3"]:
    """Displacements from the closest point of a set of faces to each query vertex [m], float64; 0 for empty sets.

    Args:
        x: Positions [m].
        queried: Indices of the query vertices.
        rows: The row of each query vertex's set.
        sets: Faces of each set, shape (sets, T).
    """
    at, device = x.double().contiguous(), level.device
    corners = at[level.triangles.long()]
    low, high = corners.amin(dim=1).float(), corners.amax(dim=1).float()
    rounding = 4.0 * torch.finfo(torch.float32).eps * corners.abs().amax()
    low, high = (low - rounding).contiguous(), (high + rounding).contiguous()
    tree = wp.Bvh(wp.from_torch(low, dtype=wp.vec3f), wp.from_torch(high, dtype=wp.vec3f))
    sets.sort_indices()
    begin, members = (
        wp.array(indices.astype(np.int32), dtype=wp.int32, device=device) for indices in (sets.indptr, sets.indices)
    )
    out = torch.zeros((len(queried), 3), dtype=torch.float64, device=device)
    inputs = [wp.from_torch(at, dtype=wp.vec3d), wp.from_torch(level.triangles.int().contiguous(), dtype=wp.vec3i)]
    inputs += [tree.id, *(wp.from_torch(indices.int().contiguous()) for indices in (queried, rows)), begin, members]
    inputs += [2.0 * float(level.spacing.mean()), wp.from_torch(out, dtype=wp.vec3d)]
    run(_closest_of, len(queried), inputs, device=device, threads=level.threads)
    return out
