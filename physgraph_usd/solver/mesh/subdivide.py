"""Subdivision of polygon meshes by sparse stencils, built once per topology.

Each face is split by a rule depending on the face only, so meshes of triangles, quads and larger polygons conform: a
triangle into four triangles, any larger polygon into quads around its centroid. Sharp edges of closed pieces, such as
the rim of a thick garment, are kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from .topology import PolygonMesh, TriangleSplit, face_normals, find_edges

SHARP = 45.0
"""Least angle between the rest normals of two faces for a sharp edge [degrees]."""
SHARPNESS = 0.5
"""Sharpness from which an edge or a vertex counts as sharp in a subdivision: USD's fractional sharpness is rounded."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """One subdivision step.

    Attributes:
        mesh: The child. Its vertices are the parent's vertices, then one per parent edge, then one per parent polygon
            of four or more corners, in face order. The children of a face are consecutive, in the parent's face order.
        linear: Placement at vertices, midpoints and centroids, shape (V_child, V_parent), float64; rows sum to 1.
        parent_face: Parent of each child face, shape (F_child,), int32.
        edges: Parent edges (lo, hi), shape (E, 2), int32; child vertex ``V_parent + e`` is the midpoint of edge e.
    """

    mesh: PolygonMesh
    linear: sparse.csr_matrix
    parent_face: np.ndarray
    edges: np.ndarray

    @property
    def parent_vertex_count(self) -> int:
        """Number of vertices of the parent, V_parent."""
        return int(self.linear.get_shape()[1])


def subdivide(mesh: PolygonMesh) -> Refinement:
    """Split every face once.

    A triangle (a, b, c) becomes (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca); corner i of a polygon becomes the
    quad (v_i, e_i, centre, e_{i-1}). Winding is kept. Faces under three corners have no children. Non-manifold edges,
    isolated vertices and repeated vertices are allowed.

    Args:
        mesh: The parent.

    Returns:
        The child and its stencil.

    Raises:
        ValueError: An index is out of range.
    """
    mesh.check_range()
    half = mesh.half_edges
    polygon = mesh.is_polygon
    child_count = np.where(polygon, mesh.counts, np.where(mesh.counts == 3, 4, 0))
    child_size = np.where(polygon, 4, 3)
    starts = np.concatenate([[0], np.cumsum(child_count * child_size, dtype=np.int64)])
    indices = np.empty(int(starts[-1]), np.int32)
    midpoint = (mesh.vertex_count + half.edge).astype(np.int32)
    _place_triangles(mesh, midpoint, starts, indices)
    _place_quads(mesh, midpoint, starts, indices)
    vertex_count = mesh.vertex_count + len(half.edges) + int(polygon.sum())
    child = PolygonMesh(np.repeat(child_size, child_count), indices, vertex_count)
    parent_face = np.repeat(np.arange(mesh.face_count, dtype=np.int32), child_count)
    return Refinement(child, _linear(mesh), parent_face, half.edges)


def fine_count(mesh: PolygonMesh, levels: int) -> int:
    """Number of vertices after subdivision, without building the meshes; exact unless faces repeat a corner.

    Args:
        mesh: The cage.
        levels: Number of subdivisions.
    """
    vertices, edges = mesh.vertex_count, len(mesh.half_edges.edges)
    larger = mesh.is_polygon
    triangles = int(((mesh.counts == 3) & ~larger).sum())
    polygons, corners = int(larger.sum()), int(mesh.counts[larger].sum())
    for _ in range(levels):
        vertices += edges + polygons
        edges = 2 * edges + 3 * triangles + corners
        triangles, polygons, corners = 4 * triangles, corners, 4 * corners
    return vertices


def _place_triangles(mesh: PolygonMesh, midpoint: np.ndarray, starts: np.ndarray, indices: np.ndarray) -> None:
    """Write the children of triangles into ``indices``."""
    faces = np.flatnonzero((mesh.counts == 3) & ~mesh.is_polygon)
    corners = mesh.starts[faces, None] + np.arange(3)
    a, b, c = mesh.indices[corners].T
    ab, bc, ca = midpoint[corners].T
    children = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1)
    indices[starts[faces, None] + np.arange(12)] = children


def _place_quads(mesh: PolygonMesh, midpoint: np.ndarray, starts: np.ndarray, indices: np.ndarray) -> None:
    """Write the children of polygons into ``indices``."""
    corners = np.flatnonzero(mesh.is_polygon[mesh.corner_face])
    face = mesh.corner_face[corners]
    quads = np.stack(
        [mesh.indices[corners], midpoint[corners], face_points(mesh)[face], midpoint[mesh.previous_corner[corners]]],
        axis=1,
    )
    local = corners - mesh.starts[face]
    indices[(starts[face] + 4 * local)[:, None] + np.arange(4)] = quads


def face_points(mesh: PolygonMesh) -> np.ndarray:
    """Child vertex at the centre of each parent face, shape (F,), int32; -1 for faces without a centre vertex."""
    polygon = mesh.is_polygon
    first = mesh.vertex_count + len(mesh.half_edges.edges)
    return np.where(polygon, first + np.cumsum(polygon) - 1, -1).astype(np.int32)


def _linear(mesh: PolygonMesh) -> sparse.csr_matrix:
    """Stencil of vertices, midpoints and centroids."""
    edges = mesh.half_edges.edges
    sizes = mesh.counts[mesh.is_polygon]
    columns = np.concatenate(
        [np.arange(mesh.vertex_count), edges.reshape(-1), mesh.indices[mesh.is_polygon[mesh.corner_face]]]
    )
    lengths = np.concatenate([np.ones(mesh.vertex_count, np.int64), np.full(len(edges), 2), sizes])
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    weights = np.repeat(1.0 / lengths, lengths)
    matrix = sparse.csr_matrix((weights, columns, offsets), shape=(len(lengths), mesh.vertex_count))
    matrix.sum_duplicates()
    return matrix


def on_triangles(mesh: PolygonMesh, refinement: Refinement, split: TriangleSplit) -> sparse.csr_matrix:
    """The linear placement with the centres of quads moved onto their split diagonals, shape (V_child, V_parent).

    With fans from first corners, the child then lies on the parent's triangles and has the same crossings, except at
    larger polygons.

    Args:
        mesh: The parent.
        refinement: Subdivision of the parent.
        split: Triangles of the parent.
    """
    triangle = np.flatnonzero(np.diff(split.face, prepend=-1))
    face = split.face[triangle]
    quad = mesh.counts[face] == 4
    centre, ends = face_points(mesh)[face[quad]], split.triangles[triangle[quad]][:, [0, 2]]
    weight = np.ones(refinement.mesh.vertex_count)
    weight[centre] = 0.0
    half = sparse.csr_matrix((np.full(ends.size, 0.5), (np.repeat(centre, 2), ends.ravel())), refinement.linear.shape)
    return sparse.csr_matrix(sparse.diags(weight) @ refinement.linear + half)


def subdivide_times(mesh: PolygonMesh, levels: int) -> tuple[Refinement, ...]:
    """Subdivide repeatedly.

    Args:
        mesh: The coarsest mesh.
        levels: Number of steps, 0 or more.

    Returns:
        One refinement per step, coarse to fine.

    Raises:
        ValueError: ``levels`` is negative, or an index is out of range.
    """
    if levels < 0:
        raise ValueError(f"levels is {levels}; it must be 0 or more")
    refinements: list[Refinement] = []
    for _ in range(levels):
        refinements.append(subdivide(refinements[-1].mesh if refinements else mesh))
    return tuple(refinements)


def compose(refinements: Sequence[Refinement]) -> sparse.csr_matrix:
    """Multiply the linear stencils of successive refinements.

    Args:
        refinements: One or more, coarse to fine.

    Returns:
        The stencil from the coarsest to the finest vertices, shape (V_fine, V_coarse); rows sum to 1.

    Raises:
        ValueError: There is no refinement.
    """
    if not refinements:
        raise ValueError("no refinements to compose; the stencil of level 0 is the identity")
    return reduce(lambda product, refinement: refinement.linear @ product, refinements[1:], refinements[0].linear)


@dataclass(frozen=True, eq=False)
class _Rules:
    """Smooth rule for each edge and vertex."""

    smooth_edge: np.ndarray  # (E,) rule of the two faces
    boundary: np.ndarray  # (E,) one face only, or a crease
    smooth_vertex: np.ndarray  # (V,) rule of all faces
    rim_vertex: np.ndarray  # (V,) cubic B-spline along two boundary edges


def smooth(
    mesh: PolygonMesh, refinement: Refinement, *, creased: np.ndarray | None = None, corners: np.ndarray | None = None
) -> sparse.csr_matrix:
    """Build the smooth placement of the same child vertices.

    Triangles use Loop's weights, ``beta = (5/8 - (3/8 + cos(2 pi / n) / 4)^2) / n``, and polygons the weights of
    Catmull and Clark, both as in OpenSubdiv. An edge between a triangle and a polygon uses half of either rule. A
    vertex between both weights each rule by the fraction of a full turn of a regular corner, a sixth or a fourth: with
    s the sum of the fractions, the rules are evaluated at valence 6 s and 4 s, and each corner adds its part. The
    result is the scheme of Stam and Loop (Quad/Triangle Subdivision, 2003) for s = 1, and the pure rule for a single
    kind of faces.

    Boundaries and creases are cubic B-splines. Fixed are: vertices with one face, with three or more edges on
    boundaries and creases, on non-manifold edges or between several fans, isolated vertices, and corners.

    Args:
        mesh: The parent.
        refinement: Subdivision of the parent, from :func:`subdivide`.
        creased: Whether each edge is a sharp crease, shape (E,), bool; None without creases.
        corners: Whether each vertex is a sharp corner, shape (V,), bool; None without corners.

    Returns:
        Stencil, shape (V_child, V_parent), float64; rows sum to 1.
    """
    rules = _rules(mesh, creased, corners)
    parts = [_fixed_part(mesh, rules), _edge_part(mesh, rules), _rim_part(mesh, rules), _vertex_part(mesh, rules)]
    rows, columns, weights = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    size = refinement.mesh.vertex_count
    average = sparse.coo_matrix((weights, (rows, columns)), shape=(size, size)).tocsr()
    return average @ refinement.linear


def _rules(mesh: PolygonMesh, creased: np.ndarray | None, corners: np.ndarray | None) -> _Rules:
    """Classify edges and vertices."""
    half, size = mesh.half_edges, mesh.vertex_count
    proper = half.edges[:, 0] != half.edges[:, 1]
    manifold = half.count <= 2
    boundary = (half.count == 1) & proper
    boundary = boundary if creased is None else boundary | (creased & proper & manifold)
    faces = np.bincount(mesh.indices, minlength=size)
    at_rim = np.bincount(half.edges[boundary].reshape(-1), minlength=size)
    fixed = (faces < 2) | (at_rim > 2) | (mesh.fan_counts > 1)
    fixed = fixed if corners is None else fixed | corners
    fixed[half.edges[~manifold].reshape(-1)] = True
    rim_vertex = (at_rim == 2) & ~fixed
    return _Rules(proper & manifold & ~boundary, boundary, ~fixed & ~rim_vertex, rim_vertex)


_Part = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Rows, columns and weights; columns are child vertices in their linear positions."""


