"""Polygon meshes and the element lists for sums of forces.

All code is vectorised numpy on index arrays; positions appear only if a choice depends on them. The winding is the
authored winding throughout.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

TIE = 1e-5
"""Relative difference below which two splits of a face count as equal. The lowest vertex number then decides,
independent of rounding, the rotation of the cloth, the winding and the face's first corner."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Undirected edges of triangles.

    Attributes:
        vertices: Edges with the lower vertex first, in lexicographic order, shape (E, 2), int32.
        face_count: Number of triangles at each edge, shape (E,), int32; triangles with a repeated vertex do not count.
        sides: The edge along each side of the triangles, shape (T, 3), int32; -1 for a loop.
    """

    vertices: np.ndarray
    face_count: np.ndarray
    sides: np.ndarray


@dataclass(frozen=True, eq=False)
class TriangleSplit:
    """A triangulation of polygons.

    Attributes:
        triangles: Vertices, in face order and with the faces' winding, shape (T, 3), int32.
        face: The face of each triangle, shape (T,), int32.
    """

    triangles: np.ndarray
    face: np.ndarray


@dataclass(frozen=True, eq=False)
class HalfEdges:
    """The edges of a polygon mesh, and the edge starting at each corner.

    Attributes:
        edges: Undirected edges (lo, hi), lexicographic, shape (E, 2), int32; lo == hi if a face repeats a vertex.
        edge: Edge from each corner to the next corner of the face, shape (C,), int32.
        forward: Whether the half-edge runs from lo to hi, shape (C,), bool.
        count: Number of half-edges of each edge, shape (E,), int32: 1 on a boundary, 2 inside, more if non-manifold.
    """

    edges: np.ndarray
    edge: np.ndarray
    forward: np.ndarray
    count: np.ndarray


@dataclass(frozen=True, eq=False)
class PolygonMesh:
    """Topology of a polygon mesh. Its C = sum(counts) corners are numbered as in ``indices``.

    Attributes:
        counts: Vertices per face, shape (F,), int32.
        indices: Vertex of each corner, faces one after another, shape (C,), int32.
        vertex_count: Number of vertices V, including unused vertices.
        least_polygon: Fewest corners of a face split by subdivision into quads round its centre: 3 for Catmull and
            Clark's scheme, 4 if triangles are split into four.

    Raises:
        ValueError: The counts are negative or do not sum to the number of indices.
    """

    counts: np.ndarray
    indices: np.ndarray
    vertex_count: int
    least_polygon: int = 4

    def __post_init__(self) -> None:
        """Convert arrays to int32 and check their sizes."""
        object.__setattr__(self, "counts", np.asarray(self.counts, np.int32).reshape(-1))
        object.__setattr__(self, "indices", np.asarray(self.indices, np.int32).reshape(-1))
        object.__setattr__(self, "vertex_count", int(self.vertex_count))
        total = int(self.counts.sum(dtype=np.int64))
        if total != len(self.indices) or (len(self.counts) and self.counts.min() < 0):
            raise ValueError(f"face vertex counts sum to {total} but there are {len(self.indices)} indices")

    @property
    def face_count(self) -> int:
        """Number of faces F."""
        return len(self.counts)

    @cached_property
    def starts(self) -> np.ndarray:
        """First corner of each face and, last, the number of corners: shape (F + 1,), int64."""
        return np.concatenate([[0], np.cumsum(self.counts, dtype=np.int64)])

    @cached_property
    def is_polygon(self) -> np.ndarray:
        """Whether subdivision splits each face into quads, shape (F,), bool."""
        return self.counts >= self.least_polygon

    @cached_property
    def is_triangles(self) -> bool:
        """Whether every face is a triangle."""
        return bool(np.all(self.counts == 3))

    @cached_property
    def corner_face(self) -> np.ndarray:
        """Face of each corner, shape (C,), int32."""
        return np.repeat(np.arange(self.face_count, dtype=np.int32), self.counts)

    @cached_property
    def next_corner(self) -> np.ndarray:
        """The corner after each corner in its face, shape (C,), int64."""
        following = np.arange(1, len(self.indices) + 1)
        used = self.counts > 0
        following[self.starts[1:][used] - 1] = self.starts[:-1][used]
        return following

    @cached_property
    def previous_corner(self) -> np.ndarray:
        """The corner before each corner in its face, shape (C,), int64."""
        previous = np.empty_like(self.next_corner)
        previous[self.next_corner] = np.arange(len(previous))
        return previous

    @property
    def mirrored_corners(self) -> np.ndarray:
        """For each corner, the corner to take its place to reverse the winding, shape (C,), int64; first ones stay."""
        start, size = self.starts[self.corner_face], self.counts[self.corner_face]
        return start + (start - np.arange(len(self.indices))) % size

    @cached_property
    def half_edges(self) -> HalfEdges:
        """Edges of the faces, and the edge of each half-edge."""
        start, end = self.indices, self.indices[self.next_corner]
        edges, edge = paired(start, end, self.vertex_count)
        return HalfEdges(edges, edge, start <= end, np.bincount(edge, minlength=len(edges)).astype(np.int32))

    @cached_property
    def twin_corners(self) -> np.ndarray:
        """For each edge with two half-edges, the two corners of the half-edges, shape (N, 2), in the edges' order."""
        half = self.half_edges
        order, starts = sorted_rows(half.edge, count=len(half.count)), np.cumsum(half.count) - half.count
        double = starts[(half.count == 2) & (half.edges[:, 0] != half.edges[:, 1])]
        return np.stack([order[double], order[double + 1]], axis=1)

    def check_range(self) -> None:
        """Check the indices.

        Raises:
            ValueError: An index is negative or not below ``vertex_count``.
        """
        bad = np.flatnonzero((self.indices < 0) | (self.indices >= self.vertex_count))
        if len(bad):
            face, vertex = self.corner_face[bad[0]], self.indices[bad[0]]
            raise ValueError(f"face {face} uses vertex {vertex}, but the mesh has {self.vertex_count} vertices")

    @cached_property
    def fan_counts(self) -> np.ndarray:
        """Number of fans at each vertex: groups of corners linked by shared edges, shape (V,), int32.

        The number is 1 at manifold vertices, 2 or more if a surface touches itself in a point, 0 at isolated vertices.
        """
        half = self.half_edges
        order = sorted_rows(half.edge, count=len(half.count))
        same = np.flatnonzero(half.edge[order[1:]] == half.edge[order[:-1]])
        ends = np.stack([np.arange(len(self.indices)), self.next_corner], axis=1)
        ends = np.where(half.forward[:, None], ends, ends[:, ::-1])
        first, second = ends[order[same]].reshape(-1), ends[order[same + 1]].reshape(-1)
        label = joined_by(np.stack([first, second], axis=1), len(self.indices))
        fans = np.unique(label.astype(np.int64) * max(self.vertex_count, 1) + self.indices)
        return np.bincount(fans % max(self.vertex_count, 1), minlength=self.vertex_count).astype(np.int32)

    def triangulate(self, points: np.ndarray | None = None) -> TriangleSplit:
        """Split the faces into fans of triangles.

        Without points a fan starts at the first corner. On quads made by :func:`.subdivide.subdivide` these diagonals
        run from a parent's corner to its face point, and thus alternate in direction. Faces under three corners vanish.

        Args:
            points: Positions, shape (V, 3); when given, quads are split along the shorter diagonal (the inner diagonal
                for concave quads) and larger polygons fan from the corner with the fattest fan.

        Returns:
            The triangles and the face of each.
        """
        if self.is_triangles:
            return TriangleSplit(self.indices.reshape(-1, 3), np.arange(self.face_count, dtype=np.int32))
        pieces = np.maximum(self.counts - 2, 0)
        offsets = np.concatenate([[0], np.cumsum(pieces, dtype=np.int64)])
        triangles = np.empty((int(offsets[-1]), 3), np.int32)
        for size in np.unique(self.counts[self.counts >= 3]):
            faces = np.flatnonzero(self.counts == size)
            corners = self.indices[self.starts[faces, None] + np.arange(size)]
            first = np.zeros(len(faces), np.int64) if points is None else _fan_corner(corners, points)
            turned = np.take_along_axis(corners, (first[:, None] + np.arange(size)) % size, axis=1)
            triangles[offsets[faces, None] + np.arange(size - 2)] = _fans(turned)
        return TriangleSplit(triangles, np.repeat(np.arange(self.face_count, dtype=np.int32), pieces))


