"""A closed shell of a sheet: an outer and an inner face at half a thickness, and rims along open borders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ...solver.mesh.topology import PolygonMesh


@dataclass(frozen=True, eq=False)
class Shell:
    """A shell with the sheet's element behind each of its own.

    Attributes:
        mesh: Faces of the shell: the sheet's, the sheet's turned over, one quad for each open edge. Its vertices are
            the sheet's twice, outer before inner.
        vertex: Vertex of the sheet behind each vertex, shape (2 V,).
        face: Face of the sheet, shape (2 F + rims,).
        corner: Corner of the sheet, shape (C,).
        rims: Edges of the rims along the outer and the inner face, shape (2 rims, 2).
    """

    mesh: PolygonMesh
    vertex: Int[np.ndarray, " vertices"]
    face: Int[np.ndarray, " faces"]
    corner: Int[np.ndarray, " corners"]
    rims: Int[np.ndarray, "edges 2"]

    @classmethod
    def of(cls, sheet: PolygonMesh, welded: Int[np.ndarray, " vertices"]) -> Shell:
        """Make the shell of a sheet; vertices with equal numbers in ``welded`` are joined, and have no rim between."""
        count, corners = sheet.vertex_count, np.arange(len(sheet.indices))
        start, end = sheet.indices, sheet.indices[sheet.next_corner]
        ends = np.sort(np.stack([welded[start], welded[end]], axis=1), axis=1)
        _, edge, times = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
        rim = np.flatnonzero((times[edge.reshape(-1)] == 1) & (ends[:, 0] != ends[:, 1]))
        after, turned = sheet.next_corner[rim], sheet.mirrored_corners
        sides = np.stack([end[rim], start[rim], start[rim] + count, end[rim] + count], axis=1)
        indices = np.concatenate([sheet.indices, sheet.indices[turned] + count, sides.ravel()])
        counts = np.concatenate([sheet.counts, sheet.counts, np.full(len(rim), 4)])
        faces = np.arange(sheet.face_count)
        return cls(
            PolygonMesh(counts, indices, 2 * count),
            np.tile(np.arange(count), 2),
            np.concatenate([faces, faces, sheet.corner_face[rim]]),
            np.concatenate([corners, turned, np.stack([after, rim, rim, after], axis=1).ravel()]),
            sides.reshape(-1, 2),
        )

    def thickened(
        self, points: Float[np.ndarray, "vertices 3"], normals: Float[np.ndarray, "vertices 3"], thickness: float
    ) -> Float[np.ndarray, "twice 3"]:
        """Positions of the shell's vertices, shape (2 V, 3), from the sheet's positions and unit normals."""
        step = 0.5 * thickness * normals
        return np.concatenate([points + step, points - step])
