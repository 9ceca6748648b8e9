"""What clusters of faces know of themselves, which of them may meet, and which edges pass through which faces."""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

import warp as wp

from ..mesh.piercing import passes_through

wp.set_module_options({"enable_backward": False})

FAR = 1e30
"""Corner of a box that holds nothing."""
SLOTS = 4
"""Faces kept for each edge that passes through some."""


@wp.func
def has(t: wp.vec3i, v: wp.int32):
    """Whether a triangle has a vertex."""
    return t[0] == v or t[1] == v or t[2] == v


@wp.func
def overlap(low: wp.vec3f, high: wp.vec3f, other_low: wp.vec3f, other_high: wp.vec3f):
    """Whether two boxes meet; all six comparisons are made, for a wrong guess at a branch costs more."""
    first = wp.where(low[0] <= other_high[0], 1, 0) & wp.where(low[1] <= other_high[1], 1, 0)
    second = wp.where(low[2] <= other_high[2], 1, 0) & wp.where(other_low[0] <= high[0], 1, 0)
    third = wp.where(other_low[1] <= high[1], 1, 0) & wp.where(other_low[2] <= high[2], 1, 0)
    return (first & second & third) == 1


@wp.func
def are_apart(
    i: wp.int32,
    j: wp.int32,
    garment: wp.array(dtype=wp.int32),
    ring_starts: wp.array(dtype=wp.int32),
    ring: wp.array(dtype=wp.int32),
    turns: wp.array(dtype=wp.int32),
    around: wp.array(dtype=wp.int32),
    meets: wp.array(dtype=wp.int32),
    garments: wp.int32,
    reach: wp.float32,
):
    """Whether two clusters cannot come nearer than a reach, by what feels what and by what does not turn over.

    Those of a ring that does not turn over do not touch. They may come near: there, no ring round one may turn over.
    Rings are sorted: at a face of thousands of corners they hold all of its clusters.
    """
    if meets[garment[i] * garments + garment[j]] == 0:
        return True
    if reach > 0.0 and around[i] + around[j] == 2:
        return False
    for k in range(ring_starts[i], ring_starts[i + 1]):
        middle = ring[k]
        if turns[middle] == 0:
            end = ring_starts[middle + 1]
            place = wp.lower_bound(ring, ring_starts[middle], end, j)
            if place < end and ring[place] == j:
                return True
    return False


@wp.kernel
def cluster_boxes(
    first: wp.int32,
    x: wp.array(dtype=wp.vec3f),
    faces: wp.array(dtype=wp.int32),
    triangles: wp.array(dtype=wp.vec3i),
    face_low: wp.array(dtype=wp.vec3f),
    face_high: wp.array(dtype=wp.vec3f),
    normal: wp.array(dtype=wp.vec3f),
    low: wp.array(dtype=wp.vec3f),
    high: wp.array(dtype=wp.vec3f),
    total: wp.array(dtype=wp.vec3f),
):
    """The boxes and unit normals of a cluster's faces, the box of all of them, and their areas along the normals."""
    i = first + wp.tid()
    least = wp.vec3f(FAR)
    most = wp.vec3f(-FAR)
    area = wp.vec3f(0.0)
    for k in range(faces[i], faces[i + 1]):
        p, q, r = x[triangles[k][0]], x[triangles[k][1]], x[triangles[k][2]]
        lower, upper = wp.min(p, wp.min(q, r)), wp.max(p, wp.max(q, r))
        own = wp.cross(q - p, r - p)
        face_low[k] = lower
        face_high[k] = upper
        normal[k] = wp.normalize(own)
        least = wp.min(least, lower)
        most = wp.max(most, upper)
        area += own
    low[i] = least
    high[i] = most
    total[i] = area


@wp.kernel
def edge_boxes(
    first: wp.int32,
    x: wp.array(dtype=wp.vec3f),
    first_edge: wp.array(dtype=wp.int32),
    edges: wp.array(dtype=wp.vec2i),
    edge_low: wp.array(dtype=wp.vec3f),
    edge_high: wp.array(dtype=wp.vec3f),
):
    """The boxes of a cluster's edges."""
    i = first + wp.tid()
    for k in range(first_edge[i], first_edge[i + 1]):
        a, b = x[edges[k][0]], x[edges[k][1]]
        edge_low[k] = wp.min(a, b)
        edge_high[k] = wp.max(a, b)


@wp.kernel
def clusters_meet(
    first: wp.int32,
    tree: wp.uint64,
    low: wp.array(dtype=wp.vec3f),
    high: wp.array(dtype=wp.vec3f),
    garment: wp.array(dtype=wp.int32),
    ring_starts: wp.array(dtype=wp.int32),
    ring: wp.array(dtype=wp.int32),
    turns: wp.array(dtype=wp.int32),
    around: wp.array(dtype=wp.int32),
    meets: wp.array(dtype=wp.int32),
    garments: wp.int32,
    reach: wp.float32,
    first_face: wp.array(dtype=wp.int32),
    triangles: wp.array(dtype=wp.vec3i),
    busy: wp.array(dtype=wp.bool),
):
    """Mark the corners of a cluster's faces where it may come nearer to another, or to itself, than a reach."""
    i = first + wp.tid()
    if low[i][0] > high[i][0]:
        return
    grow = wp.vec3f(reach)
    query = wp.bvh_query_aabb(tree, low[i] - grow, high[i] + grow)
    j = wp.int32(0)
    found = wp.int32(0)
    while wp.bvh_query_next(query, j):
        if not are_apart(i, j, garment, ring_starts, ring, turns, around, meets, garments, reach):
            found = 1
            break
    if found == 1:
        for m in range(first_face[i], first_face[i + 1]):
            for corner in range(3):
                busy[triangles[m][corner]] = True


