"""Welding: coincident vertices of a mesh become a single vertex of the solver's mesh.

Exporters split a garment at its seams, and draw a sheet twice to show both sides. Bending forces, smooth surfaces and
normals need a face on each side of an edge. Therefore coincident open edges are joined in pairs, and only the first of
coincident faces is solved. Edges with more than two coincident copies stay apart: `forces.seam` sews them. A thick
sheet, two skins and the rims between, is solved as the sheet in its middle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from .borders import open_edges
from .subdivide import Refinement, creases_of, face_points, subdivide_times
from .topology import PolygonMesh, area_vectors, find_edges, joined_by

WELDED = 5e-3
"""Distance below which vertices coincide, in mean edges: 4% of an edge after three subdivisions. With a thousandth, a
border with a gap of about a thousandth would be sewn at every second vertex, worse than fully sewn or fully open."""
WIDEST = 0.25
"""Largest seam tolerance, in mean edges."""
THICKEST = 0.5
"""Largest thickness of a thick sheet, in distances to the next vertex of the same skin: cords are thicker."""
UNEVEN = 2.0
"""Largest ratio between two thicknesses of a thick sheet at a vertex over the shot; above, the skins stay apart."""


@dataclass(frozen=True, eq=False)
class Weld:
    """A mesh before and after welding.

    Attributes:
        apart: The original mesh.
        mesh: The welded mesh, consistently wound: faces in the order of ``apart``, without duplicates of an earlier
            face.
        number: Vertex of the welded mesh for each vertex, shape (V,).
        faces: Faces of ``apart`` kept in the welded mesh, ascending.
        across: Height of each vertex over the middle of a thick sheet [m], shape (V,); None for thin sheets.
    """

    apart: PolygonMesh
    mesh: PolygonMesh
    number: Int[np.ndarray, " vertices"]
    faces: Int[np.ndarray, " faces"]
    across: Float[np.ndarray, " vertices"] | None = None

    @property
    def is_none(self) -> bool:
        """Whether the mesh is unchanged."""
        return self.mesh is self.apart

    def joined(self, values: np.ndarray) -> np.ndarray:
        """Mean value over the vertices joined into each welded vertex, exact for equal values, shape (W, ...)."""
        if self.is_none:
            return values
        first = self._first
        out = np.zeros((len(first), *values.shape[1:]), values.dtype)
        np.add.at(out, self.number, values - values[first][self.number])
        count = np.bincount(self.number).reshape(-1, *[1] * (values.ndim - 1))
        return values[first] + (out / count).astype(values.dtype)

    def largest(self, values: Float[np.ndarray, " vertices"]) -> Float[np.ndarray, " welded"]:
        """Largest value over the vertices joined into each welded vertex."""
        out = np.full(len(self._first), -np.inf)
        np.maximum.at(out, self.number, values)
        return out

    def split(self, values: np.ndarray) -> np.ndarray:
        """Values of the welded vertices at the authored vertices, shape (V, ...)."""
        return values if self.is_none else values[self.number]

    def subdivided(self, levels: int) -> tuple[tuple[Refinement, ...], Weld]:
        """Subdivisions of the original mesh, and the weld of the finest."""
        steps = subdivide_times(self.apart, levels)
        if not steps or self.is_none:
            return steps, unwelded(steps[-1].mesh) if steps else self
        welded, number, apart, faces, across = self.mesh, self.number, self.apart, self.faces, self.across
        for step, fine in zip(steps, subdivide_times(self.mesh, levels), strict=True):
            # A reversed face has its children in a different order.
            corners = _sorted_corners(apart, number[apart.indices])
            rim = _are_rims(corners) & (across is not None)
            of_faces = np.zeros(apart.face_count, np.int64)
            of_faces[~rim] = face_points(welded)[_first_like(corners[~rim], _sorted_corners(welded, welded.indices))]
            lowest = np.where(corners[rim] < 0, corners[rim, -1:], corners[rim]).min(
                axis=1, initial=welded.vertex_count
            )
            of_faces[rim] = _halfway(fine, np.stack([lowest, corners[rim, -1]], axis=1))
            number = np.concatenate([number, _halfway(fine, number[step.edges]), of_faces[apart.is_polygon]])
            faces = np.flatnonzero(np.isin(step.parent_face, faces))
            apart, welded = step.mesh, fine.mesh
            across = None if across is None else step.linear @ across
        return steps, Weld(apart, welded, number, faces, across)

    def sharp_edges(self, rest: Float[np.ndarray, "welded 3"], closed: np.ndarray | None) -> Int[np.ndarray, "edges 2"]:
        """Edges of ``apart`` that subdivision keeps sharp: of closed pieces, and around the rims of a thick sheet.

        Args:
            rest: Rest positions of the welded mesh [m].
            closed: Whether each welded vertex belongs to a closed piece; None without such pieces.
        """
        half, beside = self.apart.half_edges, self.apart.corner_face
        if self.across is None:
            creases = creases_of(self.mesh, rest, closed)
            return half.edges[find_edges(creases, self.number[half.edges]) >= 0]
        rim = _are_rims(_sorted_corners(self.apart, self.number[self.apart.indices]))
        first, second = self.apart.twin_corners.T
        return half.edges[half.edge[first[rim[beside[first]] != rim[beside[second]]]]]

    @property
    def torn(self) -> Bool[np.ndarray, " vertices"]:
        """Mask of the vertices of ``apart`` whose welded copies subdivision would move differently.

        Open edges of the copies differ: three panels meet at the vertex, or only one of two panels has a corner at it.
        """
        count = len(self.number)
        if self.is_none or self.across is not None:
            return np.zeros(count, bool)
        ends = open_edges(self.apart)
        vertex, neighbour = np.concatenate([ends, ends[:, ::-1]]).T
        rules = np.zeros((4, count), np.int64)
        rules[0] = np.bincount(vertex, minlength=count)
        rules[1] = np.bincount(self.apart.indices, minlength=count) < 2
        np.maximum.at(rules[2], vertex, self.number[neighbour])
        np.maximum.at(rules[3], vertex, count - self.number[neighbour])
        unlike = np.zeros(len(self._first), bool)
        for rule in rules:
            unlike[self.number[rule != rule[self._first][self.number]]] = True
        return unlike[self.number]

    @property
    def without_rims(self) -> Weld:
        """The weld without the rims in ``apart``: edges of rims have no length once the skins are joined."""
        rim = _are_rims(_sorted_corners(self.apart, self.number[self.apart.indices]))
        indices = self.apart.indices[~rim[self.apart.corner_face]]
        return replace(self, apart=PolygonMesh(self.apart.counts[~rim], indices, self.apart.vertex_count))

    @property
    def sides(self) -> Int[np.ndarray, " vertices"]:
        """A number for each vertex, equal for vertices with a common normal; a doubled sheet has one per side."""
        if self.across is not None:
            return np.arange(len(self.number))
        in_front = np.zeros(len(self.number), bool)
        in_front[self.apart.indices[np.isin(self.apart.corner_face, self.faces)]] = True
        return np.unique(2 * self.number + ~in_front, return_inverse=True)[1].reshape(-1)

    @cached_property
    def _first(self) -> np.ndarray:
        """The first vertex of each welded vertex, shape (W,)."""
        return np.unique(self.number, return_index=True)[1]


def unwelded(mesh: PolygonMesh) -> Weld:
    """The weld of an unchanged mesh."""
    return Weld(mesh, mesh, np.arange(mesh.vertex_count), np.arange(mesh.face_count))


def weld(mesh: PolygonMesh, poses: Sequence[Float[np.ndarray, "vertices 3"]], within: float) -> Weld:
    """Join the vertices of faces coincident in every pose, and of coincident open edges in pairs.

    Args:
        poses: Positions [m], at least one.
        within: Distance below which two vertices coincide [m].
    """
    pairs = pairs_within(poses, np.unique(mesh.indices), within)
    pairs = pairs[~_in_one_face(mesh, pairs)]
    if not len(pairs):
        return replace(unwelded(mesh), mesh=wound_alike(mesh, poses[0]))
    site = joined_by(pairs, mesh.vertex_count)
    corners = _sorted_corners(mesh, site[mesh.indices])
    like = _first_like(corners, corners)
    faces, again = (np.flatnonzero(mask) for mask in (like == np.arange(len(like)), like != np.arange(len(like))))
    doubled = _corners_together(mesh, site, again, like[again])
    label = _lowest(mesh.vertex_count, doubled)
    in_faces = np.isin(mesh.corner_face, faces)
    single = replace(mesh, counts=mesh.counts[faces], indices=label[mesh.indices[in_faces]])
    number = _lowest(mesh.vertex_count, np.concatenate([doubled, _edge_pairs(single, site)]))
    used, number = np.unique(number, return_inverse=True)
    if len(used) == mesh.vertex_count:
        return replace(unwelded(mesh), mesh=wound_alike(mesh, poses[0]))
    number = number.reshape(-1)
    indices = number[mesh.indices[in_faces]].astype(np.int32)
    welded = replace(mesh, counts=mesh.counts[faces], indices=indices, vertex_count=len(used))
    first = np.unique(number, return_index=True)[1]
    return Weld(mesh, wound_alike(welded, poses[0][first]), number, faces)


def weld_skins(mesh: PolygonMesh, poses: Sequence[Float[np.ndarray, "vertices 3"]]) -> Weld | None:
    """Join the skins of a thick sheet into the sheet in its middle; None if the mesh is no thick sheet.

    In a thick sheet the nearest vertex of each vertex is its partner in the opposite skin. Each face is part of a rim,
    between an edge and the partners' edge, or of a skin, with a face between the partners in the opposite skin.

    Args:
        poses: Positions [m], at least one.
    """
    half, used = mesh.half_edges, np.unique(mesh.indices)
    if len(used) < mesh.vertex_count or (half.count != 2).any() or not np.isfinite(poses).all():
        return None
    away, near = map(np.asarray, cKDTree(poses[0]).query(poses[0], 3))
    itself = np.arange(mesh.vertex_count)
    partner = np.where(near[:, 0] == itself, near[:, 1], near[:, 0])
    number = np.unique(np.minimum(itself, partner), return_inverse=True)[1].reshape(-1)
    thick = np.linalg.norm(np.subtract(poses, np.asarray(poses)[:, partner]), axis=2)
    if (partner[partner] != itself).any() or not (0.0 < thick[0]).all() or (thick[0] > THICKEST * away[:, 2]).any():
        return None
    if (thick > UNEVEN * thick[0]).any() or (thick < thick[0] / UNEVEN).any():
        return None
    corners = _sorted_corners(mesh, number[mesh.indices])
    rim = _are_rims(corners)
    sheet = np.flatnonzero(~rim)
    beside = mesh.corner_face[mesh.twin_corners]
    skin = joined_by(beside[~rim[beside].any(axis=1)], mesh.face_count)
    like = sheet[_first_like(corners[sheet], corners[sheet])]
    ones, twos = sheet[like == sheet], sheet[like != sheet]
    repeated = (np.diff(corners[sheet], axis=1) == 0) & (corners[sheet, 1:] >= 0)
    of_skins = np.zeros(mesh.vertex_count, np.int64) - 1
    of_skins[mesh.indices[~rim[mesh.corner_face]]] = skin[mesh.corner_face[~rim[mesh.corner_face]]]
    twice = np.array_equal(np.sort(like[like != sheet]), ones)
    if repeated.any() or (of_skins < 0).any() or not twice or (of_skins == of_skins[partner]).any():
        return None
    faces = np.sort(np.where(skin[twos] < skin[like[like != sheet]], twos, like[like != sheet]))
    in_faces = np.isin(mesh.corner_face, faces)
    joined = PolygonMesh(mesh.counts[faces], number[mesh.indices[in_faces]].astype(np.int32), int(number.max()) + 1)
    middle = 0.5 * (poses[0] + poses[0][partner])
    first = np.unique(number, return_index=True)[1]
    joined = wound_alike(joined, middle[first])
    normals = np.zeros((joined.vertex_count, 3))
    np.add.at(normals, joined.indices, area_vectors(joined, middle[first])[joined.corner_face])
    outward = np.bincount(of_skins, ((poses[0] - middle) * normals[number]).sum(axis=1))
    return Weld(mesh, joined, number, faces, 0.5 * np.sign(outward)[of_skins] * np.median(thick, axis=0))


def _are_rims(corners: np.ndarray) -> np.ndarray:
    """Whether each face, with sorted corners as by `_sorted_corners`, has two different corners at most, shape (F,)."""
    return ((np.diff(corners, axis=1) != 0) & (corners[:, :-1] >= 0)).sum(axis=1) < 2


def _halfway(step: Refinement, ends: np.ndarray) -> np.ndarray:
    """Child vertices halfway between the ends of edges; if both ends are one vertex, that vertex; shape (N,)."""
    halfway = step.parent_vertex_count + find_edges(step.edges, ends)
    return np.where(ends[:, 0] == ends[:, 1], ends[:, 0], halfway)


def wound_alike(mesh: PolygonMesh, points: Float[np.ndarray, "vertices 3"]) -> PolygonMesh:
    """The mesh with faces reversed for consistent winding of neighbours; the same object if already consistent.

    Pieces with reversed faces are wound counter-clockwise seen from outside.
    """
    half, count = mesh.half_edges, mesh.face_count
    first, second = mesh.twin_corners.T
    unlike = half.forward[first] == half.forward[second]
    if not unlike.any():
        return mesh
    a, b = mesh.corner_face[first].astype(np.int64), mesh.corner_face[second].astype(np.int64)
    # The graph has two nodes per face, as authored and reversed: consistent neighbours link nodes of equal kind.
    links = np.concatenate(
        [np.stack([a, np.where(unlike, b + count, b)], 1), np.stack([a + count, np.where(unlike, b, b + count)], 1)]
    )
    label = joined_by(links, 2 * count)
    piece = np.minimum(label[:count], label[count:])
    turned = label[:count] > label[count:]
    mixed = np.zeros(2 * count, bool)
    mixed[piece[a[unlike]]] = True
    mixed[piece[label[:count] == label[count:]]] = False  # A Moebius strip has no two sides.
    sign = np.where(turned, -1.0, 1.0)
    turned ^= (np.bincount(piece, sign * _volumes(mesh, points, piece), 2 * count) < 0.0)[piece]
    flips = (turned & mixed[piece])[mesh.corner_face]
    corners = np.where(flips, mesh.mirrored_corners, np.arange(len(mesh.indices)))
    return replace(mesh, indices=mesh.indices[corners])


def _lowest(count: int, links: np.ndarray) -> np.ndarray:
    """The lowest vertex linked to each vertex, shape (count,)."""
    label = joined_by(links, count)
    return np.unique(label, return_index=True)[1][label]


def _first_like(corners: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """For each face, the first candidate with the same sorted corners, which must exist, shape (F,)."""
    width = max(corners.shape[1], candidates.shape[1])
    rows = [np.pad(array, ((0, 0), (width - array.shape[1], 0)), constant_values=-1) for array in (corners, candidates)]
    label = np.unique(np.concatenate(rows), axis=0, return_inverse=True)[1].reshape(-1)
    labels, first = np.unique(label[len(corners) :], return_index=True)
    return first[np.searchsorted(labels, label[: len(corners)])]


def _sorted_corners(mesh: PolygonMesh, values: np.ndarray) -> np.ndarray:
    """Values at the corners of each face in ascending order, padded with -1 in front, shape (F, most corners)."""
    out = np.full((mesh.face_count, int(mesh.counts.max(initial=0))), -1, np.int64)
    out[mesh.corner_face, np.arange(len(mesh.indices)) - mesh.starts[mesh.corner_face]] = values
    return np.sort(out, axis=1)


def _corners_together(mesh: PolygonMesh, site: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Pairs of coincident corners of pairs of coincident faces, shape (N, 2)."""
    pairs = [np.zeros((0, 2), np.int64)]
    for a, b in zip(first.tolist(), second.tolist(), strict=True):
        p, q = (mesh.indices[mesh.starts[face] : mesh.starts[face + 1]].astype(np.int64) for face in (a, b))
        pairs.append(np.stack([p[np.argsort(site[p])], q[np.argsort(site[q])]], axis=1))
    return np.concatenate(pairs)


