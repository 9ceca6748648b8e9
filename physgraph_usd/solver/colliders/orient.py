"""Closed and open pieces of a mesh, with consistent orientation independent of the file.

Vertices at equal positions are merged (exporters split vertices at seams), the winding is made consistent from face to
face, and each closed piece is oriented to a positive volume. The allowed side of an open mesh is chosen by its winding
number at the coarse cloth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..mesh.topology import joined_by, paired

WELD = 1e-6
"""Distance below which vertices are merged, relative to the mesh's size."""
HOLES = 0.03
"""Largest fraction of openings in the area of a piece that counts as closed; the winding number closes the openings."""
OPENINGS = 0.5
"""As `HOLES`, for a piece with an inside by its winding number alone. The limit is half a sphere, with winding number
1/2 in the middle of the opening. A plane has an opening as large as itself, and no inside."""


FIXED = {"front": 1.0, "back": -1.0}
"""Allowed side of an open piece along its normals, by name."""
WINDING_SAMPLES = 64
"""Number of cage vertices, spread over the cage, whose winding numbers stand for all: enough to tell a half from a
quarter."""
INSIDE = 0.5
"""Winding number from which a point is inside."""
CLEAR = 0.75
"""Least fraction of a cage on one side of a floor or wall; cloth hanging over a wall has half on each side."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """The valid faces of a mesh.

    Attributes:
        closed: Triangles of closed pieces, wound outward, shape (T, 3), int32.
        open: Triangles of open pieces, wound consistently if orientable, shape (U, 3), int32.
        rim: True if the edge opposite each corner of an open triangle is on the rim, shape (U, 3).
        rim_vertex: True if a corner of an open triangle is on the rim, shape (U, 3).
    """

    closed: np.ndarray
    open: np.ndarray
    rim: np.ndarray
    rim_vertex: np.ndarray


def pieces_of(points: np.ndarray, triangles: np.ndarray, *, side: str = "auto") -> Pieces:
    """Sort a mesh's triangles into closed and open pieces and orient the pieces.

    Args:
        points: Positions [m], shape (V, 3); faces with non-finite positions are dropped.
        triangles: Corners, shape (T, 3).
        side: One of `schema.SIDES`: "winding" counts pieces with openings up to `OPENINGS` as closed, "start" none;
            "front" and "back" keep the winding of open pieces.

    Returns:
        The pieces. Corners are welded to the first vertex at each position.
    """
    first = _welded(points)
    faces = first[np.asarray(triangles, np.int64).reshape(-1, 3)]
    distinct = np.asarray((faces != np.roll(faces, 1, axis=1)).all(axis=1))
    faces = faces[distinct & np.asarray(np.isfinite(points[faces]).all(axis=(1, 2)))]
    if not len(faces):
        empty = np.zeros((0, 3), np.int32)
        return Pieces(empty, empty, empty.astype(bool), empty.astype(bool))
    edge, forward, count = _edges(faces, len(points))
    piece, turned, sound = _orientation(edge, forward, count, faces=len(faces))
    faces[turned] = faces[turned][:, ::-1]
    edge = np.where(turned[:, None], edge[:, [1, 0, 2]], edge)  # reversed corners: sides 2-1, 1-0, 0-2
    most = {"winding": OPENINGS, "start": -1.0}.get(side, HOLES)
    closed = sound & (_openings(points, faces, edge, count=count, piece=piece) <= most)
    volume = np.bincount(piece, _volumes(points, faces, piece), piece.max() + 1)
    inward = closed[piece] & (volume[piece] < 0)
    outer = ~closed[piece]
    inward |= outer & turned & (side in FIXED)  # turned back
    faces[inward] = faces[inward][:, ::-1]
    edge = np.where(inward[:, None], edge[:, [1, 0, 2]], edge)
    on_rim = count[edge[outer]] == 1  # of the sides 0-1, 1-2, 2-0
    rim_vertices = np.zeros(len(points), bool)
    sides = np.stack([faces[outer], np.roll(faces[outer], -1, axis=1)], axis=2)
    rim_vertices[sides[on_rim].ravel()] = True
    return Pieces(
        closed=np.ascontiguousarray(faces[~outer], np.int32),
        open=np.ascontiguousarray(faces[outer], np.int32),
        rim=np.ascontiguousarray(np.roll(on_rim, -1, axis=1)),  # opposite corner 0 is the side 1-2
        rim_vertex=rim_vertices[faces[outer]],
    )


def _welded(points: np.ndarray) -> np.ndarray:
    """First vertex at each vertex's position, shape (V,)."""
    finite = np.asarray(np.isfinite(points).all(axis=1))
    if not finite.any():
        return np.arange(len(points))
    low = points[finite].min(axis=0)
    size = max(float(np.ptp(points[finite], axis=0).max()), 1e-12)
    cell = np.where(finite[:, None], np.round((np.where(finite[:, None], points, low) - low) / (WELD * size)), -1.0)
    _, first, cell_of = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    return np.where(finite, first[cell_of.reshape(-1)], np.arange(len(points)))


