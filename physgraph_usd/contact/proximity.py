"""Which parts of the cloth are near which, and which edges pass through which faces: one hierarchy a level.

Queries are exact for what is asked: the closest face above and below a vertex, the closest edge above and below an
edge. Parts that share a corner, or are one edge apart, are no pairs.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

import warp as wp

from ..mesh.piercing import passes_through

LEAST = 1e-9
"""Distance under which two parts have no direction from one to the other [m]."""
IN_PLANE = 0.5
"""Cosine to the normal under which a neighbour lies in the plane of the cloth rather than above or below it."""
CLOSED_IN = 0.5
"""Distance over rest distance above which such a neighbour is where it belongs."""
SLOTS = 4
"""Faces kept for each edge that passes through some."""


@wp.func
def closest_on_triangle(p: wp.vec3f, a: wp.vec3f, b: wp.vec3f, c: wp.vec3f):  # noqa: PLR0911 - one region each
    """Barycentric coordinates of the closest point (Ericson 2005, 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = wp.dot(ab, ap), wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.vec3f(1.0, 0.0, 0.0)
    bp = p - b
    d3, d4 = wp.dot(ab, bp), wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return wp.vec3f(0.0, 1.0, 0.0)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        return wp.vec3f(1.0 - v, v, 0.0)
    cp = p - c
    d5, d6 = wp.dot(ab, cp), wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return wp.vec3f(0.0, 0.0, 1.0)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        return wp.vec3f(1.0 - w, 0.0, w)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3f(0.0, 1.0 - w, w)
    total = va + vb + vc
    return wp.vec3f(va / total, vb / total, vc / total)


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
def is_inside(s: float, t: float):
    """Whether both places are inside their edges."""
    return s > 0.0 and s < 1.0 and t > 0.0 and t < 1.0


@wp.func
def between(x: wp.array(dtype=wp.vec3f), e: wp.vec2i, g: wp.vec2i, s: float, t: float):
    """From the place t on edge g to the place s on edge e."""
    return (1.0 - s) * x[e[0]] + s * x[e[1]] - (1.0 - t) * x[g[0]] - t * x[g[1]]


@wp.func
def belongs(distance: float, rest_distance: float, cosine: float):
    """Whether a part of the same garment is a neighbour in the plane, where it belongs."""
    return wp.abs(cosine) < IN_PLANE and distance > CLOSED_IN * rest_distance


@wp.kernel
def faces_near(
    first: wp.int32,
    mesh: wp.uint64,
    ask: wp.array(dtype=wp.int32),
    reach: wp.array(dtype=wp.float32),
    x: wp.array(dtype=wp.vec3f),
    normal: wp.array(dtype=wp.vec3f),
    rest: wp.array(dtype=wp.vec3f),
    triangles: wp.array(dtype=wp.vec3i),
    starts: wp.array(dtype=wp.int32),
    ring: wp.array(dtype=wp.int32),
    garment: wp.array(dtype=wp.int32),
    meets: wp.array(dtype=wp.int32),
    garments: wp.int32,
    face: wp.array(dtype=wp.vec2i),
    above: wp.array(dtype=wp.vec3f),
    below: wp.array(dtype=wp.vec3f),
):
    """For each vertex asked, the closest face on either side within its reach, -1 where there is none."""
    i = first + wp.tid()
    v = ask[i]
    p, n = x[v], normal[v]
    far = wp.float32(reach[v])
    best_up = wp.float32(far)
    best_down = wp.float32(far)
    up = wp.int32(-1)
    down = wp.int32(-1)
    grow = wp.vec3f(far, far, far)
    query = wp.mesh_query_aabb(mesh, p - grow, p + grow)
    f = wp.int32(0)
    while wp.mesh_query_aabb_next(query, f):
        t = triangles[f]
        if meets[garment[v] * garments + garment[t[0]]] == 0:
            continue
        weight = closest_on_triangle(p, x[t[0]], x[t[1]], x[t[2]])
        way = p - (weight[0] * x[t[0]] + weight[1] * x[t[1]] + weight[2] * x[t[2]])
        distance = wp.length(way)
        if distance >= wp.max(best_up, best_down) or distance < LEAST:
            continue
        if is_beside(v, t[0], starts, ring) or is_beside(v, t[1], starts, ring) or is_beside(v, t[2], starts, ring):
            continue
        cosine = wp.dot(way, n) / distance
        if garment[v] == garment[t[0]]:
            at_rest = rest[v] - (weight[0] * rest[t[0]] + weight[1] * rest[t[1]] + weight[2] * rest[t[2]])
            if belongs(distance, wp.length(at_rest), cosine):
                continue
        if cosine > 0.0:
            if distance < best_up:
                best_up = distance
                up = f
                above[i] = weight
        elif distance < best_down:
            best_down = distance
            down = f
            below[i] = weight
    face[i] = wp.vec2i(up, down)


@wp.kernel
def edges_near(  # noqa: C901 - one query, each candidate refused as early as can be
    first: wp.int32,
    mesh: wp.uint64,
    ask: wp.array(dtype=wp.int32),
    reach: wp.array(dtype=wp.float32),
    x: wp.array(dtype=wp.vec3f),
    normal: wp.array(dtype=wp.vec3f),
    rest: wp.array(dtype=wp.vec3f),
    edges: wp.array(dtype=wp.vec2i),
    sides: wp.array(dtype=wp.vec3i),
    starts: wp.array(dtype=wp.int32),
    ring: wp.array(dtype=wp.int32),
    garment: wp.array(dtype=wp.int32),
    meets: wp.array(dtype=wp.int32),
    garments: wp.int32,
    other: wp.array(dtype=wp.vec2i),
    above: wp.array(dtype=wp.vec2f),
    below: wp.array(dtype=wp.vec2f),
):
    """For each edge asked, the closest edge on either side within reach, inside both; -1 where there is none.

    ``sides`` are the edges that each face owns, -1 for those that another face owns.
    """
    i = first + wp.tid()
    e = ask[i]
    a, b = edges[e][0], edges[e][1]
    far = 0.5 * (reach[a] + reach[b])
    n = wp.normalize(normal[a] + normal[b])
    best_up = wp.float32(far)
    best_down = wp.float32(far)
    up = wp.int32(-1)
    down = wp.int32(-1)
    grow = wp.vec3f(far)
    query = wp.mesh_query_aabb(mesh, wp.min(x[a], x[b]) - grow, wp.max(x[a], x[b]) + grow)
    f = wp.int32(0)
    while wp.mesh_query_aabb_next(query, f):
        for side in range(3):
            g = sides[f][side]
            c = edges[wp.max(g, 0)][0]
            if g < 0 or g == e or meets[garment[a] * garments + garment[c]] == 0:
                continue
            found = wp.closest_point_edge_edge(x[a], x[b], x[c], x[edges[g][1]], 1.0e-12)
            s, t, distance = found[0], found[1], found[2]
            if not is_inside(s, t) or distance >= wp.max(best_up, best_down) or distance < LEAST:
                continue
            if are_beside(edges[e], edges[g], starts, ring):
                continue
            cosine = wp.dot(between(x, edges[e], edges[g], s, t), n) / distance
            if garment[a] == garment[c]:
                if belongs(distance, wp.length(between(rest, edges[e], edges[g], s, t)), cosine):
                    continue
            if cosine > 0.0:
                if distance < best_up:
                    best_up = distance
                    up = g
                    above[i] = wp.vec2f(s, t)
            elif distance < best_down:
                best_down = distance
                down = g
                below[i] = wp.vec2f(s, t)
    other[i] = wp.vec2i(up, down)


@wp.kernel
def pierced(
    first: wp.int32,
    mesh: wp.uint64,
    ask: wp.array(dtype=wp.int32),
    x: wp.array(dtype=wp.vec3f),
    edges: wp.array(dtype=wp.vec2i),
    triangles: wp.array(dtype=wp.vec3i),
    garment: wp.array(dtype=wp.int32),
    meets: wp.array(dtype=wp.int32),
    garments: wp.int32,
    count: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec4i),
):
    """For each edge asked, how many faces it passes through, and the first of them."""
    i = first + wp.tid()
    a, b = edges[ask[i]][0], edges[ask[i]][1]
    found = wp.vec4i(-1, -1, -1, -1)
    total = wp.int32(0)
    query = wp.mesh_query_aabb(mesh, wp.min(x[a], x[b]), wp.max(x[a], x[b]))
    f = wp.int32(0)
    while wp.mesh_query_aabb_next(query, f):
        t = triangles[f]
        if a == t[0] or a == t[1] or a == t[2] or b == t[0] or b == t[1] or b == t[2]:
            continue
        if meets[garment[a] * garments + garment[t[0]]] == 0:
            continue
        if passes_through(x, edges[ask[i]], t):
            if total < SLOTS:
                found[total] = f
            total += 1
    count[i] = total
    faces[i] = found


