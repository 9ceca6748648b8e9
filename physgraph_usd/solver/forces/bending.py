"""Bending: dihedral angles at the edges.

    E = 1/2 sum_h w_h (theta_h - theta0_h)^2,   w_h = D s_h

| symbol | here | meaning |
|---|---|---|
| D | ``rigidity`` | bending stiffness [N m] |
| theta | atan2(n1 x n2 . e, n1 . n2) | signed angle between the triangles' normals [rad] |
| s_h | ``level.hinge_shape`` | l0^2 / (A1 + A2) at edges, 2 A / l0^2 at a quad's diagonal (`level.rest_shape`) |
| | `grain.bending_factor` | for different warp and weft: D by the bending direction of a hinge |

At an edge of a quad the normal is the normal of the triangle from the edge to the midpoint of the opposite side, the
mean over both splits of the quad. theta - theta0 is taken modulo a full turn into [-pi, pi], so the energy is
continuous for every rotation of a hinge: a hem pressed to theta0 = 3 may pass pi. The force changes sign half a turn
from theta0. Gradient after Bridson, Marino, Fedkiw, "Simulation of Clothing with Folds and Wrinkles", 2003.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..grain import bending_factor
from ..level import Level
from ..mesh.formula import SCALAR, element_kernels
from ..mesh.stencil import add_at
from .base import Elements

_BENT = r"""
Vec n1 = cross(axis, ik), n2 = cross(il, axis);
Number square = dot(axis, axis);
// The floors are relative to the hinge's own size: they act on collapsed triangles only.
Number tiny = 1.0e-12f * (square + dot(ik, ik) + dot(il, il));
square = larger(square, tiny + 1.0e-30f);
Number length = root(square), floor = tiny * square + 1.0e-37f;
Number s1 = larger(dot(n1, n1), floor), s2 = larger(dot(n2, n2), floor);

// n1 x n2 . e / |e| is -|e| n1 . (x_l - x_i).
Number theta, across = -length * dot(n1, il), along = dot(n1, n2);
if (sizeof(Scalar) == 8) {
    theta = each([](Scalar y, Scalar x) { return wp::atan2(y + Scalar(0), x + Scalar(0)); }, across, along);
} else {  // To 2e-7 rad, by a minimax polynomial of the arctangent on [0, 1].
    auto steep = fabs(across) > fabs(along);
    Number a = (steep ? fabs(along) : fabs(across)) / ((steep ? fabs(across) : fabs(along)) + 1.0e-37f), s = a * a;
    Number p = 0.023040125f - 0.0043554027f * s;
    p = -0.057773575f + p * s;
    p = 0.09794234f + p * s;
    p = -0.13976581f + p * s;
    p = 0.19962704f + p * s;
    p = -0.3333166f + p * s;
    theta = a + a * s * p;
    theta = steep ? 1.57079632679f - theta : theta;
    theta = along < 0.0f ? 3.14159265359f - theta : theta;
    theta = across < 0.0f ? -theta : theta;
}

const Scalar turn = 6.283185307179586, per_turn = 1.0 / 6.283185307179586;
Number weight = load(parameter0), bent = theta - load(parameter1);
bent = bent - turn * rint(bent * per_turn);
Number moment = weight * bent * length;
Vec at_k = n1 * (moment / s1), at_l = n2 * (moment / s2);
Number per_square = 1.0f / square;
Vec at_j = -(at_k * (dot(ik, axis) * per_square) + at_l * (dot(il, axis) * per_square));
Vec at_i = -at_j - at_k - at_l;
Number energy = 0.5f * weight * bent * bent;
"""
"""Source of the energy [J] of a hinge and the forces [N] on its ends, from the hinge's sides starting at i."""
_KERNELS = element_kernels(
    "bending",
    """
    Vec xi = corner(0), axis = corner(1) - xi, ik = corner(2) - xi, il = corner(3) - xi;"""
    + _BENT
    + "store(energy, {at_i, at_j, at_k, at_l});",
    corners=4,
    parameter=SCALAR,
)
_KERNELS_OF_QUADS = element_kernels(
    "bending_of_quads",
    """
    Number half = 0.5f + Number{};
    Vec xi = corner(0), axis = corner(1) - xi;
    // Differences first: in single precision differences are exact, sums of positions are not.
    Vec ik = ((corner(2) - xi) + (corner(3) - xi)) * half, il = ((corner(4) - xi) + (corner(5) - xi)) * half;"""
    + _BENT
    + "store(energy, {at_i, at_j, at_k * half, at_k * half, at_l * half, at_l * half});",
    corners=6,
    parameter=SCALAR,
)


@dataclass(frozen=True, eq=False)
class _Kind:
    """Hinges with the same number of corners.

    Attributes:
        numbers: Numbers among the level's hinges, shape (K,).
        corners: Corner vertices, shape (K, 4) between triangles and in quads, (K, 6) at edges of quads.
        elements: The launches.
    """

    numbers: Int[Tensor, " hinges"]
    corners: Int[Tensor, "hinges corners"]
    elements: Elements


