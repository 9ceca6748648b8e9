"""What can be asked of a posed surface."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Nearest:
    """The closest points of a surface.

    Attributes:
        distance: Unsigned [m], infinite where nothing was in reach, shape (N,).
        point: [m], shape (N, 3).
        normal: Of the surface there, outward on closed surfaces, shape (N, 3).
        side: 1 on the normals' side, -1 behind, 0 where a closed mesh has to be asked by `Surface.inside`, shape (N,).
        rim: Whether it lies on the rim of an open surface, shape (N,).
        face: Triangle that it lies on, -1 on primitives, shape (N,), int32.
    """

    distance: Float[Tensor, " points"]
    point: Float[Tensor, "points 3"]
    normal: Float[Tensor, "points 3"]
    side: Float[Tensor, " points"]
    rim: Bool[Tensor, " points"]
    face: Int[Tensor, " points"]

    def some(self, which: Int[Tensor, " some"]) -> Nearest:
        """Those of some points."""
        return Nearest(**{each.name: getattr(self, each.name)[which] for each in fields(self)})

    def with_those(self, which: Int[Tensor, " some"], others: Nearest) -> Nearest:
        """The same with others for some points."""
        names = [each.name for each in fields(self)]
        return Nearest(**{name: getattr(self, name).index_put((which,), getattr(others, name)) for name in names})


@runtime_checkable
class Surface(Protocol):
    """A posed surface.

    Attributes:
        closed: Whether it has an inside.
        fixed_side: Side of an open surface on which cloth belongs, 1 its normals' or -1; None where the start decides.
        certain: Whether the side that `closest` gives is final, so that `inside` need not be asked.
        origin: World position of the origin of the coordinates that it is asked in [m], shape (3,), float64.
        bounds: Least and greatest corner [m], in its own coordinates, shape (2, 3), float64.
    """

    @property
    def closed(self) -> bool: ...  # noqa: D102

    @property
    def fixed_side(self) -> float | None: ...  # noqa: D102

    @property
    def certain(self) -> bool: ...  # noqa: D102

    @property
    def origin(self) -> np.ndarray: ...  # noqa: D102

    @property
    def bounds(self) -> np.ndarray: ...  # noqa: D102

    def closest(self, x: Float[Tensor, "points 3"], reach: Float[Tensor, " points"]) -> Nearest:
        """The closest points within reach [m]."""
        ...

    def inside(self, x: Float[Tensor, "points 3"], *, parts: int = 1) -> Bool[Tensor, " points"]:
        """Whether points are inside; nowhere for open surfaces.

        Args:
            x: Points.
            parts: Of how many overlapping parts of the surface at once, at least.
        """
        ...

    def exit(self, x: Float[Tensor, "points 3"], found: Nearest) -> Nearest:
        """The closest points through which points inside can leave: not those on faces buried in the same surface.

        Args:
            x: Points inside.
            found: What `closest` gave for them.
        """
        ...