def _edge_pairs(mesh: PolygonMesh, site: np.ndarray) -> np.ndarray:
    """Pairs of ends of coincident open edges with exactly two copies, shape (N, 2)."""
    edges = open_edges(mesh)
    edges = edges[site[edges[:, 0]] != site[edges[:, 1]]]
    turned = site[edges[:, 0]] > site[edges[:, 1]]
    edges = np.where(turned[:, None], edges[:, ::-1], edges)
    ends = site[edges]
    _, group, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    order = np.argsort(group, kind="stable")
    twice = edges[order[count[group][order] == 2]].reshape(-1, 2, 2)
    return np.concatenate([twice[:, :, 0], twice[:, :, 1]])


def seam_reach(mesh: PolygonMesh, points: Float[np.ndarray, "vertices 3"], tolerance: float) -> float:
    """Distance below which vertices coincide [m]: the tolerance, at least `WELDED`, at most `WIDEST`.

    A larger tolerance would join neighbours on the same border.
    """
    ends = mesh.half_edges.edges
    edge = float(np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1).mean())
    return float(np.clip(tolerance, WELDED * edge, WIDEST * edge))


def pairs_within(poses: Sequence[np.ndarray], vertices: np.ndarray, within: float) -> np.ndarray:
    """Pairs of some vertices within a distance [m] in every pose, shape (N, 2)."""
    for pose in poses:
        vertices = vertices[np.isfinite(pose[vertices]).all(axis=1)]
    if len(vertices) < 2:
        return np.zeros((0, 2), np.int64)
    pairs = vertices[cKDTree(poses[0][vertices]).query_pairs(within, output_type="ndarray")].reshape(-1, 2)
    for pose in poses[1:]:
        pairs = pairs[np.linalg.norm(pose[pairs[:, 0]] - pose[pairs[:, 1]], axis=1) <= within]
    return pairs


