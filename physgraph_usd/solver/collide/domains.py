"""Domains of a level's monotone patches: the convex domains covered by the patches at rest.

A patch consists of some clusters and the clusters around them. Its domain is the part of a plane that remains after
each edge of the patch's rim is cut off by a half-plane around the patch's middle. The half-plane is bounded by the
edge's own line if more remains, so straight and convex hems lie in the domain. Single cover is checked at one point: no
rim lies in the domain, so every point is covered equally often. Faces that are steep to the plane do not belong to the
patch.
"""

# Warp's kernels are typed by values that only Warp reads.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportGeneralTypeIssues=false
from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..level import Level
from ..mesh.kernels import KERNELS
from ..mesh.threads import LEAST_QUERIES, run
from .clusters import gathered
from .topology import Topology

wp.set_module_options(KERNELS)

WIDE, SMALL = 3, 2
"""Rings of clusters around a patch's own clusters: for wide patches, and for small patches, used where wide patches are
not monotone."""
PLANES, RIM = wp.constant(32), wp.constant(512)
"""Most half-planes of a domain, and most rim edges of a patch; a patch above a limit proves nothing."""
STEEP = wp.constant(wp.float64(0.6))
"""Least cosine at rest between a triangle and its projection plane."""
OWN_LINE = wp.constant(wp.float64(0.5))
"""Least distance of an edge's line from the middle, over the edge's distance, for the line to bound the half-plane."""
ON_LINE = wp.constant(wp.float64(1.0e-9))
"""Distance from a half-plane's line below which a point lies on the line, over the patch's width: rounding."""
CLOSE = wp.constant(wp.float64(1.0e-3))
"""Distance of the rim from the middle, over the patch's width, below which there is no domain."""


@wp.struct
class Sheet:
    """Faces by cluster: neighbours across each side, -1 at a hem; the cluster of each face; faces at each vertex."""

    beside: wp.array(dtype=wp.vec3i)
    cluster: wp.array(dtype=wp.int32)
    first_at: wp.array(dtype=wp.int32)
    at: wp.array(dtype=wp.int32)


@wp.struct
class Patches:
    """The monotone patches of a level: planes, domains, and clusters.

    For each patch: its own clusters and all its clusters, its plane, the half-planes of its domain, the faces and
    clusters in the domain, the wide patch that contains it (-1 for wide patches), and the least cosine between its
    faces and its plane. For each cluster: the wide and the small patch with the cluster among its own, and the
    cluster's centre and radius at rest. The own clusters of the small patches form groups; for each domain the groups
    wholly inside are listed by index.
    """

    wide: wp.array(dtype=wp.int32)
    small: wp.array(dtype=wp.int32)
    within: wp.array(dtype=wp.int32)
    first_own: wp.array(dtype=wp.int32)
    own: wp.array(dtype=wp.int32)
    first_member: wp.array(dtype=wp.int32)
    members: wp.array(dtype=wp.int32)
    middle: wp.array(dtype=wp.vec3d)
    across: wp.array(dtype=wp.vec3d)
    up: wp.array(dtype=wp.vec3d)
    planes: wp.array(dtype=wp.vec3d)
    plane_count: wp.array(dtype=wp.int32)
    first_face: wp.array(dtype=wp.int32)
    faces: wp.array(dtype=wp.vec3i)
    inverse: wp.array(dtype=wp.vec4f)
    flattest: wp.array(dtype=wp.float32)
    first_inside: wp.array(dtype=wp.int32)
    inside: wp.array(dtype=wp.int32)
    wide_count: wp.int32
    first_whole: wp.array(dtype=wp.int32)
    whole: wp.array(dtype=wp.int32)
    centre: wp.array(dtype=wp.vec3d)
    size: wp.array(dtype=wp.float64)


