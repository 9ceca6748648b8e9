"""Elastic elements of cloth: springs, membrane triangles and hinges of meshes of triangles and quads.

A quad split along one diagonal is stiffer at the ends of the diagonal, and vertices there stand up on folds. Therefore
no element prefers a diagonal. Springs and the membrane of a quad are the mean over both splits. A hinge between two
faces bends about the common edge, and a quad's normal at the edge is the normal of the triangle from the edge to the
midpoint of the opposite side. The twist of a quad is measured about the diagonal of its split: small twists are equal
about either diagonal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .topology import PolygonMesh, TriangleSplit, edges_of, paired, sorted_rows
from .vectors import at_corners, cross, dot, norm

QUAD_SPRING = (0.75, 1.5)
"""Factors of the springs along a quad's sides and diagonals. A grid of squares of Young's modulus Y then has
C11 = 9/8 Y, C12 = C66 = 3/8 Y: isotropic, because C11 - C12 = 2 C66, with nu = 1/3, like a lattice of triangles."""


@dataclass(frozen=True, eq=False)
class ElasticElements:
    """Elastic elements of one garment at one level.

    Attributes:
        springs: End vertices, lexicographic, shape (S, 2).
        edge_spring: The spring along each edge of the split, ascending, shape (E,).
        sides: The spring along each side of the triangles, shape (M, 3).
        membrane: Corner vertices of triangles; the third side of a quad's triangle is a diagonal, shape (M, 3).
        share: Fraction of the area represented by a triangle: a half for a quad's triangle, shape (M,).
        face: The face of each triangle, shape (M,).
        hinges: Edge i-j, the corners k, k' of the first face opposite to the edge, and l, l' of the second; k = k' at a
            triangle, shape (H, 6).
        hinge_spring: The spring along each hinge's edge, shape (H,).
        twists: Whether a hinge is a quad's twist about its diagonal i-j, shape (H,).
    """

    springs: np.ndarray
    edge_spring: np.ndarray
    sides: np.ndarray
    membrane: np.ndarray
    share: np.ndarray
    face: np.ndarray
    hinges: np.ndarray
    hinge_spring: np.ndarray
    twists: np.ndarray


def elastic_elements(mesh: PolygonMesh, split: TriangleSplit, rest: np.ndarray) -> ElasticElements:
    """The elements of a mesh.

    A quad not convex at rest, or with an edge or a corner without extent, and any larger polygon count as the triangles
    of their split.

    Args:
        split: Sound triangles of the mesh.
        rest: Rest positions [m], shape (V, 3), float64.
    """
    quads = _convex_quads(mesh, split, rest)
    a, b, c, d = mesh.indices[mesh.starts[quads, None] + np.arange(4)].T
    not_quad = ~np.isin(split.face, quads)
    halves = np.stack([a, b, c, c, d, a, b, c, d, d, a, b], axis=1).reshape(-1, 3)
    membrane = np.concatenate([split.triangles[not_quad], halves]).astype(np.int32)
    face = np.concatenate([split.face[not_quad], np.repeat(quads, 4)])
    share = np.where(np.arange(len(membrane)) < not_quad.sum(), 1.0, 0.5)
    springs = edges_of(membrane, mesh.vertex_count)
    single, of_halves = springs.sides[: not_quad.sum()], springs.sides[not_quad.sum() :].reshape(-1, 12)
    around = of_halves[:, [0, 1, 3, 4]]
    first = np.searchsorted(split.face, quads)
    (i, ell, j), k = split.triangles[first].T, split.triangles[first + 1, 2]
    twist = np.stack([i, j, k, k, ell, ell], axis=1)
    diagonal = np.where((i == a) | (i == c), of_halves[:, 2], of_halves[:, 11])
    proper = (single >= 0).all(axis=1)
    table = _faces_at_sides(split.triangles[not_quad][proper], np.stack([a, b, c, d], axis=1))
    hinges, hinge_spring = _hinges_between(table, np.concatenate([single[proper].T.ravel(), around.T.ravel()]))
    in_split = np.zeros(len(springs.vertices), bool)
    for side in (single[single >= 0], around, diagonal):
        in_split[side] = True
    return ElasticElements(
        springs=springs.vertices,
        edge_spring=np.flatnonzero(in_split),
        sides=springs.sides,
        membrane=membrane,
        share=share,
        face=face,
        hinges=np.concatenate([hinges, twist.astype(np.int32)]),
        hinge_spring=np.concatenate([hinge_spring, diagonal]),
        twists=np.repeat([False, True], [len(hinges), len(twist)]),
    )


def _convex_quads(mesh: PolygonMesh, split: TriangleSplit, rest: np.ndarray) -> np.ndarray:
    """Numbers of the quads with two consistently facing triangles in both splits."""
    count = np.bincount(split.face, minlength=mesh.face_count)
    faces = np.flatnonzero((count == 2) & (mesh.counts == 4))
    corners = at_corners(rest, mesh.indices[mesh.starts[faces, None] + np.arange(4)])
    sides = np.roll(corners, -1, axis=0) - corners
    normals = [cross(side, after) for side, after in zip(sides, np.roll(sides, -1, axis=0), strict=True)]
    return faces[np.all([dot(a, b) > 0 for n, a in enumerate(normals) for b in normals[n:]], axis=0)]


def hinges_of(triangles: np.ndarray, quads: np.ndarray | None = None) -> np.ndarray:
    """Find the pairs of faces sharing a manifold edge.

    The sign of the angle does not depend on the winding when the normals are taken as ``n1 = (xj - xi) x (xk - xi)``
    and ``n2 = (xl - xi) x (xj - xi)``: flat is zero even if windings disagree.

    Args:
        triangles: Vertices, shape (T, 3). Triangles with a repeated vertex are skipped.
        quads: Vertices, shape (Q, 4), without repeated vertices; None for no quads.

    Returns:
        Hinges (i, j, k, k', l, l'), shape (H, 6), int32, in lexicographic order of the shared edge: the edge i-j in the
        direction of the first face, the first face's corners k and k' opposite to the edge, and l and l' of the second
        face; a triangle's corner is repeated. Pairs of a face and its own reverse are left out.
    """
    triangles = np.asarray(triangles, np.int64).reshape(-1, 3)
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    table = _faces_at_sides(triangles, np.empty((0, 4), np.int64) if quads is None else quads)
    return _hinges_between(table, paired(table[:, 0], table[:, 1], int(table.max(initial=-1)) + 1)[1])[0]


def _faces_at_sides(triangles: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Ends of each side of faces, by side, and the corners opposite, shape (N, 4); a triangle's corner is repeated."""
    return np.concatenate(
        [
            np.roll(corners, -side, axis=1)[:, [0, 1, 2, -1]]
            for corners in (triangles, quads)
            for side in range(corners.shape[1])
        ]
    )