def _stack(rows: np.ndarray, columns: list[np.ndarray], weights: list[np.ndarray | float]) -> _Part:
    """Join several columns for the same rows."""
    full = [np.broadcast_to(np.asarray(weight, np.float64), rows.shape) for weight in weights]
    return np.tile(rows, len(columns)), np.concatenate(columns), np.concatenate(full)


def _fixed_part(mesh: PolygonMesh, rules: _Rules) -> _Part:
    """Fixed vertices, midpoints of boundary and non-manifold edges, and face points."""
    edges = mesh.vertex_count + np.flatnonzero(~rules.smooth_edge)
    faces = face_points(mesh)
    unmoved = np.concatenate([np.flatnonzero(~rules.smooth_vertex & ~rules.rim_vertex), edges, faces[faces >= 0]])
    return unmoved, unmoved, np.ones(len(unmoved))


def _edge_part(mesh: PolygonMesh, rules: _Rules) -> _Part:
    """Each face's half of the rule of a smooth edge."""
    corners = np.flatnonzero(rules.smooth_edge[mesh.half_edges.edge])
    polygon = mesh.is_polygon[mesh.corner_face[corners]]
    start, end = mesh.indices[corners], mesh.indices[mesh.next_corner[corners]]
    opposite = mesh.indices[mesh.previous_corner[corners]]
    far = np.where(polygon, face_points(mesh)[mesh.corner_face[corners]], opposite)
    near, across = np.where(polygon, 1 / 8, 3 / 16), np.where(polygon, 1 / 4, 1 / 8)
    return _stack(mesh.vertex_count + mesh.half_edges.edge[corners], [start, end, far], [near, near, across])