@wp.func
def single(v: wp.vec3d):
    """A vector in single precision."""
    return wp.vec3f(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


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


@wp.func
def flat(patches: Patches, p: wp.int32, x: wp.vec3d):
    """A point at rest in the patch's plane, relative to the patch's middle."""
    offset = x - patches.middle[p]
    return wp.vec2d(wp.dot(offset, patches.across[p]), wp.dot(offset, patches.up[p]))


@wp.func
def turn(a: wp.vec2d, b: wp.vec2d):
    """a x b."""
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def lies_within(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Winding of a triangle around the origin: 1, 0, or -1 for a flipped triangle."""
    first, second, third = turn(a, b), turn(b, c), turn(c, a)
    zero = wp.float64(0.0)
    if first >= zero and second >= zero and third >= zero:
        return 1
    if first <= zero and second <= zero and third <= zero:
        return -1
    return 0


@wp.func
def centre_of(parts: Topology, t: wp.vec3i):
    """Centre of a face at rest."""
    return (parts.rest[t[0]] + parts.rest[t[1]] + parts.rest[t[2]]) / wp.float64(3.0)


@wp.func
def area_of(parts: Topology, t: wp.vec3i):
    """Twice the area of a face at rest, as a vector along its normal."""
    return wp.cross(parts.rest[t[1]] - parts.rest[t[0]], parts.rest[t[2]] - parts.rest[t[0]])


@wp.kernel
def place_planes(first: wp.int32, parts: Topology, patches: Patches):
    """The plane of each patch, from its own clusters, and its middle: the centre of a face near their centre."""
    p = first + wp.tid()
    normal, mean, total = wp.vec3d(), wp.vec3d(), wp.float64(0.0)
    for n in range(patches.first_own[p], patches.first_own[p + 1]):
        c = patches.own[n]
        for k in range(parts.first_face[c], parts.first_face[c + 1]):
            t = parts.faces[k]
            area = area_of(parts, t)
            normal += area
            mean += wp.length(area) * centre_of(parts, t)
            total += wp.length(area)
    mean /= wp.max(total, wp.float64(1.0e-300))
    nearest, middle = wp.float64(1.0e300), mean
    for n in range(patches.first_own[p], patches.first_own[p + 1]):
        c = patches.own[n]
        for k in range(parts.first_face[c], parts.first_face[c + 1]):
            centre = centre_of(parts, parts.faces[k])
            if wp.length(centre - mean) < nearest:
                nearest, middle = wp.length(centre - mean), centre
    normal = wp.normalize(normal)
    other = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    if wp.abs(normal[0]) > wp.float64(0.8):
        other = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
    patches.middle[p] = middle
    patches.across[p] = wp.normalize(wp.cross(normal, other))
    patches.up[p] = wp.cross(normal, patches.across[p])


@wp.func
def nearest_on(a: wp.vec2d, b: wp.vec2d):
    """The point of an edge nearest to the origin."""
    side = b - a
    length = wp.dot(side, side)
    if length <= wp.float64(0.0):
        return a
    return a + wp.clamp(-wp.dot(a, side) / length, wp.float64(0.0), wp.float64(1.0)) * side


@wp.func
def is_cut_off(patches: Patches, p: wp.int32, count: wp.int32, width: wp.float64, edge: wp.vec4d):
    """True if a half-plane of a patch excludes an edge, with points on the half-plane's line included."""
    for m in range(count):
        plane = patches.planes[p * PLANES + m]
        least = plane[2] - ON_LINE * width
        if plane[0] * edge[0] + plane[1] * edge[1] >= least and plane[0] * edge[2] + plane[1] * edge[3] >= least:
            return True
    return False


@wp.func
def is_level(parts: Topology, patches: Patches, p: wp.int32, k: wp.int32):
    """True if a face at rest is close enough to parallel to a patch's plane to belong to the patch."""
    area = area_of(parts, parts.faces[k])
    return wp.dot(area, wp.cross(patches.across[p], patches.up[p])) > STEEP * wp.length(area)


@wp.func
def is_of(parts: Topology, sheet: Sheet, patches: Patches, p: wp.int32, k: wp.int32):
    """True if a face belongs to a patch."""
    if k < 0:
        return False
    if not holds(patches.members, patches.first_member[p], patches.first_member[p + 1], sheet.cluster[k]):
        return False
    return is_level(parts, patches, p, k)


@wp.func
def line_of(a: wp.vec2d, b: wp.vec2d, at_hem: wp.bool):
    """Normal and height of the half-plane that cuts off an edge, along the edge's own line if more remains."""
    near = nearest_on(a, b)
    height = wp.length(near)
    normal, length = near / height, wp.length(b - a)
    if at_hem and wp.abs(turn(a, b)) >= OWN_LINE * height * length:
        normal = wp.vec2d(b[1] - a[1], a[0] - b[0]) / length
        height = wp.dot(normal, a)
        if height < wp.float64(0.0):
            normal, height = -normal, -height
    return wp.vec3d(normal[0], normal[1], height)


@wp.kernel
def find_rims(
    first: wp.int32,
    parts: Topology,
    sheet: Sheet,
    patches: Patches,
    rim: wp.array(dtype=wp.vec4d),
    at_hem: wp.array(dtype=wp.bool),
    count: wp.array(dtype=wp.int32),
    width: wp.array(dtype=wp.float64),
):
    """Rim edges of each patch and its half width; the count is 0 if the middle is not covered exactly once."""
    p = first + wp.tid()
    edges, cover, far = wp.int32(0), wp.int32(0), wp.float64(0.0)
    count[p] = 0
    for n in range(patches.first_member[p], patches.first_member[p + 1]):
        c = patches.members[n]
        for k in range(parts.first_face[c], parts.first_face[c + 1]):
            if not is_level(parts, patches, p, k):
                continue
            t = parts.faces[k]
            for side in range(3):
                other = sheet.beside[k][side]
                if not is_of(parts, sheet, patches, p, other):
                    if edges == RIM:
                        return
                    a = flat(patches, p, parts.rest[t[side]])
                    b = flat(patches, p, parts.rest[t[(side + 1) % 3]])
                    far = wp.max(far, wp.max(wp.length(a), wp.length(b)))
                    rim[p * RIM + edges] = wp.vec4d(a[0], a[1], b[0], b[1])
                    at_hem[p * RIM + edges] = other < 0
                    edges += 1
            cover += lies_within(
                flat(patches, p, parts.rest[t[0]]),
                flat(patches, p, parts.rest[t[1]]),
                flat(patches, p, parts.rest[t[2]]),
            )
    width[p] = far
    if cover == 1:
        count[p] = edges


@wp.kernel
def bound_domains(
    first: wp.int32,
    patches: Patches,
    rim: wp.array(dtype=wp.vec4d),
    at_hem: wp.array(dtype=wp.bool),
    rims: wp.array(dtype=wp.int32),
    width: wp.array(dtype=wp.float64),
):
    """Half-planes of each patch's domain; the count is 0 without a domain."""
    p = first + wp.tid()
    patches.plane_count[p] = 0
    for count in range(PLANES):
        nearest, which = wp.float64(1.0e300), wp.int32(-1)
        for k in range(rims[p]):
            edge = rim[p * RIM + k]
            near = wp.length(nearest_on(wp.vec2d(edge[0], edge[1]), wp.vec2d(edge[2], edge[3])))
            if near < nearest and not is_cut_off(patches, p, count, width[p], edge):
                nearest, which = near, k
        if which < 0:
            patches.plane_count[p] = count
            return
        if nearest <= CLOSE * width[p]:
            return
        edge = rim[p * RIM + which]
        line = line_of(wp.vec2d(edge[0], edge[1]), wp.vec2d(edge[2], edge[3]), at_hem[p * RIM + which])
        patches.planes[p * PLANES + count] = line


@wp.func
def depth_in(patches: Patches, p: wp.int32, x: wp.vec2d):
    """Depth of a point inside all half-planes of a patch's domain."""
    least = wp.float64(1.0e300)
    for m in range(patches.plane_count[p]):
        plane = patches.planes[p * PLANES + m]
        least = wp.min(least, plane[2] - plane[0] * x[0] - plane[1] * x[1])
    return least


@wp.func
def meets_domain(parts: Topology, patches: Patches, p: wp.int32, t: wp.vec3i):
    """True if no half-plane of a patch's domain excludes a triangle."""
    a, b, c = flat(patches, p, parts.rest[t[0]]), flat(patches, p, parts.rest[t[1]]), flat(patches, p, parts.rest[t[2]])
    for m in range(patches.plane_count[p]):
        plane = patches.planes[p * PLANES + m]
        least = wp.min(plane[0] * a[0] + plane[1] * a[1], plane[0] * b[0] + plane[1] * b[1])
        if wp.min(least, plane[0] * c[0] + plane[1] * c[1]) >= plane[2]:
            return False
    return True


@wp.func
def has_face_at(parts: Topology, sheet: Sheet, patches: Patches, p: wp.int32, v: wp.int32):
    """True if a vertex belongs to a patch triangle that meets the domain; false on the far lip of a slit."""
    for n in range(sheet.first_at[v], sheet.first_at[v + 1]):
        k = sheet.at[n]
        if is_of(parts, sheet, patches, p, k):
            if meets_domain(parts, patches, p, parts.faces[k]):
                return True
    return False


@wp.func
def lies_in(parts: Topology, sheet: Sheet, patches: Patches, p: wp.int32, rounding: wp.float64, c: wp.int32):
    """True if all corners of a cluster lie in a patch's domain, as corners of triangles that meet the domain."""
    for k in range(parts.first_corner[c], parts.first_corner[c + 1]):
        v = parts.corners[k]
        if depth_in(patches, p, flat(patches, p, parts.rest[v])) < -rounding:
            return False
        if not has_face_at(parts, sheet, patches, p, v):
            return False
    return True


@wp.func
def inverse_of(parts: Topology, patches: Patches, p: wp.int32, t: wp.vec3i):
    """Inverse of the matrix of a face's two sides in a patch's plane, row by row [1/m]."""
    origin = flat(patches, p, parts.rest[t[0]])
    a, b = flat(patches, p, parts.rest[t[1]]) - origin, flat(patches, p, parts.rest[t[2]]) - origin
    size = turn(a, b)
    return wp.vec4f(
        wp.float32(b[1] / size), wp.float32(-b[0] / size), wp.float32(-a[1] / size), wp.float32(a[0] / size)
    )


@wp.kernel
def fill_domains(
    first: wp.int32,
    parts: Topology,
    sheet: Sheet,
    patches: Patches,
    width: wp.array(dtype=wp.float64),
    face_count: wp.array(dtype=wp.int32),
    inside_count: wp.array(dtype=wp.int32),
    written: wp.bool,
):
    """The faces that meet each domain and the clusters inside each domain; counted, or written."""
    p = first + wp.tid()
    faces, clusters, flattest = wp.int32(0), wp.int32(0), wp.float64(1.0)
    normal = wp.cross(patches.across[p], patches.up[p])
    if patches.plane_count[p] == 0 or (written and face_count[p] == 0):
        return
    for n in range(patches.first_member[p], patches.first_member[p + 1]):
        c = patches.members[n]
        if lies_in(parts, sheet, patches, p, ON_LINE * width[p], c):
            if written:
                patches.inside[patches.first_inside[p] + clusters] = c
            clusters += 1
        for k in range(parts.first_face[c], parts.first_face[c + 1]):
            if not is_level(parts, patches, p, k):
                continue
            t = parts.faces[k]
            if meets_domain(parts, patches, p, t):
                area = area_of(parts, t)
                flattest = wp.min(flattest, wp.dot(area, normal) / wp.length(area))
                if written:
                    patches.faces[patches.first_face[p] + faces] = t
                    patches.inverse[patches.first_face[p] + faces] = inverse_of(parts, patches, p, t)
                faces += 1
    if clusters < 2:
        faces, clusters = 0, 0
    face_count[p] = faces
    inside_count[p] = clusters
    patches.flattest[p] = wp.float32(flattest)


@wp.kernel
def enclose(first: wp.int32, parts: Topology, patches: Patches):
    """Bounding ball of each cluster at rest."""
    c = first + wp.tid()
    begin, end = parts.first_corner[c], parts.first_corner[c + 1]
    mean, most = wp.vec3d(), wp.float64(0.0)
    for k in range(begin, end):
        mean += parts.rest[parts.corners[k]]
    mean /= wp.float64(wp.max(end - begin, 1))
    for k in range(begin, end):
        most = wp.max(most, wp.length(parts.rest[parts.corners[k]] - mean))
    patches.centre[c] = mean
    patches.size[c] = most


def domains_of(level: Level, parts: Topology, count: int) -> tuple[Patches, int, int]:
    """The patches of a level; the number of wide patches, which come first; and the number of all patches.

    Args:
        level: The level.
        parts: Parts of the level by cluster.
        count: Number of clusters.
    """
    touching = _touching(parts, count, level.vertex_count)
    small = _grouped(touching)
    around = sp.csr_matrix(small @ touching @ small.T)
    wide = sp.csr_matrix(_grouped(around) @ small)
    own = sp.vstack([wide, small]).tocsr()
    members = sp.vstack([_grown(wide, touching, WIDE), _grown(small, touching, SMALL)]).tocsr()
    table, size = Patches(), own.shape[0]
    device = level.device
    for name, matrix in (("own", own), ("member", members)):
        matrix.sort_indices()
        setattr(table, f"first_{name}", _array(matrix.indptr, device))
        setattr(table, "members" if name == "member" else name, _array(matrix.indices, device))
    homes = [each.tocsc().indices for each in (wide, small)]  # Each cluster is in one.
    table.wide, table.small = _array(homes[0], device), _array(homes[1] + wide.shape[0], device)
    within = sp.csr_matrix(small @ wide.T).indices
    table.within = _array(np.concatenate([np.full(wide.shape[0], -1), within]), device)
    _fill(table, level, parts, size)
    indices, begins = (np.asarray(each.numpy()) for each in (table.inside, table.first_inside))
    inside = sp.csr_matrix((np.ones(len(indices), np.float32), indices, begins), shape=(size, count))
    whole = (inside @ small.T).tocoo()
    kept = whole.data == np.diff(small.indptr)[whole.col]
    whole = sp.csr_matrix((whole.data[kept], (whole.row[kept], whole.col[kept])), shape=whole.shape)
    whole.sort_indices()
    table.wide_count = wide.shape[0]
    table.first_whole, table.whole = _array(whole.indptr, device), _array(whole.indices, device)
    return table, wide.shape[0], size


def _fill(table: Patches, level: Level, parts: Topology, size: int) -> None:
    """Find the planes, the domains, and the faces and clusters in the domains."""
    device, clusters = level.device, len(parts.first_face) - 1
    launched = {"device": device, "threads": level.threads, "least": LEAST_QUERIES}
    faces = parts.faces.numpy().reshape(-1, 3)
    sheet = Sheet()
    sheet.beside = _array(_beside(faces), device, wp.vec3i)
    sheet.cluster = _array(np.repeat(np.arange(clusters), np.diff(parts.first_face.numpy())), device)
    first_at = np.concatenate([[0], np.cumsum(np.bincount(faces.ravel(), minlength=level.vertex_count))])
    sheet.first_at, sheet.at = _array(first_at, device), _array(np.argsort(faces.ravel(), kind="stable") // 3, device)
    for name in ("middle", "across", "up"):
        setattr(table, name, wp.zeros(size, dtype=wp.vec3d, device=device))
    table.planes = wp.zeros(size * int(PLANES), dtype=wp.vec3d, device=device)
    table.flattest = wp.zeros(size, dtype=wp.float32, device=device)
    table.centre = wp.zeros(clusters, dtype=wp.vec3d, device=device)
    table.size = wp.zeros(clusters, dtype=wp.float64, device=device)
    run(enclose, clusters, [parts, table], **launched)
    table.plane_count, rims = (wp.zeros(size, dtype=wp.int32, device=device) for _ in range(2))
    rim = wp.empty(size * int(RIM), dtype=wp.vec4d, device=device)
    at_hem = wp.empty(size * int(RIM), dtype=wp.bool, device=device)
    width = wp.zeros(size, dtype=wp.float64, device=device)
    run(place_planes, size, [parts, table], **launched)
    run(find_rims, size, [parts, sheet, table, rim, at_hem, rims, width], **launched)
    run(bound_domains, size, [table, rim, at_hem, rims, width], **launched)
    counts = [wp.zeros(size, dtype=wp.int32, device=device) for _ in range(2)]
    table.first_face = table.first_inside = wp.zeros(size + 1, dtype=wp.int32, device=device)
    run(fill_domains, size, [parts, sheet, table, width, *counts, False], **launched)
    begins = [np.concatenate([[0], np.cumsum(each.numpy())]) for each in counts]
    table.first_face, table.first_inside = (_array(each, device) for each in begins)
    table.faces = wp.zeros(int(begins[0][-1]), dtype=wp.vec3i, device=device)
    table.inverse = wp.zeros(int(begins[0][-1]), dtype=wp.vec4f, device=device)
    table.inside = wp.zeros(int(begins[1][-1]), dtype=wp.int32, device=device)
    run(fill_domains, size, [parts, sheet, table, width, *counts, True], **launched)


def _array(values: np.ndarray, device: str, dtype: type = wp.int32) -> wp.array:
    """Integers as a Warp array."""
    return wp.array(np.ascontiguousarray(values, np.int32), dtype=dtype, device=device)


def _touching(parts: Topology, count: int, vertices: int) -> sp.csr_matrix:
    """Pairs of clusters with a common corner, shape (C, C)."""
    first, corners = parts.first_corner.numpy(), parts.corners.numpy()
    owner = np.repeat(np.arange(count), np.diff(first))
    has = sp.csr_matrix((np.ones(len(corners), np.float32), (owner, corners)), shape=(count, vertices))
    return sp.csr_matrix(has @ has.T)


def _grouped(touching: sp.csr_matrix) -> sp.csr_matrix:
    """Groups of a cluster and its neighbours, shape (groups, clusters)."""
    count = touching.shape[0]
    off = sp.csr_matrix(touching - sp.diags(touching.diagonal()))
    off.eliminate_zeros()
    group = gathered(off)
    return sp.csr_matrix(
        (np.ones(count, np.float32), (group, np.arange(count))), shape=(int(group.max(initial=-1)) + 1, count)
    )


def _grown(groups: sp.csr_matrix, touching: sp.csr_matrix, rings: int) -> sp.csr_matrix:
    """Groups grown by some rings."""
    for _ in range(rings):
        groups = sp.csr_matrix(groups @ touching)
        groups.data[:] = 1.0
    return groups


def _beside(faces: np.ndarray) -> np.ndarray:
    """The face across each side, shape (T, 3); -1 if there is none or more than one."""
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64), axis=1)
    key = sides[:, 0] * (int(faces.max(initial=0)) + 1) + sides[:, 1]
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    begins = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]])) if len(key) else order
    two = begins[np.diff(np.append(begins, len(ordered))) == 2]
    out = np.full(len(key), -1, np.int64)
    out[order[two]], out[order[two + 1]] = order[two + 1] // 3, order[two] // 3
    return out.reshape(-1, 3)
