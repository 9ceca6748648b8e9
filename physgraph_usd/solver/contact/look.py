"""Crossings of cloth with cloth and with bodies at given positions, and cloth inside bodies."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from ..collide.crossings import Crossings, Pierced
from .cloth_mesh import RINGS, ClothMesh
from .tangles import Tangles


@dataclass(frozen=True, eq=False)
class Look:
    """Crossings at positions, with the tensor's version counter when they were found.

    Attributes:
        x: The positions [m].
        version: The counter.
        crossings: Crossings of cloth with cloth, without given-up cloth.
        tangles: These with the cloth around them; None without crossings and given-up cloth.
        pierced: Crossings of cloth and bodies; None without bodies.
        inside: The vertices inside each body, shape (B, V); None if none is.
    """

    x: Tensor
    version: int
    crossings: Crossings
    tangles: Tangles | None
    pierced: Pierced | None = None
    inside: Tensor | None = None

    @staticmethod
    def clean(x: Tensor) -> Look:
        """Positions at which nothing crosses."""
        return Look(x, x._version, Crossings.none(x.device), None)

    @property
    def in_bodies(self) -> tuple[int, int]:
        """Number of vertices inside bodies, and of crossings with bodies."""
        inside = 0 if self.inside is None else int(self.inside.sum())
        return inside, 0 if self.pierced is None else self.pierced.count

    def exempt(self, mesh: ClothMesh) -> Bool[Tensor, " vertices"] | None:
        """Mask of the cloth inside or through a body; None if none is."""
        if self.pierced is None or not any(self.in_bodies):
            return None
        some = mesh.grown(mesh.crossed(self.pierced.crossings), RINGS)
        return some if self.inside is None else some | self.inside.any(dim=0)
