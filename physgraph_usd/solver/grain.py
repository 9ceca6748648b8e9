"""The grain of a level's elements: which way warp and weft lie there, and where cloth is longer than its rest shape.

Cloth has two directions of its own: the warp, along which a weaver's threads are tight, and the weft, a quarter turn
from it in the surface. Stiffnesses and lengths may differ between them. Ease is length that the cloth has and the
rest shape does not show, as cutters give it to a garment; gathers are ease along a seam. Folds come from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from .mesh.vectors import at_corners, cross, dot, norm

SHORTEST = 0.25
"""Least length of cloth over its rest shape's: ease, its painted multiplier and gathers may be negative together."""
MOST_RATIO = 4.0
"""Most that one bending stiffness counts as of the other: at five times, hinges of one direction had no weight."""


@dataclass(frozen=True, eq=False)
class LevelGrain:
    """The grain of one level's elements; tensors on its device.

    Attributes:
        spring: Squared cosines of each spring with warp and weft, mean over its triangles, shape (S, 2).
        hinge: cos 2a of each hinge, a from the warp to the direction in which it bends, shape (H,).
        spring_scale, membrane_scale: Painted multiplier of the ease, shapes (S,) and (M,).
        spring_gather, membrane_gather: Painted length more along the weft, as a fraction, shapes (S,) and (M,).
    """

    spring: Float[Tensor, "springs 2"]
    hinge: Float[Tensor, " hinges"]
    spring_scale: Float[Tensor, " springs"]
    membrane_scale: Float[Tensor, " membrane"]
    spring_gather: Float[Tensor, " springs"]
    membrane_gather: Float[Tensor, " membrane"]

    @property
    def gathers(self) -> bool:
        """Whether anything is gathered."""
        return bool((self.membrane_gather != 0).any())


def axes(sides: np.ndarray, warp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit warp and weft of each triangle in its plane, shapes (3, T).

    Where no warp is known, or it stands across the triangle, the rest frame's axis that lies most nearly in the plane
    stands for it: a membrane of equal stiffness both ways is the same after a quarter turn, so wherever the cloth is
    tangent to an axis, neighbours agree whichever they take.

    Args:
        sides: Two sides from the first corner of each triangle [m], shape (2, 3, T), float64.
        warp: Direction on each triangle, shape (3, T); 0 where none is known.
    """
    normal = cross(*sides)
    normal /= np.maximum(norm(normal), np.finfo(float).tiny)
    nearest = np.eye(3).take(np.abs(normal).argmin(axis=0), axis=1)
    inside = [direction - normal * dot(direction, normal) for direction in (warp, nearest)]
    lengths = [norm(vector) for vector in inside]
    along = np.where(lengths[0] > 1e-3, *inside) / np.where(lengths[0] > 1e-3, *lengths)
    return along, cross(normal, along)


def edge_cosines(
    rest: np.ndarray, triangles: np.ndarray, sides: np.ndarray, *, count: int, warp: np.ndarray
) -> np.ndarray:
    """Squared cosines of each edge with warp and weft, mean over the edge's triangles, shape (E, 2); see `axes`.

    Args:
        rest: Rest positions [m], shape (V, 3).
        triangles: Corner vertices, shape (T, 3).
        sides: Edge along each side of the triangles, shape (T, 3).
        count: Number of edges E.
        warp: As for `axes`.
    """
    corners, edges = at_corners(rest, triangles), sides.T.ravel()
    spans = np.roll(corners, -1, axis=0) - corners
    square = np.maximum((spans**2).sum(axis=1), np.finfo(float).tiny)
    directions = axes(corners[1:] - corners[0], warp)
    total = [np.bincount(edges, (dot(spans, axis) ** 2 / square).ravel(), count) for axis in directions]
    number = np.bincount(edges, minlength=count)
    return np.where(number > 0, total / np.maximum(number, 1.0), 0.5).T


def bending_factor(hinge: Tensor, warp: Sequence[float], weft: Sequence[float], owner: Tensor) -> Tensor:
    """Weight of each hinge over its garment's warp stiffness D1, so that a sheet bends with D1 and D2.

    Hinges in all directions a, weighted w(a), give a sheet bent along the warp 3 mean(w (cos^2 a - sin^2 a / 3)^2).
    With w = (D1 + D2) / 2 + 3/4 (D1 - D2) cos 2a that is D1, and D2 along the weft. A regular lattice has hinges in
    three directions alone: by how it lies, D1 and D2 are off by up to a quarter of their difference there.

    Args:
        hinge: cos 2a of each hinge, shape (H,).
        warp: Bending stiffness D1 of each garment [N m].
        weft: D2 of each garment [N m].
        owner: Garment of each hinge, shape (H,).
    """
    ratio = hinge.new_tensor([b / a if a > 0 else 1.0 for a, b in zip(warp, weft, strict=True)])
    ratio = ratio.clamp(1.0 / MOST_RATIO, MOST_RATIO)[owner.long()]
    return (1.0 + ratio) / 2.0 + 0.75 * (1.0 - ratio) * hinge