def _edges(faces: np.ndarray, vertex_count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edge of each side (0-1, 1-2, 2-0) of each face, whether the side runs upwards, and the faces at each edge."""
    ends = np.roll(faces, -1, axis=1)
    edge = paired(faces.ravel(), ends.ravel(), vertex_count)[1]
    return edge.reshape(-1, 3), faces < ends, np.bincount(edge)


def _orientation(
    edge: np.ndarray, forward: np.ndarray, count: np.ndarray, *, faces: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Piece of each face, whether to flip the face, and per piece whether the piece is orientable.

    Each face is two graph nodes, as wound and flipped. Neighbours with consistent winding link like to like,
    inconsistent neighbours crosswise.
    """
    order = np.argsort(edge.ravel(), kind="stable")
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])[count == 2]
    first, second = order[starts], order[starts + 1]
    agree = forward.ravel()[first] != forward.ravel()[second]
    a, b = first // 3, second // 3
    rows = np.concatenate([a, a + faces])
    columns = np.concatenate([np.where(agree, b, b + faces), np.where(agree, b + faces, b)])
    label = joined_by(np.stack([rows, columns], axis=1), 2 * faces)
    as_is, reverse = label[:faces], label[faces:]
    _, piece = np.unique(np.minimum(as_is, reverse), return_inverse=True)
    one_sided = np.bincount(piece.reshape(-1), as_is == reverse) > 0
    return piece.reshape(-1), as_is > reverse, ~one_sided


def _openings(
    points: np.ndarray, faces: np.ndarray, edge: np.ndarray, *, count: np.ndarray, piece: np.ndarray
) -> np.ndarray:
    """Upper bound of the area of each piece's openings, as a fraction of the piece's area.

    No flat opening has more area than the circle with the rim's length.
    """
    corners = points[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total = np.bincount(piece, area, piece.max() + 1)
    face, side = np.nonzero(count[edge] != 2)
    start, end = faces[face, side], faces[face, (side + 1) % 3]
    # Rims of two pieces that meet in a vertex are two.
    vertices, ends = np.unique(np.stack([start, end]) + piece[face] * len(points), return_inverse=True)
    ends = ends.reshape(2, -1)
    rim = joined_by(ends.T, len(vertices))
    length = np.bincount(rim[ends[0]], np.linalg.norm(points[end] - points[start], axis=1))
    owner = np.zeros(len(length), np.int64)
    owner[rim] = vertices // len(points)
    return np.bincount(owner, length**2 / (4.0 * np.pi), len(total)) / np.maximum(total, np.finfo(float).tiny)


def _volumes(points: np.ndarray, faces: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """Signed volume under each face, about the middle of its piece."""
    middles = points[faces].mean(axis=1)
    sums = np.stack([np.bincount(piece, middles[:, axis]) for axis in range(3)], axis=1)
    corners = points[faces] - (sums / np.bincount(piece)[:, None])[piece][:, None]
    return np.einsum("fc,fc->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0


def choose_side(points: np.ndarray, triangles: np.ndarray, cages: Sequence[np.ndarray]) -> str:
    """The side, one of `schema.SIDES`, for a mesh without an authored side.

    "winding" for a mesh with pieces that have an inside, unless most of a cage lies inside: a coat round a shirt.
    "front" or "back" for floors and walls: planes larger than the cloth, with the cloth on one side. "auto" for all
    remaining meshes.

    Args:
        points: Positions [m], shape (V, 3).
        triangles: Corners, counterclockwise on the front, shape (T, 3).
        cages: Positions of each cage [m], shape (U, 3).
    """
    cages = [cage[:: max(1, len(cage) // WINDING_SAMPLES)] for cage in cages if len(cage)]
    usual = pieces_of(points, triangles)
    if not len(usual.open) or not cages:
        return "auto"
    hollow = pieces_of(points, triangles, side="winding")
    if len(hollow.closed) > len(usual.closed):
        inside = [float((winding_numbers(points, hollow.closed, cage) > INSIDE).mean()) for cage in cages]
        return "winding" if max(inside) <= 0.5 else "auto"
    plane = pieces_of(points, triangles, side="front").open
    small = _size(points[plane].reshape(-1, 3)) < max(map(_size, cages))
    if small or not np.array_equal(plane, usual.open):  # Its faces do not look one way.
        return "auto"
    behind = [float((winding_numbers(points, plane, cage) > 0.0).mean()) for cage in cages]
    return "front" if max(behind) <= 1.0 - CLEAR else "back" if min(behind) >= CLEAR else "auto"


def _size(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def winding_numbers(points: np.ndarray, triangles: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Generalised winding numbers of a mesh, positive behind its faces, shape (N,) (Jacobson et al. 2013).

    Each face adds its solid angle over 4 pi (Van Oosterom and Strackee 1983).

    Args:
        points: Positions [m], shape (V, 3).
        triangles: Corners, shape (T, 3).
        x: Query points [m], shape (N, 3).
    """
    numbers = np.empty(len(x))
    for index, point in enumerate(x):
        a, b, c = (points[triangles[:, corner]] - point for corner in range(3))
        la, lb, lc = (np.linalg.norm(vectors, axis=1) for vectors in (a, b, c))
        volume = np.einsum("td,td->t", a, np.cross(b, c))
        dots = (np.einsum("td,td->t", *pair) for pair in ((a, b), (b, c), (c, a)))
        below = la * lb * lc + sum(dot * length for dot, length in zip(dots, (lc, la, lb), strict=True))
        numbers[index] = np.arctan2(volume, below).sum() / (2.0 * np.pi)
    return numbers
