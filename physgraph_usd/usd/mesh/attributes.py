"""Refines the attributes of a mesh: values on vertices, faces and corners, and subsets.

``refinements`` are those of the mesh, coarse to fine; without any, values, indices and subsets stay. Floating-point
values are interpolated linearly, in float64, and returned in their own type. For other types (integers, booleans,
strings) a fine element copies the value of its nearest parent: the parent of largest weight, then of lowest number.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from ...solver.mesh.subdivide import Refinement, compose, subdivide_times
from ...solver.mesh.topology import PolygonMesh, find_edges


def vertex_values(refinements: Sequence[Refinement], values: np.ndarray) -> np.ndarray:
    """Refine values on vertices (interpolation "vertex" or "varying"), shape (V, ...) to (V_fine, ...), type kept."""
    if not refinements:
        return np.asarray(values)
    stencil, values = compose(refinements), np.asarray(values)
    if np.issubdtype(values.dtype, np.floating):
        return interpolated(stencil, values)
    largest = np.repeat(np.maximum.reduceat(stencil.data, stencil.indptr[:-1]), np.diff(stencil.indptr))
    candidates = np.where(stencil.data >= largest * (1 - 1e-9), stencil.indices, np.iinfo(np.int32).max)
    return values[np.minimum.reduceat(candidates, stencil.indptr[:-1])]


def interpolated(stencil: sparse.csr_matrix, values: np.ndarray) -> np.ndarray:
    """Floating-point values by a stencil, shape (V, ...) to (V_fine, ...), type kept."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    return (stencil @ flat.astype(np.float64)).reshape(-1, *values.shape[1:]).astype(values.dtype)


def uniform_values(refinements: Sequence[Refinement], values: np.ndarray) -> np.ndarray:
    """Refine values on faces, shape (F, ...) to (F_fine, ...): a child has its parent's value."""
    for refinement in refinements:
        values = values[refinement.parent_face]
    return values


def corner_values(
    refinements: Sequence[Refinement], counts: np.ndarray, indices: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Refine indexed values on corners (interpolation "faceVarying"), such as texture coordinates.

    The values have their own topology, with seams preserved; the topology is split by the same rule, so faces and
    corners are in the order of the refined mesh.

    Args:
        counts: Corners per coarse face, shape (F,).
        indices: Value of each coarse corner, shape (C,).
        values: Shape (N, ...).

    Returns:
        Value of each fine corner, shape (C_fine,), int32, and the fine values, shape (N_fine, ...), of the same type.
    """
    topology = PolygonMesh(counts, indices, len(values))
    if not refinements:
        return topology.indices, values
    chain = subdivide_times(topology, len(refinements))
    return chain[-1].mesh.indices, vertex_values(chain, values)


def single_corners(counts: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Whether each corner's vertex differs from the previous corner's in the face, shape (C,)."""
    counts = np.asarray(counts, np.int64)
    ends = np.cumsum(counts)
    before = np.arange(-1, len(indices) - 1)
    before[(ends - counts)[counts > 0]] = ends[counts > 0] - 1
    return np.asarray(indices) != np.asarray(indices)[before]


def kept_corners(counts: np.ndarray, indices: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Numbers of the kept faces' corners, in order, without corners given twice in a row.

    Args:
        counts: Corners of each authored face, shape (F,).
        indices: Vertices of all corners, shape (C,).
        kept: Numbers of the kept faces, ascending.
    """
    of_kept = np.repeat(np.isin(np.arange(len(counts)), kept), counts)
    return np.flatnonzero(of_kept & single_corners(counts, indices))


def face_subset(refinements: Sequence[Refinement], faces: np.ndarray) -> np.ndarray:
    """The fine faces inside a subset of coarse faces, ascending, int32; a partition stays a partition."""
    if not refinements:
        return np.asarray(faces, np.int32)
    inside = np.isin(np.arange(refinements[0].parent_face.max() + 1), faces)
    return np.flatnonzero(uniform_values(refinements, inside)).astype(np.int32)


def vertex_subset(refinements: Sequence[Refinement], vertices: np.ndarray) -> np.ndarray:
    """The fine vertices with all parents inside a subset of coarse vertices, ascending, int32."""
    if not refinements:
        return np.asarray(vertices, np.int32)
    outside = np.ones(refinements[0].parent_vertex_count)
    outside[vertices] = 0.0
    return np.flatnonzero(compose(refinements) @ outside == 0.0).astype(np.int32)


def edge_subset(refinements: Sequence[Refinement], edges: np.ndarray) -> np.ndarray:
    """Refine a subset of edges, such as creases, by their vertices in either order, shape (K, 2).

    Returns:
        Fine edges, shape (K 2^levels, 2), int32: the parts of a coarse edge in its direction, in a row. Pairs that are
        no edge are skipped.
    """
    edges = np.asarray(edges, np.int32).reshape(-1, 2)
    for refinement in refinements:
        edge_numbers = find_edges(refinement.edges, edges)
        edges = edges[edge_numbers >= 0]
        middle = (refinement.parent_vertex_count + edge_numbers[edge_numbers >= 0]).astype(np.int32)
        edges = np.stack([edges[:, 0], middle, middle, edges[:, 1]], axis=1).reshape(-1, 2)
    return edges