@wp.kernel
def patches_meet(
    first: wp.int32,
    tree: wp.uint64,
    low: wp.array(dtype=wp.vec3f),
    high: wp.array(dtype=wp.vec3f),
    starts: wp.array(dtype=wp.int32),
    near: wp.array(dtype=wp.int32),
    garment: wp.array(dtype=wp.int32),
    meets: wp.array(dtype=wp.int32),
    garments: wp.int32,
    flag: wp.array(dtype=wp.int32),
):
    """Whether the box of a patch meets that of another patch that is no near neighbour of it."""
    i = first + wp.tid()
    query = wp.bvh_query_aabb(tree, low[i], high[i])
    j = wp.int32(0)
    found = wp.int32(0)
    while wp.bvh_query_next(query, j):
        if found == 0 and meets[garment[i] * garments + garment[j]] == 1:
            if not is_beside(i, j, starts, near):
                found = 1
    flag[i] = found


@wp.func
def area_of(x: wp.array(dtype=wp.vec3f), t: wp.vec3i):
    """Twice the area of a triangle along its normal."""
    return wp.cross(x[t[1]] - x[t[0]], x[t[2]] - x[t[0]])


@wp.kernel
def patch_areas(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    triangles: wp.array(dtype=wp.vec3i),
    x: wp.array(dtype=wp.vec3f),
    total: wp.array(dtype=wp.vec3f),
):
    """The area of each patch's triangles together, along their normals."""
    i = first + wp.tid()
    out = wp.vec3f(0.0)
    for k in range(starts[i], starts[i + 1]):
        out += area_of(x, triangles[members[k]])
    total[i] = out