def _rim_part(mesh: PolygonMesh, rules: _Rules) -> _Part:
    """Cubic B-spline vertices, one half per boundary edge."""
    ends = mesh.half_edges.edges[rules.boundary]
    ends = np.concatenate([ends, ends[:, ::-1]])
    vertex, neighbour = ends[rules.rim_vertex[ends[:, 0]]].T
    return _stack(vertex, [vertex, neighbour], [3 / 8, 1 / 8])


def _vertex_part(mesh: PolygonMesh, rules: _Rules) -> _Part:
    """Each corner's part of the rule of a smooth vertex."""
    corners = np.flatnonzero(rules.smooth_vertex[mesh.indices])
    polygon = mesh.is_polygon[mesh.corner_face[corners]]
    vertex, before = mesh.indices[corners], mesh.previous_corner[corners]
    turn = np.bincount(vertex, weights=np.where(polygon, 1 / 4, 1 / 6), minlength=mesh.vertex_count)[vertex]
    valence = np.where(polygon, 4, 6) * turn
    beta = (5 / 8 - (3 / 8 + np.cos(2 * np.pi / valence) / 4) ** 2) / valence
    ring = np.where(polygon, valence**-2.0, beta / 2)
    edge = mesh.half_edges.edge
    ahead = np.where(polygon, mesh.vertex_count + edge[corners], mesh.indices[mesh.next_corner[corners]])
    behind = np.where(polygon, mesh.vertex_count + edge[before], mesh.indices[before])
    centre = np.where(polygon, face_points(mesh)[mesh.corner_face[corners]], vertex)
    centre_weight = 1 / valence - 2 * ring
    return _stack(
        vertex,
        [ahead, behind, centre, vertex],
        [ring, ring, np.where(polygon, ring, centre_weight), np.where(polygon, centre_weight - ring, 0.0)],
    )


