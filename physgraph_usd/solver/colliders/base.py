"""Triangles of a body, and closest points on its surface."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mesh.topology import paired


@dataclass(frozen=True, eq=False)
class Solid:
    """The triangles of a body.

    Attributes:
        points: Positions in any pose [m], shape (B, 3), float64; every point is a corner.
        edges: Sides of the triangles, each once, shape (E, 2), int64.
        faces: Corners of the triangles, shape (T, 3), int64.
    """

    points: np.ndarray
    edges: np.ndarray
    faces: np.ndarray

    @staticmethod
    def of(points: np.ndarray, faces: np.ndarray) -> Solid:
        """Triangles with their sides."""
        faces = faces.astype(np.int64)
        edges = paired(faces.ravel(), faces[:, [1, 2, 0]].ravel(), len(points))[0]
        return Solid(points, edges.astype(np.int64), faces)


@dataclass(frozen=True, eq=False)
class Nearest:
    """The closest points of a surface.

    Attributes:
        distance: Unsigned distances [m], infinite if nothing was in reach, shape (N,).
        point: Closest points [m], shape (N, 3).
        normal: Normals of the surface at the closest points, outward on closed surfaces, shape (N, 3).
        side: 1 on the normals' side, -1 behind, shape (N,). Where parts of a closed mesh overlap, only
            `MeshSurface.inside` tells what is inside.
        rim: True if the closest point is on the rim of an open surface, shape (N,).
        face: Triangle of the closest point, shape (N,), int32.
    """

    distance: Float[Tensor, " points"]
    point: Float[Tensor, "points 3"]
    normal: Float[Tensor, "points 3"]
    side: Float[Tensor, " points"]
    rim: Bool[Tensor, " points"]
    face: Int[Tensor, " points"]

    def selected(self, indices: Int[Tensor, " some"]) -> Nearest:
        """The selected points."""
        return Nearest(*(getattr(self, field.name)[indices] for field in fields(self)))

    def is_behind(self, side: Float[Tensor, " points"] | float) -> Bool[Tensor, " points"]:
        """Mask of the points behind an open surface: on the disallowed side, and not past the rim.

        Args:
            side: Allowed side: 1 along the normals, -1 against, 0 undecided.
        """
        return (self.side * side < 0) & ~self.rim

    def with_points(self, indices: Int[Tensor, " some"], points: Nearest) -> Nearest:
        """A copy with some points replaced."""
        columns = ((getattr(self, field.name), getattr(points, field.name)) for field in fields(self))
        return Nearest(*(values.index_put((indices,), new) for values, new in columns))
