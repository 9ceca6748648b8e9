"""Parts of cloth and bodies, that is vertices, edges and faces, in clusters by distance at rest."""

# Warp's structs are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..colliders.base import Solid
from ..level import Level
from ..mesh.topology import find_edges, sorted_rows

LANES = 8
"""Parts in a block, compared at a time; native code in `boxes` is written for eight."""


class Part(IntEnum):
    """Kinds of parts."""

    VERTEX = 0
    EDGE = 1
    FACE = 2


@wp.struct
class Topology:
    """Parts by cluster, in blocks of `LANES`.

    A cluster's parts of a kind are the blocks from `first[kind * (clusters + 1) + cluster]` to the next entry. A part
    lists its corners, the last one repeated up to three; -1 fills incomplete blocks. Parts with a common corner in
    `labels`, which is equal for vertices sewn together, share a vertex. `number` is a part's index in its level.
    `first_corner` and `corners` are the distinct vertices of each cluster's parts. `meets` tells which garments
    collide with which. By vertex: `owner` is the garment, `rest` the position at rest. Bodies follow the `cloths`
    garments as further garments, and their clusters the `cloth_clusters`.
    """

    clusters: wp.int32
    cloth_clusters: wp.int32
    first: wp.array(dtype=wp.int32)
    parts: wp.array(dtype=wp.vec3i)
    labels: wp.array(dtype=wp.vec3i)
    number: wp.array(dtype=wp.int32)
    first_corner: wp.array(dtype=wp.int32)
    corners: wp.array(dtype=wp.int32)
    garment: wp.array(dtype=wp.int32)
    garments: wp.int32
    cloths: wp.int32
    meets: wp.array(dtype=wp.int32)
    owner: wp.array(dtype=wp.int32)
    rest: wp.array(dtype=wp.vec3d)


