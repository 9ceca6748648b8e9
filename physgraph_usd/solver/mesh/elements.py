"""Elastic elements of cloth: springs, membrane triangles and hinges of meshes of triangles and quads.

A quad split along one diagonal is stiffer at the ends of that diagonal, and vertices there stand up on folds. So no
element prefers a diagonal. Springs and the membrane of a quad are the mean over both splits. A hinge between two
faces bends round their common edge, and a quad's normal there is that of the triangle from the edge to the middle of
the opposite side. The twist of a quad is measured round the diagonal that splits it: small twists are the same
round either.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .topology import PolygonMesh, TriangleSplit, edges_of

QUAD_SPRING = (0.75, 1.5)
"""Factors of the springs along a quad's sides and diagonals. A grid of squares of Young's modulus Y then has
C11 = 9/8 Y, C12 = C66 = 3/8 Y: isotropic, for C11 - C12 = 2 C66, with nu = 1/3, as a lattice of triangles has."""


@dataclass(frozen=True, eq=False)
class ElasticElements:
    """Elastic elements of one garment at one level.

    Attributes:
        springs: End vertices, lexicographic, shape (S, 2).
        membrane: Corner vertices of triangles; the third side of a quad's is its diagonal, shape (M, 3).
        share: Fraction of the area that a triangle stands for: a half where it is of a quad, shape (M,).
        face: The face that a triangle is part of, shape (M,).
        hinges: Edge i-j, the corners k, k' of the first face opposite to it, and l, l' of the second; k = k' at a
            triangle, shape (H, 6).
        twists: Whether a hinge is a quad's own, round the diagonal i-j that splits it, shape (H,).
    """

    springs: np.ndarray
    membrane: np.ndarray
    share: np.ndarray
    face: np.ndarray
    hinges: np.ndarray
    twists: np.ndarray


def elastic_elements(mesh: PolygonMesh, split: TriangleSplit, rest: np.ndarray) -> ElasticElements:
    """The elements of a mesh.

    A quad that is not convex at rest, or has an edge or a corner without extent, and a larger polygon count as the
    triangles that they are split into.

    Args:
        mesh: The mesh.
        split: Its sound triangles.
        rest: Rest positions [m], shape (V, 3), float64.
    """
    quads = _convex_quads(mesh, split, rest)
    a, b, c, d = mesh.indices[mesh.starts[quads, None] + np.arange(4)].T
    alone = ~np.isin(split.face, quads)
    halves = np.stack([a, b, c, c, d, a, b, c, d, d, a, b], axis=1).reshape(-1, 3)
    membrane = np.concatenate([split.triangles[alone], halves]).astype(np.int32)
    face = np.concatenate([split.face[alone], np.repeat(quads, 4)])
    share = np.where(np.arange(len(membrane)) < alone.sum(), 1.0, 0.5)
    first = np.searchsorted(split.face, quads)
    (i, other, j), k = split.triangles[first].T, split.triangles[first + 1, 2]
    twist = np.stack([i, j, k, k, other, other], axis=1)
    sides = hinges_of(split.triangles[alone], np.stack([a, b, c, d], axis=1))
    return ElasticElements(
        springs=edges_of(membrane, mesh.vertex_count).vertices,
        membrane=membrane,
        share=share,
        face=face,
        hinges=np.concatenate([sides, twist.astype(np.int32)]),
        twists=np.repeat([False, True], [len(sides), len(twist)]),
    )


def _convex_quads(mesh: PolygonMesh, split: TriangleSplit, rest: np.ndarray) -> np.ndarray:
    """Numbers of the quads of which both splits are two triangles that face the same way."""
    faces, count = np.unique(split.face, return_counts=True)
    faces = faces[(count == 2) & (mesh.counts[faces] == 4)]
    corners = rest[mesh.indices[mesh.starts[faces, None] + np.arange(4)]]
    sides = np.roll(corners, -1, axis=1) - corners
    normals = np.cross(sides, np.roll(sides, -1, axis=1))
    return faces[(np.einsum("fic,fjc->fij", normals, normals) > 0).all(axis=(1, 2))]


def hinges_of(triangles: np.ndarray, quads: np.ndarray | None = None) -> np.ndarray:
    """Find the pairs of faces that share an edge with no third one.

    The sign of the angle does not depend on the winding when the normals are taken as
    ``n1 = (xj - xi) x (xk - xi)`` and ``n2 = (xl - xi) x (xj - xi)``: flat is zero even where windings disagree.

    Args:
        triangles: Vertices, shape (T, 3). Triangles that repeat a vertex are passed over.
        quads: Vertices, shape (Q, 4), without repeated ones; none when None.

    Returns:
        Hinges (i, j, k, k', l, l'), shape (H, 6), int32, in lexicographic order of the shared edge: the edge i-j as the
        first face runs through it, its corners k and k' opposite to the edge, and l and l' of the second face; a
        triangle's corner stands twice. Pairs of which one is the other turned over are left out.
    """
    triangles = np.asarray(triangles, np.int64).reshape(-1, 3)
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    faces = [triangles, np.empty((0, 4), np.int64) if quads is None else np.asarray(quads, np.int64)]
    table = np.concatenate(
        [np.roll(each, -side, axis=1)[:, [0, 1, 2, -1]] for each in faces for side in range(each.shape[1])]
    )
    if not len(table):
        return np.empty((0, 6), np.int32)
    low, high = table[:, :2].min(axis=1), table[:, :2].max(axis=1)
    keys = low * (int(high.max()) + 1) + high
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    first = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    first = first[np.diff(np.append(first, len(ordered))) == 2]
    one, two = table[order[first]], table[order[first + 1]]
    hinges = np.concatenate([one, two[:, 2:]], axis=1).astype(np.int32)
    return hinges[(np.sort(hinges[:, 2:4], axis=1) != np.sort(hinges[:, 4:], axis=1)).any(axis=1)]
