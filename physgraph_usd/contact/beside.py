"""What lies beside each vertex: of every cluster with such parts, a bit for each of its faces and each of its edges.

Nearly all parts within reach of a vertex are its neighbours, which are no pairs with it. A bit tells so at once, where
comparing corners with the vertex's ring takes most of a query's time.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportIndexIssue=false
from __future__ import annotations

from itertools import pairwise

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..collide.cluster_kernels import has

wp.set_module_options({"enable_backward": False})

BLOCK = 1 << 20
"""Parts looked at together: round the middle of a face of 2,000 corners everything is beside everything."""
BITS = 64
"""Parts of a cluster that bits tell of; those after them are compared by their corners."""


def beside_table(
    beside: sp.csr_matrix, corners: np.ndarray, first: np.ndarray, *, device: str
) -> tuple[wp.array, wp.array, wp.array]:
    """The parts of clusters that have a vertex itself, or a neighbour of it, as a corner.

    Args:
        beside: Adjacency of the vertices, shape (V, V).
        corners: Corners of the parts in the clusters' order, shape (N, 2) or (N, 3).
        first: The first part of each cluster, and N, shape (clusters + 1,).
        device: "cpu" or a CUDA device.

    Returns:
        Where each vertex's entries begin, shape (V + 1,); and of each entry the cluster, and the bits of its parts.
    """
    count, parts = beside.shape[0], len(corners)
    places = (corners.ravel(), np.repeat(np.arange(parts, dtype=np.int32), corners.shape[1]))
    of_vertex = sp.csr_matrix((np.ones(corners.size, np.int32), places), shape=(count, parts))
    around = sp.csr_matrix((beside + sp.identity(count, dtype=beside.dtype, format="csr")).astype(np.int32))
    cluster = np.repeat(np.arange(len(first) - 1, dtype=np.int32), np.diff(first))
    found = np.cumsum(around @ np.diff(of_vertex.indptr))
    ends = np.unique([*np.searchsorted(found, np.arange(BLOCK, found[-1] if count else 0, BLOCK)), count])
    blocks = [_entries(around[a:b] @ of_vertex, cluster, first) for a, b in pairwise([0, *ends]) if b > a] or [
        (np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0, np.uint64))
    ]
    entries, clusters, masks = (np.concatenate(each) for each in zip(*blocks, strict=True))
    starts = np.concatenate([[0], np.cumsum(entries)]).astype(np.int32)
    return (
        wp.array(starts, dtype=wp.int32, device=device),
        wp.array(clusters, dtype=wp.int32, device=device),
        wp.array(masks, dtype=wp.uint64, device=device),
    )


def _entries(rows: sp.csr_matrix, cluster: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The number of entries of each of some vertices; and of each entry the cluster, and the bits of its parts.

    Args:
        rows: Parts beside each of the vertices, shape (vertices, N).
        cluster: The cluster of each part, shape (N,), int32.
        first: The first part of each cluster.
    """
    rows.sort_indices()
    vertex, of_part = np.repeat(np.arange(rows.shape[0]), np.diff(rows.indptr)), cluster[rows.indices]
    place = rows.indices - first[of_part]
    bits = np.where(place < BITS, np.uint64(1) << np.minimum(place, BITS - 1).astype(np.uint64), np.uint64(0))
    begins = np.flatnonzero(np.diff(vertex, prepend=-1) | np.diff(of_part, prepend=-1))
    masks = np.bitwise_or.reduceat(bits, begins) if len(begins) else bits
    return np.bincount(vertex[begins], minlength=rows.shape[0]), of_part[begins], masks


@wp.kernel
def add_neighbours(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    beside: wp.array(dtype=wp.int32),
    given: wp.array(dtype=wp.bool),
    out: wp.array(dtype=wp.bool),
):
    """Add the neighbours of given vertices to those in ``out``."""
    v = first + wp.tid()
    if given[v]:
        for k in range(starts[v], starts[v + 1]):
            out[beside[k]] = True


@wp.func
def bits_beside(
    v: wp.int32,
    j: wp.int32,
    entries: wp.array(dtype=wp.int32),
    cluster: wp.array(dtype=wp.int32),
    bits: wp.array(dtype=wp.uint64),
):
    """Which of the first parts of a cluster lie beside a vertex; its entries are sorted, for some have thousands."""
    end = entries[v + 1]
    k = wp.lower_bound(cluster, entries[v], end, j)
    if k < end and cluster[k] == j:
        return bits[k]
    return wp.uint64(0)


@wp.func
def is_set(bits: wp.uint64, place: wp.int32):
    """Whether a bit is."""
    return ((bits >> wp.uint64(place)) & wp.uint64(1)) == wp.uint64(1)


@wp.func
def bits_of_edge(
    e: wp.vec2i,
    j: wp.int32,
    entries: wp.array(dtype=wp.int32),
    cluster: wp.array(dtype=wp.int32),
    bits: wp.array(dtype=wp.uint64),
):
    """Which of the first parts of a cluster lie beside an end of an edge."""
    return bits_beside(e[0], j, entries, cluster, bits) | bits_beside(e[1], j, entries, cluster, bits)


@wp.func
def is_beside(v: wp.int32, u: wp.int32, starts: wp.array(dtype=wp.int32), ring: wp.array(dtype=wp.int32)):
    """Whether u is v or a neighbour of v."""
    found = v == u
    for k in range(starts[v], starts[v + 1]):
        if ring[k] == u:
            found = True
    return found


@wp.func
def are_beside(e: wp.vec2i, g: wp.vec2i, starts: wp.array(dtype=wp.int32), ring: wp.array(dtype=wp.int32)):
    """Whether two edges share a vertex or are joined by an edge."""
    of_first = is_beside(e[0], g[0], starts, ring) or is_beside(e[0], g[1], starts, ring)
    return of_first or is_beside(e[1], g[0], starts, ring) or is_beside(e[1], g[1], starts, ring)


@wp.func
def is_face_beside(v: wp.int32, t: wp.vec3i, starts: wp.array(dtype=wp.int32), ring: wp.array(dtype=wp.int32)):
    """Whether a neighbour of v is a corner of a triangle."""
    for k in range(starts[v], starts[v + 1]):
        if has(t, ring[k]):
            return True
    return False


@wp.func
def is_own_face(
    known: wp.uint64,
    m: wp.int32,
    first: wp.int32,
    v: wp.int32,
    triangles: wp.array(dtype=wp.vec3i),
    starts: wp.array(dtype=wp.int32),
    beside: wp.array(dtype=wp.int32),
):
    """Whether a face of a cluster has v or a neighbour of it as a corner."""
    if m - first < BITS:
        return is_set(known, m - first)
    return has(triangles[m], v) or is_face_beside(v, triangles[m], starts, beside)


@wp.func
def is_own_edge(
    known: wp.uint64,
    m: wp.int32,
    first: wp.int32,
    e: wp.vec2i,
    edges: wp.array(dtype=wp.vec2i),
    starts: wp.array(dtype=wp.int32),
    beside: wp.array(dtype=wp.int32),
):
    """Whether an edge of a cluster shares a vertex with another or is joined to it by an edge."""
    if m - first < BITS:
        return is_set(known, m - first)
    return are_beside(e, edges[m], starts, beside)
