"""What a collider is, how it is posed, and what can be asked of its surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

KINDS = ("mesh", "sphere", "capsule", "cylinder", "cube", "plane")


@dataclass(frozen=True)
class Collider:
    """What stays the same over the shot.

    Attributes:
        path: Prim path, its name in reports.
        kind: One of `KINDS`.
        offset: Distance kept from it [m], added to the garment's.
    """

    path: str
    kind: str
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class MeshPose:
    """A mesh at one time code.

    Attributes:
        points: Positions [m], world space, shape (V, 3), float64.
        triangles: Corners, as authored, shape (T, 3), int32; the same array while the topology stays the same.
    """

    points: np.ndarray
    triangles: np.ndarray

    def equals(self, other: Pose) -> bool:
        """Whether both are the same to the bit."""
        return (
            isinstance(other, MeshPose)
            and np.array_equal(self.triangles, other.triangles)
            and np.array_equal(self.points, other.points)
        )


@dataclass(frozen=True, eq=False)
class ShapePose:
    """A primitive at one time code.

    Attributes:
        kind: "sphere", "capsule", "cylinder", "cube" or "plane".
        turn: Rotation whose columns are the shape's axes in the world; the third is the axis of a capsule, a cylinder
            and a plane (its outer normal), shape (3, 3), float64.
        centre: [m], world space, shape (3,), float64.
        size: Half sizes along its axes [m]: (r, r, r) of a sphere, (r, r, half height without caps) of a capsule or a
            cylinder, zero for a plane, shape (3,), float64.
    """

    kind: str
    turn: np.ndarray
    centre: np.ndarray
    size: np.ndarray

    def equals(self, other: Pose) -> bool:
        """Whether both are the same to the bit."""
        return (
            isinstance(other, ShapePose)
            and self.kind == other.kind
            and all(np.array_equal(getattr(self, n), getattr(other, n)) for n in ("turn", "centre", "size"))
        )


Pose = MeshPose | ShapePose


@dataclass(frozen=True, eq=False)
class Nearest:
    """The closest points of a surface.

    Attributes:
        distance: Unsigned [m], infinite where nothing was in reach, shape (N,).
        point: [m], shape (N, 3).
        normal: Of the surface there, outward on closed surfaces, shape (N, 3).
        side: 1 on the normals' side, -1 behind, 0 where a closed mesh has to be asked by `Surface.inside`, shape (N,).
        rim: Whether it lies on the rim of an open surface, shape (N,).
    """

    distance: Float[Tensor, " points"]
    point: Float[Tensor, "points 3"]
    normal: Float[Tensor, "points 3"]
    side: Float[Tensor, " points"]
    rim: Bool[Tensor, " points"]


@runtime_checkable
class Surface(Protocol):
    """A posed surface.

    Attributes:
        closed: Whether it has an inside.
        origin: World position of the origin of the coordinates that it is asked in [m], shape (3,), float64.
        bounds: Least and greatest corner [m], in its own coordinates, shape (2, 3), float64.
    """

    @property
    def closed(self) -> bool: ...  # noqa: D102

    @property
    def origin(self) -> np.ndarray: ...  # noqa: D102

    @property
    def bounds(self) -> np.ndarray: ...  # noqa: D102

    def closest(self, x: Float[Tensor, "points 3"], reach: Float[Tensor, " points"]) -> Nearest:
        """The closest points within reach [m]."""
        ...

    def inside(self, x: Float[Tensor, "points 3"]) -> Bool[Tensor, " points"]:
        """Whether points are inside; nowhere for open surfaces."""
        ...