def _hinges_between(table: np.ndarray, edge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The hinges as in `hinges_of`, and the edge of each, given `_faces_at_sides` and the edge along each side."""
    if not len(table):
        return np.empty((0, 6), np.int32), np.empty(0, np.int32)
    count = np.bincount(edge)
    order, double = sorted_rows(edge, count=len(count)), count == 2
    first = (np.cumsum(count) - count)[double]
    first_face, second_face = table[order[first]], table[order[first + 1]]
    hinges = np.concatenate([first_face, second_face[:, 2:]], axis=1).astype(np.int32)
    k, other_k, ell, other_l = hinges[:, 2:].T
    apart = ((k != ell) | (other_k != other_l)) & ((k != other_l) | (other_k != ell))
    return hinges[apart], np.flatnonzero(double)[apart]


def hinge_geometry(x: np.ndarray, hinges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Signed angle [rad], both triangle areas [m^2] and edge length [m] of each hinge."""
    i, j, k, other_k, ell, other_l = at_corners(x, hinges)
    axis = j - i
    n1, n2 = cross(axis, 0.5 * (k + other_k) - i), cross(0.5 * (ell + other_l) - i, axis)
    length = norm(axis)
    sine = dot(cross(n1, n2), axis) / np.maximum(length, np.finfo(float).tiny)
    return np.arctan2(sine, dot(n1, n2)), 0.5 * norm(n1), 0.5 * norm(n2), length


def flat_rows(x: np.ndarray, hinges: np.ndarray) -> np.ndarray:
    """dtheta/dz of each hinge, unfolded flat [1/m], shape (6, H) as its corners; zero at triangles without area."""
    i, j, k, other_k, ell, other_l = at_corners(x, hinges)
    axis, sides = j - i, (0.5 * (k + other_k) - i, 0.5 * (ell + other_l) - i)
    square, size = dot(axis, axis), sum(dot(vector, vector) for vector in (axis, *sides))
    square = np.maximum(square, 1e-12 * size + 1e-300)
    double = np.stack([norm(cross(axis, side)) for side in sides])
    has_area = (double > 1e-12 * size).all(axis=0)
    at_k, at_l = np.where(has_area, np.sqrt(square) / np.where(has_area, double, 1.0), 0.0)
    foot_k, foot_l = (dot(side, axis) / square for side in sides)
    at_i, at_j = -(at_k * (1.0 - foot_k) + at_l * (1.0 - foot_l)), -(at_k * foot_k + at_l * foot_l)
    return np.stack([at_i, at_j, 0.5 * at_k, 0.5 * at_k, 0.5 * at_l, 0.5 * at_l])