def area_vectors(mesh: PolygonMesh, points: np.ndarray) -> np.ndarray:
    """Twice the area vector of each face [m^2], shape (F, 3), by Newell's sum; faces have corners."""
    start, end = points[mesh.indices], points[mesh.indices[mesh.next_corner]]
    return np.add.reduceat(np.cross(start, end), mesh.starts[: mesh.face_count])


def face_normals(mesh: PolygonMesh, points: np.ndarray) -> np.ndarray:
    """Unit normal of each face, shape (F, 3); 0 for a face without area."""
    area = area_vectors(mesh, points)
    return area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), np.finfo(float).tiny)


def _fans(corners: np.ndarray) -> np.ndarray:
    """Fans from the first corner: (F, n) to (F, n - 2, 3)."""
    first = np.broadcast_to(corners[:, :1], (len(corners), corners.shape[1] - 2))
    return np.stack([first, corners[:, 1:-1], corners[:, 2:]], axis=-1)


def _fan_corner(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Start corner for the fan of each face of a given size: (F, n) to (F,)."""
    size = corners.shape[1]
    shape = np.asarray(points, np.float64)[corners]
    shape = shape - shape.mean(axis=1, keepdims=True)
    normal = np.cross(shape, np.roll(shape, -1, axis=1)).sum(axis=1)
    worst = np.empty((len(corners), size if size > 4 else size - 2))
    for first in range(worst.shape[1]):
        fan = np.roll(shape, -first, axis=1)
        spokes = fan[:, 1:] - fan[:, :1]
        areas = np.cross(spokes[:, :-1], spokes[:, 1:]) @ normal[:, :, None]
        worst[:, first] = areas[:, :, 0].min(axis=1)
    if size != 4:
        best = worst.max(axis=1, keepdims=True)
        tied = worst >= best - TIE * np.abs(best)
        return np.where(tied, corners, np.iinfo(np.int32).max).argmin(axis=1)
    lengths = np.linalg.norm(shape[:, [2, 3]] - shape[:, [0, 1]], axis=2)
    inside = worst > 0
    tied = np.abs(lengths[:, 1] - lengths[:, 0]) < TIE * lengths[:, 0]
    shorter = np.where(tied, corners.argmin(axis=1) % 2, lengths[:, 1] < lengths[:, 0])
    return np.where(inside[:, 0] != inside[:, 1], inside[:, 1], shorter).astype(np.int64)


def sorted_rows(*columns: np.ndarray, count: int) -> np.ndarray:
    """The order that sorts rows of numbers under a count, by columns, shape (K,), int32; equal rows stay in order."""
    order, starts = np.arange(len(columns[0]), dtype=np.int32), np.arange(len(columns[0]) + 1, dtype=np.int32)
    for column in reversed(columns):
        order = sparse.csr_matrix((order, column[order], starts), shape=(len(order), count)).tocsc().data
    return order


def paired(start: np.ndarray, end: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Unique edges, lower vertex first, in lexicographic order, shape (E, 2); and the edge of each pair, shape (K,)."""
    ends = np.stack([np.minimum(start, end), np.maximum(start, end)])
    order = sorted_rows(*ends, count=count)
    ends, pair = ends[:, order], np.empty(len(order), np.int32)
    first = np.append(True, (ends[:, 1:] != ends[:, :-1]).any(axis=0))[: len(order)]
    pair[order] = np.cumsum(first) - 1
    return np.ascontiguousarray(ends[:, first].T, np.int32), pair


def find_edges(edges: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Look up edges by their vertices.

    Args:
        edges: Edges (lo, hi) in lexicographic order, shape (E, 2).
        pairs: Vertices in either order, shape (K, 2).

    Returns:
        Row of each pair in ``edges``, shape (K,), int64; -1 for missing pairs.
    """
    edges, pairs = np.asarray(edges, np.int64), np.asarray(pairs, np.int64).reshape(-1, 2)
    if len(edges) == 0:
        return np.full(len(pairs), -1)
    stride = int(edges.max()) + 1
    keys = edges[:, 0] * stride + edges[:, 1]
    low, high = np.minimum(pairs[:, 0], pairs[:, 1]), np.maximum(pairs[:, 0], pairs[:, 1])
    wanted = np.where((low >= 0) & (high < stride), low * stride + high, -1)
    row = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[row] == wanted, row, -1)


def edges_of(triangles: np.ndarray, vertex_count: int) -> Edges:
    """The undirected edges of triangles of numbered vertices, shape (T, 3), without loops from a vertex to itself."""
    a, b, c = triangles.T
    start, end = triangles.reshape(-1), triangles[:, [1, 2, 0]].reshape(-1)
    distinct, proper = np.flatnonzero(start != end), (a != b) & (b != c) & (c != a)
    sides = np.full(len(start), -1, np.int32)
    vertices, sides[distinct] = paired(start[distinct], end[distinct], vertex_count)
    count = np.bincount(sides[np.repeat(proper, 3)], minlength=len(vertices))
    return Edges(vertices, count.astype(np.int32), sides.reshape(-1, 3))


def joined_by(edges: np.ndarray, count: int) -> np.ndarray:
    """The connected component of each vertex, by the edges, shape (V,)."""
    graph = sparse.coo_matrix((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return csgraph.connected_components(graph, directed=False)[1]


def patches_with(edges: np.ndarray, members: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Mask of the patches with at least one seed, shape (V,); patches are the connected parts of ``members``."""
    patch = joined_by(edges[members[edges].all(axis=1)], len(members))
    return members & np.isin(patch, patch[members & seeds])


def adjacency(edges: np.ndarray, count: int) -> sparse.csr_matrix:
    """Adjacency matrix of vertices joined by edges."""
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    return sparse.csr_matrix((np.ones(len(rows), np.float32), (rows, columns)), shape=(count, count))
