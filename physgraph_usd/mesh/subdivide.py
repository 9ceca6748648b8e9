"""Subdivision of polygon meshes by sparse stencils, built once per topology.

Each face is split by its own rule, so meshes of triangles, quads and larger polygons conform: a triangle into four
triangles, any other polygon into quads around its centroid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from scipy import sparse

from .topology import PolygonMesh


@dataclass(frozen=True, eq=False)
class Refinement:
    """One subdivision step.

    Attributes:
        mesh: The child. Its vertices are the parent's vertices, then one per parent edge, then one per parent polygon
            of four or more corners, in face order. The children of a face lie side by side, in the parent's face order.
        linear: Placement at vertices, midpoints and centroids, shape (V_child, V_parent), float64; rows sum to 1.
        parent_face: Parent of each child face, shape (F_child,), int32.
        edges: Parent edges (lo, hi), shape (E, 2), int32; child vertex ``V_parent + e`` is the midpoint of edge e.
    """

    mesh: PolygonMesh
    linear: sparse.csr_matrix
    parent_face: np.ndarray
    edges: np.ndarray


def subdivide(mesh: PolygonMesh) -> Refinement:
    """Split every face once.

    A triangle (a, b, c) becomes (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca); corner i of a polygon becomes the
    quad (v_i, e_i, centre, e_{i-1}). Winding is kept. Faces under three corners have no children. Non-manifold edges,
    isolated vertices and repeated vertices are allowed.

    Args:
        mesh: The parent.

    Returns:
        The child and its stencil.

    Raises:
        ValueError: An index is out of range.
    """
    mesh.check_range()
    half = mesh.half_edges
    polygon = mesh.counts >= 4
    child_count = np.where(polygon, mesh.counts, np.where(mesh.counts == 3, 4, 0))
    child_size = np.where(polygon, 4, 3)
    starts = np.concatenate([[0], np.cumsum(child_count * child_size, dtype=np.int64)])
    indices = np.empty(int(starts[-1]), np.int32)
    midpoint = (mesh.vertex_count + half.edge).astype(np.int32)
    _place_triangles(mesh, midpoint, starts, indices)
    _place_quads(mesh, midpoint, starts, indices)
    vertex_count = mesh.vertex_count + len(half.edges) + int(polygon.sum())
    child = PolygonMesh(np.repeat(child_size, child_count), indices, vertex_count)
    parent_face = np.repeat(np.arange(mesh.face_count, dtype=np.int32), child_count)
    return Refinement(child, _linear(mesh), parent_face, half.edges)


def _place_triangles(mesh: PolygonMesh, midpoint: np.ndarray, starts: np.ndarray, indices: np.ndarray) -> None:
    """Write the children of triangles into ``indices``."""
    faces = np.flatnonzero(mesh.counts == 3)
    corners = mesh.starts[faces, None] + np.arange(3)
    a, b, c = mesh.indices[corners].T
    ab, bc, ca = midpoint[corners].T
    children = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1)
    indices[starts[faces, None] + np.arange(12)] = children


def _place_quads(mesh: PolygonMesh, midpoint: np.ndarray, starts: np.ndarray, indices: np.ndarray) -> None:
    """Write the children of polygons into ``indices``."""
    corners = np.flatnonzero((mesh.counts >= 4)[mesh.corner_face])
    face = mesh.corner_face[corners]
    quads = np.stack(
        [
            mesh.indices[corners],
            midpoint[corners],
            face_points(mesh)[face],
            midpoint[mesh.previous_corner[corners]],
        ],
        axis=1,
    )
    local = corners - mesh.starts[face]
    indices[(starts[face] + 4 * local)[:, None] + np.arange(4)] = quads


def face_points(mesh: PolygonMesh) -> np.ndarray:
    """Child vertex at the centre of each parent face, shape (F,), int32; -1 for faces under four corners."""
    polygon = mesh.counts >= 4
    first = mesh.vertex_count + len(mesh.half_edges.edges)
    return np.where(polygon, first + np.cumsum(polygon) - 1, -1).astype(np.int32)


def _linear(mesh: PolygonMesh) -> sparse.csr_matrix:
    """Stencil of vertices, midpoints and centroids."""
    edges = mesh.half_edges.edges
    sizes = mesh.counts[mesh.counts >= 4]
    columns = np.concatenate(
        [np.arange(mesh.vertex_count), edges.reshape(-1), mesh.indices[(mesh.counts >= 4)[mesh.corner_face]]]
    )
    lengths = np.concatenate([np.ones(mesh.vertex_count, np.int64), np.full(len(edges), 2), sizes])
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    weights = np.repeat(1.0 / lengths, lengths)
    matrix = sparse.csr_matrix((weights, columns, offsets), shape=(len(lengths), mesh.vertex_count))
    matrix.sum_duplicates()
    return matrix


def subdivide_times(mesh: PolygonMesh, levels: int) -> tuple[Refinement, ...]:
    """Subdivide repeatedly.

    Args:
        mesh: The coarsest mesh.
        levels: Number of steps, 0 or more.

    Returns:
        One refinement per step, coarse to fine.

    Raises:
        ValueError: ``levels`` is negative, or an index is out of range.
    """
    if levels < 0:
        raise ValueError(f"levels is {levels}; it must be 0 or more")
    refinements: list[Refinement] = []
    for _ in range(levels):
        refinements.append(subdivide(refinements[-1].mesh if refinements else mesh))
    return tuple(refinements)


def compose(refinements: Sequence[Refinement]) -> sparse.csr_matrix:
    """Multiply the linear stencils of successive refinements.

    Args:
        refinements: One or more, coarse to fine.

    Returns:
        The stencil from the coarsest to the finest vertices, shape (V_fine, V_coarse); rows sum to 1.

    Raises:
        ValueError: There is no refinement.
    """
    if not refinements:
        raise ValueError("no refinements to compose; the stencil of level 0 is the identity")
    return reduce(lambda product, refinement: refinement.linear @ product, refinements[1:], refinements[0].linear)