@wp.kernel
def rings_turn(
    first: wp.int32,
    ring_starts: wp.array(dtype=wp.int32),
    ring: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    triangles: wp.array(dtype=wp.vec3i),
    x: wp.array(dtype=wp.vec3f),
    total: wp.array(dtype=wp.vec3f),
    least: wp.float32,
    turns: wp.array(dtype=wp.int32),
):
    """Whether a triangle of the ring of patches round each is farther from the ring's mean normal than a cosine."""
    i = first + wp.tid()
    mean = wp.vec3f(0.0)
    for k in range(ring_starts[i], ring_starts[i + 1]):
        mean += total[ring[k]]
    mean = wp.normalize(mean)
    found = wp.int32(0)
    for k in range(ring_starts[i], ring_starts[i + 1]):
        for m in range(starts[ring[k]], starts[ring[k] + 1]):
            if found == 0:
                area = area_of(x, triangles[members[m]])
                if wp.dot(area, mean) <= least * wp.length(area):
                    found = 1
    turns[i] = found


@wp.kernel
def any_of_ring(
    first: wp.int32,
    ring_starts: wp.array(dtype=wp.int32),
    ring: wp.array(dtype=wp.int32),
    flag: wp.array(dtype=wp.int32),
    out: wp.array(dtype=wp.int32),
):
    """Whether a patch of the ring round each is flagged."""
    i = first + wp.tid()
    found = wp.int32(0)
    for k in range(ring_starts[i], ring_starts[i + 1]):
        found = wp.max(found, flag[ring[k]])
    out[i] = found