def topology_of(
    level: Level, meets: np.ndarray, label: np.ndarray, *, size: int, solids: Sequence[Solid] = ()
) -> tuple[Any, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Clusters of the parts of a level and of bodies.

    A face belongs to the cluster of its first corner, an edge to that of its first face.

    Args:
        meets: True for pairs in contact of garments, then bodies, symmetric, shape (G + B, G + B), bool.
        label: Cloth vertices with equal labels are sewn together, or equal, shape (V,).
        size: Most vertices of a cluster.

    Returns:
        A `Topology`; and edges, shape (E, 2), faces, shape (F, 3), and the edge along each side, shape (3 F,).
    """
    rest, edges, faces, garment, label = _with_solids(level, label, solids)
    cloths = len(level.spans)
    vertices, used = len(rest), np.flatnonzero(np.bincount(faces.ravel()))  # A vertex of no face is no cloth.
    cluster = np.zeros(vertices, np.int64)
    cluster[used] = halved(rest[used], garment[used], size)
    count = int(cluster[used].max(initial=-1)) + 1
    sides = find_edges(edges, faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
    of_face, of_edge = cluster[faces[:, 0]], np.zeros(len(edges), np.int64)
    of_edge[sides[::-1]] = np.repeat(of_face, 3)[::-1]  # The last value written stays.
    kinds = ((cluster[used], np.stack([used] * 3, axis=1)), (of_edge, edges[:, [0, 1, 1]]), (of_face, faces))
    first, parts, number = zip(*(_blocks(of, corners, count) for of, corners in kinds), strict=True)
    begin = np.cumsum([0, *(blocks[-1] for blocks in first)])
    of = np.concatenate([np.repeat(of, 3) for of, _ in kinds])
    corners = np.concatenate([corners.ravel() for _, corners in kinds])
    inside = sp.csr_matrix((np.ones(len(of), bool), (of, corners)), shape=(count, vertices))
    table, device = Topology(), level.device

    def array(values: np.ndarray, dtype: type = wp.int32) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=dtype, device=device)

    table.clusters, table.garments, table.cloths = count, len(meets), cloths
    table.cloth_clusters = int(cluster[used][garment[used] < cloths].max(initial=-1)) + 1
    table.first = array(np.concatenate([blocks + start for blocks, start in zip(first, begin, strict=False)]))
    corners = np.concatenate(parts)
    table.parts, table.number = array(corners, wp.vec3i), array(np.concatenate(number))
    table.labels = array(np.where(corners < 0, -1, label[corners]), wp.vec3i)
    table.first_corner, table.corners = array(inside.indptr), array(inside.indices)
    by_cluster = np.zeros(count, np.int32)
    by_cluster[cluster[used]] = garment[used]
    table.garment, table.owner = array(by_cluster), array(garment)
    table.meets = array(np.asarray(meets).ravel())
    table.rest = wp.array(rest, dtype=wp.vec3d, device=device)
    return table, (edges, faces, sides)


def _with_solids(
    level: Level, label: np.ndarray, solids: Sequence[Solid]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Positions, edges, faces, garments and labels of the cloth at rest and of bodies, which follow as garments."""
    rest, garment = level.rest.double().cpu().numpy(), level.vertex_garment.cpu().numpy()
    edges, faces = (rows.cpu().numpy().astype(np.int64) for rows in (level.edges, level.triangles))
    points = np.concatenate([rest, *(solid.points for solid in solids)])
    starts = np.cumsum([len(rest), *(len(solid.points) for solid in solids)])
    edges = np.concatenate([edges, *(solid.edges + start for solid, start in zip(solids, starts, strict=False))])
    faces = np.concatenate([faces, *(solid.faces + start for solid, start in zip(solids, starts, strict=False))])
    body = np.repeat(np.arange(len(solids)), np.diff(starts))
    label = np.concatenate([label, np.arange(len(rest), len(points))])
    return points, edges, faces, np.concatenate([garment, len(level.spans) + body]), label


def halved(points: np.ndarray, group: np.ndarray, size: int) -> np.ndarray:
    """Cluster of each point: groups are halved across their longest axis until no cluster is larger than a size.

    Args:
        points: Points, shape (N, 3).
        group: Points of different groups share no cluster, shape (N,), not negative.
        size: Most points of a cluster.

    Returns:
        Clusters from 0 in the order of the halves, so that clusters with consecutive numbers are near, shape (N,).
    """
    count, label = np.bincount(group), group
    sorts = [_sorted(column) for column in points.T]
    while True:
        sorts = [order[sorted_rows(label[order], count=len(count))] for order in sorts]
        count = count[count > 0]
        if count.max(initial=0) <= size:
            break
        last = np.cumsum(count) - 1
        ends = [points[order[[last + 1 - count, last]], axis] for axis, order in enumerate(sorts)]
        longest = np.argmax([high - low for low, high in ends], axis=0)
        order = np.choose(np.repeat(longest, count), sorts)
        later = np.where(count > size, count // 2, 0)
        count = np.stack([count - later, later], axis=1).ravel()
        label = np.empty(len(points), np.int64)
        label[order] = np.repeat(np.arange(len(count)), count)
    cluster = np.empty(len(points), np.int64)
    cluster[sorts[0]] = np.repeat(np.arange(len(count)), count)
    return cluster


def _sorted(values: np.ndarray) -> np.ndarray:
    """Indices that sort finite values, stably: two unstable sorts are faster than numpy's stable sort."""
    order = np.argsort(values)
    values = values[order]
    rank = np.cumsum(np.append(False, values[1:] != values[:-1])[: len(order)])
    return np.sort(rank * len(order) + order) - rank * len(order)


def _blocks(cluster: np.ndarray, corners: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First block of each cluster, corners of the parts in blocks, and the parts' numbers; -1 fills the blocks."""
    size = np.bincount(cluster, minlength=count)
    first = np.concatenate([[0], np.cumsum((size + LANES - 1) // LANES)])
    order = sorted_rows(cluster, count=count)
    owner = cluster[order]
    row = LANES * first[owner] + np.arange(len(order)) - (np.cumsum(size) - size)[owner]
    parts, number = np.full((LANES * first[-1], 3), -1), np.full(LANES * first[-1], -1)
    parts[row], number[row] = corners[order], order
    return first, parts, number