@wp.kernel
def clusters_beside(
    first: wp.int32,
    tree: wp.uint64,
    low: wp.array(dtype=wp.vec3f),
    high: wp.array(dtype=wp.vec3f),
    garment: wp.array(dtype=wp.int32),
    ring_starts: wp.array(dtype=wp.int32),
    ring: wp.array(dtype=wp.int32),
    turns: wp.array(dtype=wp.int32),
    around: wp.array(dtype=wp.int32),
    meets: wp.array(dtype=wp.int32),
    garments: wp.int32,
    reach: wp.float32,
    given: wp.array(dtype=wp.bool),
    first_face: wp.array(dtype=wp.int32),
    triangles: wp.array(dtype=wp.vec3i),
    beside: wp.array(dtype=wp.bool),
):
    """Mark the corners of the faces of all clusters whose boxes are within reach of one with a given vertex."""
    i = first + wp.tid()
    found = wp.int32(0)
    for m in range(first_face[i], first_face[i + 1]):
        for corner in range(3):
            if given[triangles[m][corner]]:
                found = 1
    if found == 0:
        return
    grow = wp.vec3f(reach)
    query = wp.bvh_query_aabb(tree, low[i] - grow, high[i] + grow)
    j = wp.int32(0)
    while wp.bvh_query_next(query, j):
        for m in range(first_face[j], first_face[j + 1]):
            for corner in range(3):
                beside[triangles[m][corner]] = True


@wp.kernel
def rings_turn(
    first: wp.int32,
    ring_starts: wp.array(dtype=wp.int32),
    ring: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    normal: wp.array(dtype=wp.vec3f),
    total: wp.array(dtype=wp.vec3f),
    turned: wp.float32,
    turns: wp.array(dtype=wp.int32),
):
    """Whether a face of the ring of clusters round each is farther from the ring's mean normal than a cosine."""
    i = first + wp.tid()
    mean = wp.vec3f(0.0)
    for k in range(ring_starts[i], ring_starts[i + 1]):
        mean += total[ring[k]]
    mean = wp.normalize(mean)
    least = wp.float32(1.0)
    for k in range(ring_starts[i], ring_starts[i + 1]):
        for m in range(starts[ring[k]], starts[ring[k] + 1]):
            least = wp.min(least, wp.dot(normal[m], mean))
    turns[i] = wp.where(least > turned, 0, 1)


@wp.kernel
def any_of_ring(
    first: wp.int32,
    ring_starts: wp.array(dtype=wp.int32),
    ring: wp.array(dtype=wp.int32),
    flag: wp.array(dtype=wp.int32),
    out: wp.array(dtype=wp.int32),
):
    """Whether a cluster of the ring round each is flagged."""
    i = first + wp.tid()
    found = wp.int32(0)
    for k in range(ring_starts[i], ring_starts[i + 1]):
        found = wp.max(found, flag[ring[k]])
    out[i] = found


@wp.kernel
def pierced(  # noqa: C901, PLR0912 - one query, each candidate refused as early as can be
    first: wp.int32,
    tree: wp.uint64,
    low: wp.array(dtype=wp.vec3f),
    high: wp.array(dtype=wp.vec3f),
    cluster_garment: wp.array(dtype=wp.int32),
    ring_starts: wp.array(dtype=wp.int32),
    ring: wp.array(dtype=wp.int32),
    turns: wp.array(dtype=wp.int32),
    around: wp.array(dtype=wp.int32),
    meets: wp.array(dtype=wp.int32),
    garments: wp.int32,
    threads: wp.int32,
    x: wp.array(dtype=wp.vec3f),
    asked: wp.array(dtype=wp.bool),
    first_edge: wp.array(dtype=wp.int32),
    edges: wp.array(dtype=wp.vec2i),
    edge_number: wp.array(dtype=wp.int32),
    edge_low: wp.array(dtype=wp.vec3f),
    edge_high: wp.array(dtype=wp.vec3f),
    first_face: wp.array(dtype=wp.int32),
    triangles: wp.array(dtype=wp.vec3i),
    number: wp.array(dtype=wp.int32),
    face_low: wp.array(dtype=wp.vec3f),
    face_high: wp.array(dtype=wp.vec3f),
    count: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec4i),
):
    """For each edge of a cluster with an end asked, how many faces it passes through, and the first of them."""
    i = (first + wp.tid()) / threads
    begin, end = first_edge[i] + (first + wp.tid()) % threads, first_edge[i + 1]
    least = wp.vec3f(FAR)
    most = wp.vec3f(-FAR)
    for k in range(begin, end, threads):
        a, b = edges[k][0], edges[k][1]
        if asked[a] or asked[b]:
            least = wp.min(least, edge_low[k])
            most = wp.max(most, edge_high[k])
    if least[0] > most[0]:
        return
    query = wp.bvh_query_aabb(tree, least, most)
    j = wp.int32(0)
    while wp.bvh_query_next(query, j):
        if are_apart(i, j, cluster_garment, ring_starts, ring, turns, around, meets, garments, 0.0):
            continue
        for k in range(begin, end, threads):
            a, b = edges[k][0], edges[k][1]
            if not (asked[a] or asked[b]):
                continue
            lower, upper = edge_low[k], edge_high[k]
            if not overlap(lower, upper, low[j], high[j]):
                continue
            for m in range(first_face[j], first_face[j + 1]):
                if not overlap(lower, upper, face_low[m], face_high[m]):
                    continue
                t = triangles[m]
                if has(t, a) or has(t, b):
                    continue
                if passes_through(x, edges[k], t):
                    e = edge_number[k]
                    if count[e] < SLOTS:
                        listed = faces[e]
                        listed[count[e]] = number[m]
                        faces[e] = listed
                    count[e] = count[e] + 1
