"""Finds non-sheet pieces of a garment's mesh: closed shells, and small rigid parts such as buttons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ...solver.mesh.topology import PolygonMesh, area_vectors, joined_by

SMALL = 0.25
"""Size, relative to the largest piece, below which a closed piece may be a rigid part."""
LIGHT = 0.01
"""Area, relative to the largest piece, below which a piece may be rigid: either bound alone would include pockets."""


@dataclass(frozen=True, eq=False)
class PieceKinds:
    """Vertices of the non-sheet pieces.

    Attributes:
        closed: Whether each vertex belongs to a closed, non-rigid piece, shape (V,).
        rigid: Number of the rigid part of each vertex, -1 for cloth, shape (V,).
        joined: Whether faces marked as rigid share vertices with cloth; such faces stay cloth.
    """

    closed: Bool[np.ndarray, " vertices"]
    rigid: Int[np.ndarray, " vertices"]
    joined: bool


def sort_pieces(
    mesh: PolygonMesh, rest: Float[np.ndarray, "vertices 3"], marked: Bool[np.ndarray, " faces"]
) -> PieceKinds:
    """Find the pieces.

    A piece is rigid if closed and small compared with the largest piece, if smaller than an edge of the largest piece,
    or if all its faces are marked.

    Args:
        mesh: The mesh, welded.
        rest: Rest positions [m].
        marked: Faces marked as rigid.
    """
    ends = mesh.half_edges.edges
    piece = joined_by(ends, mesh.vertex_count)
    of_face = piece[mesh.indices[mesh.starts[:-1]]]
    count = int(piece.max(initial=-1)) + 1
    area = np.bincount(of_face, 0.5 * np.linalg.norm(area_vectors(mesh, rest), axis=1), count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, piece, rest)
    np.maximum.at(high, piece, rest)
    size = np.linalg.norm(high - low, axis=1)
    open_side = np.bincount(piece[ends[mesh.half_edges.count == 1, 0]], minlength=count) > 0
    faces = np.bincount(of_face, minlength=count)
    closed = ~open_side & (faces > 1)
    largest = int(np.where(faces > 0, area, -1.0).argmax())
    length = np.linalg.norm(rest[ends[:, 0]] - rest[ends[:, 1]], axis=1)
    edge = float(length[piece[ends[:, 0]] == largest].mean())
    light = (area < LIGHT * area[largest]) & (faces > 0)
    rigid = light & ((closed & (size < SMALL * size[largest])) | (size < edge))
    wanted = np.bincount(of_face, marked, count)
    rigid |= (wanted == faces) & (faces > 0)
    number = np.where(rigid, np.cumsum(rigid) - 1, -1)
    return PieceKinds((closed & ~rigid)[piece], number[piece], bool(((wanted > 0) & (wanted < faces)).any()))