def creases_of(
    mesh: PolygonMesh, rest: Float[np.ndarray, "vertices 3"], closed: Bool[np.ndarray, " vertices"] | None
) -> Int[np.ndarray, "creases 2"]:
    """End vertices of the sharp edges of closed pieces, in the order of the mesh's edges.

    Args:
        mesh: The cage.
        rest: Rest positions [m].
        closed: Whether each vertex belongs to a closed piece; None without such pieces.
    """
    if closed is None or not closed.any():
        return np.zeros((0, 2), np.int32)
    half, normal = mesh.half_edges, face_normals(mesh, rest)
    first, second = mesh.twin_corners[closed[mesh.indices[mesh.twin_corners[:, 0]]]].T
    same = np.where(half.forward[first] != half.forward[second], 1.0, -1.0)  # Neighbours may have opposite winding.
    cosine = same * (normal[mesh.corner_face[first]] * normal[mesh.corner_face[second]]).sum(axis=1)
    return half.edges[half.edge[first[cosine < np.cos(np.radians(SHARP))]]]


@dataclass(frozen=True, eq=False)
class ControlMesh:
    """A subdivision cage with sharp edges and vertices.

    Attributes:
        mesh: The faces.
        ends: Vertices of the crease edges, shape (C, 2).
        creases: Sharpness of each crease edge, the number of subdivisions that it stays a crease, shape (C,).
        corners: Sharpness of each vertex, shape (V,); None without corners.
    """

    mesh: PolygonMesh
    ends: Int[np.ndarray, "creases 2"]
    creases: Float[np.ndarray, " creases"]
    corners: Float[np.ndarray, " vertices"] | None = None

    def subdivided(self, step: Refinement) -> tuple[sparse.csr_matrix, ControlMesh]:
        """The smooth placement of the child vertices, shape (V_child, V), and the child with what is still sharp.

        Args:
            step: Subdivision of the mesh, from :func:`subdivide`.
        """
        row = find_edges(step.edges, self.ends)
        sharp = (self.creases >= SHARPNESS) & (row >= 0)
        creased, middles = np.isin(np.arange(len(step.edges)), row[sharp]), self.mesh.vertex_count + row[sharp]
        halves = np.concatenate([np.stack([self.ends[sharp, end], middles], axis=1) for end in (0, 1)])
        corners, pinned = None, None
        if self.corners is not None:
            pinned, corners = self.corners >= SHARPNESS, np.zeros(step.mesh.vertex_count)
            corners[: self.mesh.vertex_count] = self.corners - 1.0
        stencil = sparse.csr_matrix(smooth(self.mesh, step, creased=creased, corners=pinned))
        return stencil, ControlMesh(step.mesh, halves, np.tile(self.creases[sharp] - 1.0, 2), corners)
