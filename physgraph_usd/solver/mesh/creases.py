"""Sharp edges of closed pieces, such as the rim of a thick garment, kept by smooth subdivision and rest angles."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from .topology import PolygonMesh, face_normals, find_edges

SHARP = 45.0
"""Least angle between the rest normals of two faces for a sharp edge [degrees]."""


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
    one, two = mesh.twin_corners[closed[mesh.indices[mesh.twin_corners[:, 0]]]].T
    same = np.where(half.forward[one] != half.forward[two], 1.0, -1.0)  # Neighbours may have opposite winding.
    cosine = same * (normal[mesh.corner_face[one]] * normal[mesh.corner_face[two]]).sum(axis=1)
    return half.edges[half.edge[one[cosine < np.cos(np.radians(SHARP))]]]


def halves_of(edges: Int[np.ndarray, "edges 2"], middle: Int[np.ndarray, " edges"]) -> Int[np.ndarray, "halves 2"]:
    """Edges of the next subdivision along edges with given midpoints, lower vertex first, in order."""
    halves = np.concatenate([np.stack([edges[:, side], middle], axis=1) for side in (0, 1)])
    return halves[np.lexsort((halves[:, 1], halves[:, 0]))].astype(np.int32)


def crease_mask(mesh: PolygonMesh, creases: Int[np.ndarray, "creases 2"]) -> Bool[np.ndarray, " edges"] | None:
    """Whether each edge of a mesh is a crease; None without creases."""
    return find_edges(creases, mesh.half_edges.edges) >= 0 if len(creases) else None
