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

from .mesh.topology import find_edges

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


def axes(rest: np.ndarray, triangles: np.ndarray, warp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit warp and weft of each triangle in its plane.

    Where no warp is known, or it stands across the triangle, the rest frame's axis that lies most nearly in the plane
    stands for it: a membrane of equal stiffness both ways is the same after a quarter turn, so wherever the cloth is
    tangent to an axis, neighbours agree whichever they take.

    Args:
        rest: Rest positions [m], shape (V, 3), float64.
        triangles: Shape (T, 3).
        warp: Direction on each triangle, shape (T, 3); 0 where none is known.
    """
    corners = rest[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    nearest = np.eye(3)[np.abs(normal).argmin(axis=1)]
    inside = [each - normal * np.einsum("tc,tc->t", each, normal)[:, None] for each in (warp, nearest)]
    lengths = [np.linalg.norm(each, axis=1, keepdims=True) for each in inside]
    chosen = np.where(lengths[0] > 1e-3, inside[0], inside[1])
    along = chosen / np.where(lengths[0] > 1e-3, lengths[0], lengths[1])
    return along, np.cross(normal, along)


def edge_cosines(rest: np.ndarray, triangles: np.ndarray, edges: np.ndarray, *, warp: np.ndarray) -> np.ndarray:
    """Squared cosines of each edge with warp and weft, mean over its triangles, shape (E, 2); see `axes`."""
    both = axes(rest, triangles, warp)
    total, count = np.zeros((len(edges), 2)), np.zeros(len(edges))
    for corner in range(3):
        ends = triangles[:, [corner, (corner + 1) % 3]]
        span = rest[ends[:, 1]] - rest[ends[:, 0]]
        square = np.maximum((span**2).sum(axis=1), np.finfo(float).tiny)
        which = find_edges(edges, ends)
        for axis in range(2):
            np.add.at(total[:, axis], which, np.einsum("tc,tc->t", span, both[axis]) ** 2 / square)
        np.add.at(count, which, 1.0)
    return np.where(count[:, None] > 0, total / np.maximum(count, 1.0)[:, None], 0.5)


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
