"""Interface of a posed surface."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .pose import Pose


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
        sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        return Solid(points, np.unique(sides, axis=0), faces)


@dataclass(frozen=True, eq=False)
class Nearest:
    """The closest points of a surface.

    Attributes:
        distance: Unsigned distances [m], infinite if nothing was in reach, shape (N,).
        point: Closest points [m], shape (N, 3).
        normal: Normals of the surface at the closest points, outward on closed surfaces, shape (N, 3).
        side: 1 on the normals' side, -1 behind, shape (N,). Where parts of a closed mesh overlap, only `Surface.inside`
            tells what is inside.
        rim: True if the closest point is on the rim of an open surface, shape (N,).
        face: Triangle of the closest point, -1 on primitives, shape (N,), int32.
    """

    distance: Float[Tensor, " points"]
    point: Float[Tensor, "points 3"]
    normal: Float[Tensor, "points 3"]
    side: Float[Tensor, " points"]
    rim: Bool[Tensor, " points"]
    face: Int[Tensor, " points"]

    def some(self, which: Int[Tensor, " some"]) -> Nearest:
        """The selected points."""
        return Nearest(**{each.name: getattr(self, each.name)[which] for each in fields(self)})

    def is_behind(self, side: Float[Tensor, " points"] | float) -> Bool[Tensor, " points"]:
        """Mask of the points behind an open surface: on the disallowed side, and not past the rim.

        Args:
            side: Allowed side: 1 along the normals, -1 against, 0 undecided.
        """
        return (self.side * side < 0) & ~self.rim

    def with_those(self, which: Int[Tensor, " some"], others: Nearest) -> Nearest:
        """A copy with some points replaced."""
        names = [each.name for each in fields(self)]
        return Nearest(**{name: getattr(self, name).index_put((which,), getattr(others, name)) for name in names})


@runtime_checkable
class Surface(Protocol):
    """A posed surface.

    Attributes:
        closed: True if the surface has an inside.
        fixed_side: Allowed side of an open surface, 1 along the normals or -1; None if the start decides.
        origin: World position of the origin of the surface's coordinates [m], shape (3,), float64.
        solid: The surface's triangles, in any pose; primitives are divided into triangles.
        world: World positions of the triangles' corners [m], shape (B, 3), float64.
    """

    @property
    def closed(self) -> bool: ...  # noqa: D102

    @property
    def fixed_side(self) -> float | None: ...  # noqa: D102

    @property
    def origin(self) -> np.ndarray: ...  # noqa: D102

    @property
    def solid(self) -> Solid: ...  # noqa: D102

    @property
    def world(self) -> np.ndarray: ...  # noqa: D102

    def placed(self, pose: Pose) -> np.ndarray | None:
        """World positions of the corners in another pose [m]; None if the pose is of another shape."""
        ...

    def closest(self, x: Float[Tensor, "points 3"], reach: Float[Tensor, " points"]) -> Nearest:
        """The closest points within reach [m]."""
        ...

    def inside(self, x: Float[Tensor, "points 3"], *, parts: int = 1) -> Bool[Tensor, " points"]:
        """Mask of the points inside; all False for open surfaces.

        Args:
            parts: Least number of overlapping parts of the surface that contain a point.
        """
        ...

    def exit(self, x: Float[Tensor, "points 3"], found: Nearest) -> Nearest:
        """The closest points through which inside points can leave, without faces buried in the surface.

        Args:
            x: Points inside.
            found: Result of `closest` for the points.
        """
        ...