def _in_one_face(mesh: PolygonMesh, pairs: np.ndarray) -> np.ndarray:
    """Whether each pair of vertices has a common face."""
    if not len(pairs):
        return np.zeros(0, bool)
    used = np.unique(pairs)
    corners = np.flatnonzero(np.isin(mesh.indices, used))
    key = mesh.corner_face[corners].astype(np.int64) * mesh.vertex_count + mesh.indices[corners]
    order = np.argsort(mesh.indices[corners], kind="stable")
    starts = np.searchsorted(mesh.indices[corners][order], np.arange(mesh.vertex_count + 1))
    shared, keys = np.zeros(len(pairs), bool), np.sort(key)
    widest = int(np.diff(starts)[used].max(initial=0))
    for nth in range(widest):  # Loop over the faces of the first vertex.
        at = starts[pairs[:, 0]] + nth
        exists = at < starts[pairs[:, 0] + 1]
        face = mesh.corner_face[corners[order[np.where(exists, at, 0)]]].astype(np.int64)
        wanted = face * mesh.vertex_count + pairs[:, 1]
        position = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        shared |= exists & (keys[position] == wanted)
    return shared


def _volumes(mesh: PolygonMesh, points: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """Signed volume between each face and the centre of its piece [m^3], shape (F,)."""
    owner = piece[mesh.corner_face]
    sums, count = np.zeros((len(piece) * 2, 3)), np.bincount(owner, minlength=len(piece) * 2)
    np.add.at(sums, owner, points[mesh.indices])
    relative = points[mesh.indices] - (sums / np.maximum(count, 1)[:, None])[owner]
    first = relative[mesh.starts[mesh.corner_face]]
    volumes = (first * np.cross(relative, relative[mesh.next_corner])).sum(axis=1) / 6.0
    return np.bincount(mesh.corner_face, volumes, mesh.face_count)
