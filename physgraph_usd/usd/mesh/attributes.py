"""Refines the attributes of a mesh: values on vertices, faces and corners, and subsets.

Floating-point values are interpolated linearly, in float64, and returned in their own type. For other types (integers,
booleans, strings) a fine element copies the value of its nearest parent: the parent of largest weight, then of lowest
number.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from ...solver.mesh.subdivide import Refinement, compose, subdivide_times
from ...solver.mesh.topology import PolygonMesh, find_edges


def vertex_values(refinements: Sequence[Refinement], values: np.ndarray) -> np.ndarray:
    """Refine values on vertices (interpolation "vertex" or "varying").

    Args:
        refinements: Coarse to fine; if empty, the values are returned.
        values: One per coarse vertex, shape (V, ...).

    Returns:
        One per fine vertex, shape (V_fine, ...), of the same type.

    Raises:
        ValueError: The number of values is not the number of coarse vertices.
    """
    values = np.asarray(values)
    if not refinements:
        return values
    _check_count("values", len(values), refinements[0].parent_vertex_count, "vertices")
    stencil = compose(refinements)
    if not np.issubdtype(values.dtype, np.floating):
        return values[_nearest_parent(stencil)]
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    fine = stencil @ flat.astype(np.float64)
    return fine.reshape(len(fine), *values.shape[1:]).astype(values.dtype)


def _nearest_parent(stencil: sparse.csr_matrix) -> np.ndarray:
    """Column of the largest weight of each row, the lowest among equals, shape (rows,)."""
    largest = np.repeat(np.maximum.reduceat(stencil.data, stencil.indptr[:-1]), np.diff(stencil.indptr))
    candidates = np.where(stencil.data >= largest * (1 - 1e-9), stencil.indices, np.iinfo(np.int32).max)
    return np.minimum.reduceat(candidates, stencil.indptr[:-1])


def parent_faces(refinements: Sequence[Refinement]) -> np.ndarray:
    """Coarse face of each fine face, through all levels.

    Args:
        refinements: One or more, coarse to fine.

    Returns:
        Shape (F_fine,), int32, ascending.
    """
    parents = refinements[-1].parent_face
    for refinement in reversed(refinements[:-1]):
        parents = refinement.parent_face[parents]
    return parents


def uniform_values(refinements: Sequence[Refinement], values: np.ndarray) -> np.ndarray:
    """Refine values on faces: a child has its parent's value.

    Args:
        refinements: Coarse to fine; if empty, the values are returned.
        values: One per coarse face, shape (F, ...).

    Returns:
        One per fine face, shape (F_fine, ...).

    Raises:
        ValueError: There are fewer values than parents.
    """
    values = np.asarray(values)
    if not refinements:
        return values
    parents = parent_faces(refinements)
    if len(parents) and len(values) <= parents[-1]:
        raise ValueError(f"{len(values)} values for {parents[-1] + 1} or more faces")
    return values[parents]


def corner_values(
    refinements: Sequence[Refinement], counts: np.ndarray, indices: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Refine indexed values on corners (interpolation "faceVarying"), such as texture coordinates.

    The values have their own topology, with seams preserved; the topology is split by the same rule, so faces and
    corners are in the order of the refined mesh.

    Args:
        refinements: Refinements of the mesh, coarse to fine; if empty, indices and values are returned.
        counts: Corners per coarse face, shape (F,).
        indices: Value of each coarse corner, shape (C,).
        values: Shape (N, ...).

    Returns:
        Value of each fine corner, shape (C_fine,), int32, and the fine values, shape (N_fine, ...), of the same type.

    Raises:
        ValueError: An index is out of range, or the faces do not match the refined mesh.
    """
    values = np.asarray(values)
    topology = PolygonMesh(counts, indices, len(values))
    if not refinements:
        return topology.indices, values
    chain = subdivide_times(topology, len(refinements))
    if not np.array_equal(chain[-1].mesh.counts, refinements[-1].mesh.counts):
        raise ValueError(f"corner values for {topology.face_count} faces do not fit the faces of the refined mesh")
    return chain[-1].mesh.indices, vertex_values(chain, values)


def face_subset(refinements: Sequence[Refinement], faces: np.ndarray) -> np.ndarray:
    """Refine a subset of faces; a partition stays a partition.

    Args:
        refinements: Coarse to fine; if empty, the faces are returned.
        faces: Coarse faces, shape (K,).

    Returns:
        The fine faces inside, ascending, int32.
    """
    if not refinements:
        return np.asarray(faces, np.int32)
    return np.flatnonzero(np.isin(parent_faces(refinements), faces)).astype(np.int32)


def vertex_subset(refinements: Sequence[Refinement], vertices: np.ndarray) -> np.ndarray:
    """Refine a subset of vertices.

    Args:
        refinements: Coarse to fine; if empty, the vertices are returned.
        vertices: Coarse vertices, shape (K,).

    Returns:
        The fine vertices with all parents inside, ascending, int32.

    Raises:
        ValueError: A vertex is out of range.
    """
    vertices = np.asarray(vertices, np.int32).reshape(-1)
    if not refinements:
        return vertices
    count = refinements[0].parent_vertex_count
    bad = vertices[(vertices < 0) | (vertices >= count)]
    if len(bad):
        raise ValueError(f"the subset names vertex {bad[0]}, but the mesh has {count} vertices")
    outside = np.ones(count)
    outside[vertices] = 0.0
    return np.flatnonzero(compose(refinements) @ outside == 0.0).astype(np.int32)


def edge_subset(refinements: Sequence[Refinement], edges: np.ndarray) -> np.ndarray:
    """Refine a subset of edges, such as creases.

    Args:
        refinements: Coarse to fine; if empty, the edges are returned.
        edges: Coarse edges by their vertices, in either order, shape (K, 2). Pairs that are no edge are skipped.

    Returns:
        Fine edges by their vertices, shape (K 2^levels, 2), int32; the parts of a coarse edge in its direction, in a
        row.
    """
    edges = np.asarray(edges, np.int32).reshape(-1, 2)
    for refinement in refinements:
        found = find_edges(refinement.edges, edges)
        edges = edges[found >= 0]
        middle = (refinement.parent_vertex_count + found[found >= 0]).astype(np.int32)
        edges = np.stack([edges[:, 0], middle, middle, edges[:, 1]], axis=1).reshape(-1, 2)
    return edges


def _check_count(what: str, found: int, wanted: int, elements: str) -> None:
    """Raise unless both numbers agree."""
    if found != wanted:
        raise ValueError(f"{found} {what} for {wanted} {elements}")