class Bending:
    """Dihedral springs of one level.

    Attributes:
        weight: Angular stiffness [N m], shape (H,).
    """

    name = "bending"

    def __init__(
        self,
        level: Level,
        rigidity: Float[Tensor, " garments"],
        *,
        weft: Sequence[float] | None = None,
        least: Float[Tensor, " hinges"] | None = None,
    ) -> None:
        """Weigh the hinges of a level.

        Args:
            rigidity: Bending stiffness D of each garment [N m]; along the warp if the weft's differs.
            weft: Bending stiffness along the weft [N m]; None if equal to the warp's, or without grain.
            least: Least bending stiffness of each hinge [N m]; None for no bound.
        """
        owner = level.hinge_garment.long()
        scaled = rigidity.to(level.rest)[owner] * level.bend_scale
        if level.grain is not None and weft is not None:
            scaled = scaled * bending_factor(level.grain.hinge, rigidity.tolist(), weft, owner)
        if least is not None:
            scaled = torch.maximum(scaled, least)
        self.weight = scaled * level.hinge_shape
        self._level = level
        narrow = (level.hinges[:, 2] == level.hinges[:, 3]) & (level.hinges[:, 4] == level.hinges[:, 5])
        self._kinds = [
            _Kind(
                numbers,
                corners,
                Elements(kernels, corners, [self.weight[numbers], level.rest_angle[numbers]], level=level),
            )
            for numbers, columns, kernels in (
                (torch.nonzero(narrow)[:, 0], [0, 1, 2, 4], _KERNELS),
                (torch.nonzero(~narrow)[:, 0], [0, 1, 2, 3, 4, 5], _KERNELS_OF_QUADS),
            )
            for corners in (level.hinges[numbers][:, columns],)
            if len(numbers)
        ]

    @property
    def elements(self) -> tuple[Elements, ...]:
        """The hinges, by number of corners."""
        return tuple(kind.elements for kind in self._kinds)

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        energy = torch.zeros((), dtype=torch.float64, device=x.device)
        for kind in self._kinds:
            energy = energy + kind.elements.evaluate(x, force)
        return energy

    def split(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " parts"], Int[Tensor, " parts"]]:
        """Energy of each hinge [J] at the last evaluated positions, and the hinge's garment."""
        energy = torch.zeros_like(self.weight)
        for kind in self._kinds:
            energy[kind.numbers] = kind.elements.energy
        return energy, self._level.hinge_garment

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of w (dtheta/dx)(dtheta/dx)^T at each corner [N/m]."""
        total = torch.zeros_like(self._level.spacing)
        for kind in self._kinds:
            jacobian = hinge_jacobian(x, kind.corners)
            value = self.weight[kind.numbers].unsqueeze(1) * (jacobian**2).sum(dim=2) / 3.0
            if kind.corners.shape[1] == 6:  # A triangle's corner is repeated, with half of its gradient each time.
                twice = (kind.corners[:, 2::2] == kind.corners[:, 3::2]).repeat_interleave(2, dim=1)
                value[:, 2:] *= torch.where(twice, 2.0, 1.0)
            add_at(total, kind.corners.long().reshape(-1), value.reshape(-1))
        return total

    def rest_springs(self) -> tuple[np.ndarray, float]:
        """Springs with the couplings of the rest shape's pattern, each hinge unfolded flat [N/m], shape (S,)."""
        return self._level.hinge_couplings @ self.weight.double().cpu().numpy(), 0.0


def hinge_jacobian(
    x: Float[Tensor, "vertices 3"], hinges: Int[Tensor, "hinges corners"]
) -> Float[Tensor, "hinges corners 3"]:
    """dtheta/dx at the four or six corners of each hinge [1/m]; zero rows at triangles without area."""
    ends = _columns_of_ends(hinges.shape[1])
    xi, xj, xk, xl = (x[hinges[:, columns].long()].mean(dim=1) for columns in ends)
    axis, ik, il = xj - xi, xk - xi, xl - xi
    n1, n2 = torch.linalg.cross(axis, ik), torch.linalg.cross(il, axis)
    square = (axis**2).sum(dim=1, keepdim=True)
    tiny = 1e-12 * (square + (ik**2).sum(dim=1, keepdim=True) + (il**2).sum(dim=1, keepdim=True))
    square = torch.maximum(square, tiny + 1e-30)
    length, floor = square.sqrt(), tiny * square + 1e-37
    at_k = -n1 * length / torch.maximum((n1**2).sum(dim=1, keepdim=True), floor)
    at_l = -n2 * length / torch.maximum((n2**2).sum(dim=1, keepdim=True), floor)
    t1 = (ik * axis).sum(dim=1, keepdim=True) / square
    t2 = (il * axis).sum(dim=1, keepdim=True) / square
    at_i, at_j = -(at_k * (1 - t1) + at_l * (1 - t2)), -(at_k * t1 + at_l * t2)
    at = (at_i, at_j, at_k, at_l)
    return torch.stack(
        [gradient / len(columns) for gradient, columns in zip(at, ends, strict=True) for _ in columns], dim=1
    )


def _columns_of_ends(width: int) -> tuple[list[int], list[int], list[int], list[int]]:
    """The columns of a hinge's four or six corners for i, j, k and l."""
    return ([0], [1], [2], [3]) if width == 4 else ([0], [1], [2, 3], [4, 5])
