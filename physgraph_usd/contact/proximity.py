"""Which parts of the cloth are near which, asked by clusters of faces.

Queries are exact for what is asked: the closest face above and below a vertex, the closest edge above and below an
edge. Parts that share a corner are no pairs, nor are those one edge apart, but in sharp folds.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false
from __future__ import annotations

import warp as wp

from ..collide.cluster_kernels import FAR, are_apart
from .beside import bits_beside, bits_of_edge, is_own_edge, is_own_face

wp.set_module_options({"enable_backward": False})

LEAST = 1e-9
"""Distance under which two parts have no direction from one to the other [m]."""
POINT = 1e-12
"""Square of the length under which an edge is a point [m^2]."""
IN_PLANE = 0.5
"""Cosine to the normal under which a neighbour lies in the plane of the cloth rather than above or below it."""
CLOSED_IN = 0.5
"""Distance over rest distance above which such a neighbour is where it belongs."""


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
def places_inside(a: wp.vec3f, b: wp.vec3f, c: wp.vec3f, d: wp.vec3f):
    """Where along two edges they are closest, if inside both; else a negative place (Ericson 2005, 5.1.9)."""
    along, other, way = b - a, d - c, a - c
    length, width, both = wp.dot(along, along), wp.dot(other, other), wp.dot(along, other)
    first, second = wp.dot(along, way), wp.dot(other, way)
    whole = length * width - both * both
    part = both * second - first * width
    none = wp.vec2f(-1.0, -1.0)
    if part <= 0.0 or part >= whole or wp.min(length, width) <= POINT:
        return none
    s = part / whole
    t = (both * s + second) / width
    if t <= 0.0 or t >= 1.0:
        return none
    return wp.vec2f(s, t)


@wp.func
def between(x: wp.array(dtype=wp.vec3f), e: wp.vec2i, g: wp.vec2i, s: float, t: float):
    """From the place t on edge g to the place s on edge e."""
    return (1.0 - s) * x[e[0]] + s * x[e[1]] - (1.0 - t) * x[g[0]] - t * x[g[1]]


@wp.func
def belongs(distance: float, rest_distance: float, cosine: float):
    """Whether a part of the same garment is a neighbour in the plane, where it belongs."""
    return wp.abs(cosine) < IN_PLANE and distance > CLOSED_IN * rest_distance


@wp.func
def edge_belongs(
    same: bool,
    e: wp.vec2i,
    g: wp.vec2i,
    places: wp.vec2f,
    distance: float,
    cosine: float,
    rest: wp.array(dtype=wp.vec3f),
):
    """The same of two edges, at their closest points."""
    if same:
        return belongs(distance, wp.length(between(rest, e, g, places[0], places[1])), cosine)
    return False


@wp.func
def within(least: wp.vec3f, most: wp.vec3f, low: wp.vec3f, high: wp.vec3f, reach: float):
    """Whether two boxes are at most so far apart: of what boxes grown by it meet, half is farther away."""
    apart = wp.max(wp.max(low - most, least - high), wp.vec3f(0.0))
    return wp.dot(apart, apart) <= reach * reach


@wp.func
def nearer(distance: float, part: wp.int32, best: float, known: wp.int32):
    """Whether a part is nearer than the nearest known; of two as near the one with the lower number is."""
    return distance < best or (distance == best and part < known)


@wp.func
def box_of_vertices(
    begin: wp.int32,
    end: wp.int32,
    vertices: wp.array(dtype=wp.int32),
    asked: wp.array(dtype=wp.bool),
    reach: wp.array(dtype=wp.float32),
    x: wp.array(dtype=wp.vec3f),
    best: wp.array(dtype=wp.vec2f),
):
    """The box within reach of the vertices asked, for which nothing is known from now on."""
    least = wp.vec3f(FAR)
    most = wp.vec3f(-FAR)
    for k in range(begin, end):
        v = vertices[k]
        if asked[v]:
            best[v] = wp.vec2f(reach[v], reach[v])
            least = wp.min(least, x[v] - wp.vec3f(reach[v]))
            most = wp.max(most, x[v] + wp.vec3f(reach[v]))
    return least, most


@wp.func
def at_rest(t: wp.vec3i, weight: wp.vec3f, rest: wp.array(dtype=wp.vec3f)):
    """Where a point of a triangle is at rest."""
    return weight[0] * rest[t[0]] + weight[1] * rest[t[1]] + weight[2] * rest[t[2]]


@wp.func
def keep_nearest(
    v: wp.int32,
    part: wp.int32,
    distance: float,
    cosine: float,
    best: wp.array(dtype=wp.vec2f),
    found: wp.array(dtype=wp.vec2i),
):
    """Note a part that is nearer than what is known on its side: 1 above, -1 below, 0 where it is not."""
    if cosine > 0.0:
        if nearer(distance, part, best[v][0], found[v][0]):
            best[v] = wp.vec2f(distance, best[v][1])
            found[v] = wp.vec2i(part, found[v][1])
            return 1
    elif nearer(distance, part, best[v][1], found[v][1]):
        best[v] = wp.vec2f(best[v][0], distance)
        found[v] = wp.vec2i(found[v][0], part)
        return -1
    return 0


@wp.kernel
def faces_near(  # noqa: C901, PLR0912 - one query, each candidate refused as early as can be
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
    starts: wp.array(dtype=wp.int32),
    beside: wp.array(dtype=wp.int32),
    x: wp.array(dtype=wp.vec3f),
    asked: wp.array(dtype=wp.bool),
    reach: wp.array(dtype=wp.float32),
    normal: wp.array(dtype=wp.vec3f),
    rest: wp.array(dtype=wp.vec3f),
    entries: wp.array(dtype=wp.int32),
    entry_cluster: wp.array(dtype=wp.int32),
    entry_bits: wp.array(dtype=wp.uint64),
    first_vertex: wp.array(dtype=wp.int32),
    vertices: wp.array(dtype=wp.int32),
    first_face: wp.array(dtype=wp.int32),
    triangles: wp.array(dtype=wp.vec3i),
    number: wp.array(dtype=wp.int32),
    face_low: wp.array(dtype=wp.vec3f),
    face_high: wp.array(dtype=wp.vec3f),
    best: wp.array(dtype=wp.vec2f),
    face: wp.array(dtype=wp.vec2i),
    above: wp.array(dtype=wp.vec3f),
    below: wp.array(dtype=wp.vec3f),
):
    """For each vertex asked of a cluster, the closest face on either side within its reach, -1 where there is none."""
    i = first + wp.tid()
    begin, end = first_vertex[i], first_vertex[i + 1]
    least, most = box_of_vertices(begin, end, vertices, asked, reach, x, best)
    if least[0] > most[0]:
        return
    query = wp.bvh_query_aabb(tree, least, most)
    j = wp.int32(0)
    while wp.bvh_query_next(query, j):
        same = cluster_garment[i] == cluster_garment[j]
        if are_apart(i, j, cluster_garment, ring_starts, ring, turns, around, meets, garments, 1.0):
            continue
        for k in range(begin, end):
            v = vertices[k]
            p, farthest = x[v], wp.max(best[v][0], best[v][1])
            if not asked[v] or not within(p, p, low[j], high[j], farthest):
                continue
            known = bits_beside(v, j, entries, entry_cluster, entry_bits)
            for m in range(first_face[j], first_face[j + 1]):
                if is_own_face(known, m, first_face[j], v, triangles, starts, beside):
                    continue
                if not within(p, p, face_low[m], face_high[m], farthest):
                    continue
                t = triangles[m]
                weight = closest_on_triangle(p, x[t[0]], x[t[1]], x[t[2]])
                way = p - (weight[0] * x[t[0]] + weight[1] * x[t[1]] + weight[2] * x[t[2]])
                distance = wp.length(way)
                if distance > wp.max(best[v][0], best[v][1]) or distance < LEAST:
                    continue
                cosine = wp.dot(way, normal[v]) / distance
                if distance > wp.where(cosine > 0.0, best[v][0], best[v][1]):
                    continue
                if same:
                    if belongs(distance, wp.length(rest[v] - at_rest(t, weight, rest)), cosine):
                        continue
                side = keep_nearest(v, number[m], distance, cosine, best, face)
                if side > 0:
                    above[v] = weight
                elif side < 0:
                    below[v] = weight


@wp.func
def box_of_edges(
    begin: wp.int32,
    end: wp.int32,
    step: wp.int32,
    edges: wp.array(dtype=wp.vec2i),
    number: wp.array(dtype=wp.int32),
    asked: wp.array(dtype=wp.bool),
    reach: wp.array(dtype=wp.float32),
    edge_low: wp.array(dtype=wp.vec3f),
    edge_high: wp.array(dtype=wp.vec3f),
    best: wp.array(dtype=wp.vec2f),
):
    """The box within reach of the edges with an end asked, for which nothing is known from now on."""
    least = wp.vec3f(FAR)
    most = wp.vec3f(-FAR)
    for k in range(begin, end, step):
        a, b = edges[k][0], edges[k][1]
        if asked[a] or asked[b]:
            far = 0.5 * (reach[a] + reach[b])
            best[number[k]] = wp.vec2f(far, far)
            least = wp.min(least, edge_low[k] - wp.vec3f(far))
            most = wp.max(most, edge_high[k] + wp.vec3f(far))
    return least, most


@wp.kernel
def edges_near(  # noqa: C901, PLR0912 - one query, each candidate refused as early as can be
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
    starts: wp.array(dtype=wp.int32),
    beside: wp.array(dtype=wp.int32),
    x: wp.array(dtype=wp.vec3f),
    asked: wp.array(dtype=wp.bool),
    reach: wp.array(dtype=wp.float32),
    normal: wp.array(dtype=wp.vec3f),
    rest: wp.array(dtype=wp.vec3f),
    entries: wp.array(dtype=wp.int32),
    entry_cluster: wp.array(dtype=wp.int32),
    entry_bits: wp.array(dtype=wp.uint64),
    first_edge: wp.array(dtype=wp.int32),
    edges: wp.array(dtype=wp.vec2i),
    number: wp.array(dtype=wp.int32),
    edge_low: wp.array(dtype=wp.vec3f),
    edge_high: wp.array(dtype=wp.vec3f),
    best: wp.array(dtype=wp.vec2f),
    other: wp.array(dtype=wp.vec2i),
    above: wp.array(dtype=wp.vec2f),
    below: wp.array(dtype=wp.vec2f),
):
    """For each edge with an end asked, the closest edge on either side within reach, inside both; -1 for none."""
    i = (first + wp.tid()) / threads
    begin, end = first_edge[i] + (first + wp.tid()) % threads, first_edge[i + 1]
    least, most = box_of_edges(begin, end, threads, edges, number, asked, reach, edge_low, edge_high, best)
    if least[0] > most[0]:
        return
    query = wp.bvh_query_aabb(tree, least, most)
    j = wp.int32(0)
    while wp.bvh_query_next(query, j):
        same = cluster_garment[i] == cluster_garment[j]
        if are_apart(i, j, cluster_garment, ring_starts, ring, turns, around, meets, garments, 1.0):
            continue
        for k in range(begin, end, threads):
            a, b, e = edges[k][0], edges[k][1], number[k]
            if not (asked[a] or asked[b]):
                continue
            lower, upper, farthest = edge_low[k], edge_high[k], wp.max(best[e][0], best[e][1])
            if not within(lower, upper, low[j], high[j], farthest):
                continue
            known = bits_of_edge(edges[k], j, entries, entry_cluster, entry_bits)
            for m in range(first_edge[j], first_edge[j + 1]):
                if is_own_edge(known, m, first_edge[j], edges[k], edges, starts, beside):
                    continue
                if not within(lower, upper, edge_low[m], edge_high[m], farthest):
                    continue
                places = places_inside(x[a], x[b], x[edges[m][0]], x[edges[m][1]])
                if places[0] < 0.0:
                    continue
                way = between(x, edges[k], edges[m], places[0], places[1])
                distance = wp.length(way)
                cosine = wp.dot(way, wp.normalize(normal[a] + normal[b])) / distance
                if distance < LEAST or distance > wp.where(cosine > 0.0, best[e][0], best[e][1]):
                    continue
                if edge_belongs(same, edges[k], edges[m], places, distance, cosine, rest):
                    continue
                side = keep_nearest(e, number[m], distance, cosine, best, other)
                if side > 0:
                    above[e] = places
                elif side < 0:
                    below[e] = places


@wp.kernel
def vertex_normals(
    first: wp.int32,
    starts: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.int32),
    triangles: wp.array(dtype=wp.vec3i),
    x: wp.array(dtype=wp.vec3f),
    normal: wp.array(dtype=wp.vec3f),
):
    """The unit normal of each vertex: its faces' areas along their normals together."""
    i = first + wp.tid()
    total = wp.vec3f(0.0)
    for k in range(starts[i], starts[i + 1]):
        t = triangles[faces[k]]
        total += wp.cross(x[t[1]] - x[t[0]], x[t[2]] - x[t[0]])
    normal[i] = wp.normalize(total)
