"""Membrane: triangles with separate warp, weft and shear stiffness.

    E = sum_t A_t (1/2 C11 e1^2 + 1/2 C22 e2^2 + C12 e1 e2 + 1/2 G s^2 + limits),   e_i = |f_i| - 1
    C11 = Y1 / (1 - nu^2),   C22 = Y2 / (1 - nu^2),   C12 = nu sqrt(C11 C22),   nu = 1/3
    s = (1 + d^2) f1 . f2 / (n1 n2),   n_i^2 = |f_i|^2 + d^2,   d = `COLLAPSED_SIDE`
    limits = 1/2 S (C11 max(0, e1 - e)^2 + C22 max(0, e2 - e)^2),   S = `STIFFER`

| symbol | here | meaning |
|---|---|---|
| Y1, Y2 | ``youngs``, ``weft`` | 2D Young's modulus along warp and weft [N/m] |
| G | ``shear`` | shear stiffness [N/m] |
| f1, f2 | columns of F | images of the unit vectors along warp and weft under the deformation |
| s | | sine of the shear angle, rounded off for a vanishing vector |
| e | ``limit`` | strain beyond which the cloth stiffens |
| A_t | ``level.membrane_area`` | rest area [m^2] |

Warp and weft stretch like springs, and shear counts by angle, after Baraff and Witkin, "Large Steps in Cloth
Simulation", 1998; the coupling makes the sheet orthotropic, nu^2 the product of the two Poisson's ratios. For small
strains the model is linear elasticity. For large strains Green's strain would grow with the square of a length, and
cages have triangles stretched threefold: there the cloth would be too stiff by as much.

With G = 0.375 Y the sheet is isotropic and equals the edge springs of an equilateral mesh for small strains. Otherwise
the material's axes matter: `grain.axes` defines them for a triangle. Painted stretch scales multiply all constants.

There is no barrier against inversion: cloth buckles long before inversion matters.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..fabric import Fabric
from ..level import Level
from ..mesh.formula import QUAD, element_kernels
from ..mesh.stencil import add_at
from .base import Elements, Force
from .stretch import Stretch

POISSON = 1.0 / 3.0
"""Poisson's ratio between warp and weft; edge springs have the same."""
ISOTROPIC = 0.375
"""Shear stiffness of an isotropic sheet with Poisson's ratio `POISSON`, in Young's moduli."""
STIFFER = 20.0
"""Stiffening factor beyond the limit: the tensile curves of the measured fabrics steepen ten- to thirtyfold."""
STIFFEST = 1.0
"""Upper bound of A |g|^2 after `sliver_weight`: the value of a right-angled isosceles triangle."""
COLLAPSED_SIDE = 0.2
"""Length of warp or weft, relative to rest, below which the shear direction fades."""
NO_LIMIT = 1e9
"""A strain never reached."""


_KERNELS = element_kernels(
    "membrane",
    f"constexpr Scalar POISSON = {POISSON}, STIFFER = {STIFFER}, COLLAPSED_SIDE = {COLLAPSED_SIDE};"
    """
    Vec x0 = corner(0), side1 = corner(1) - x0, side2 = corner(2) - x0;
    Quad g = load4(parameter0), c = load4(parameter1);
    Vec f1 = side1 * g[0] + side2 * g[2], f2 = side1 * g[1] + side2 * g[3];
    Number q1 = dot(f1, f1), q2 = dot(f2, f2), l1 = root(q1), l2 = root(q2);
    Number e1 = l1 - 1.0f, e2 = l2 - 1.0f, none = {};

    // The stiffnesses carry the rest area: s is stress times area.
    Number limit = c[3], coupling = POISSON * root(c[0] * c[1]);
    Number s1 = c[0] * e1 + coupling * e2, s2 = c[1] * e2 + coupling * e1;
    Number more1 = e1 > limit ? STIFFER * c[0] * (e1 - limit) : none;
    Number more2 = e2 > limit ? STIFFER * c[1] * (e2 - limit) : none;
    Number stored = s1 * e1 + s2 * e2 + more1 * (e1 - limit) + more2 * (e2 - limit);

    // Shear by the angle between f1 and f2; directions fade for a vanishing vector.
    constexpr Scalar rounding = COLLAPSED_SIDE * COLLAPSED_SIDE;
    Number n1 = q1 + rounding, n2 = q2 + rounding, r = 1.0f / root(n1 * n2);
    Number sine = dot(f1, f2) * r, turn = c[2] * (1.0f + rounding) * (1.0f + rounding) * sine * r;
    Number back = sine * turn * r, tiny = 1.0e-6f + none;
    Vec p1 = f1 * ((s1 + more1) / larger(l1, tiny) - back * n2) + f2 * turn;
    Vec p2 = f2 * ((s2 + more2) / larger(l2, tiny) - back * n1) + f1 * turn;
    Vec at1 = -(p1 * g[0] + p2 * g[1]), at2 = -(p1 * g[2] + p2 * g[3]);
    store(0.5f * (stored + turn * dot(f1, f2)), {-(at1 + at2), at1, at2});
    """,
    corners=3,
    parameter=QUAD,
)


class Membrane:
    """Triangles of one level.

    Attributes:
        warp_stiffness, weft_stiffness: C11 and C22 times the rest area [N m], shape (T,).
        shear_stiffness: C66 times the rest area [N m], shape (T,).
        elements: The triangles.
    """

    name = "membrane"

    def __init__(
        self,
        level: Level,
        youngs: Float[Tensor, " garments"],
        shear: Float[Tensor, " garments"],
        *,
        weft: Float[Tensor, " garments"] | None = None,
        limit: Float[Tensor, " garments"] | None = None,
    ) -> None:
        """Weigh the triangles of a level.

        Args:
            youngs: 2D Young's modulus of each garment along the warp [N/m]; zero for garments of edge springs.
            shear: Shear stiffness of each garment [N/m]; zero for garments of edge springs.
            weft: 2D Young's modulus of each garment along the weft [N/m]; None if equal to the warp's.
            limit: Strain beyond which each garment's cloth stiffens; None for no limit.
        """
        owner = level.membrane_garment.long()
        weight = level.membrane_scale * level.membrane_area
        # A triangle without area has no rest shape to strain from; a sliver is strained by the mesh, not by the cloth.
        weight = weight * level.membrane_inverse.any(dim=1) * sliver_weight(level)
        self.warp_stiffness, self.weft_stiffness = (
            weight * modulus.to(level.rest)[owner] / (1.0 - POISSON**2)
            for modulus in (youngs, youngs if weft is None else weft)
        )
        self.shear_stiffness = weight * shear.to(level.rest)[owner]
        limits = torch.full_like(youngs, NO_LIMIT) if limit is None else limit
        self._level = level
        stiffness = [self.warp_stiffness, self.weft_stiffness, self.shear_stiffness, limits.to(level.rest)[owner]]
        parameters = [level.membrane_inverse.contiguous(), torch.stack(stiffness, dim=1)]
        self.elements = (Elements(_KERNELS, level.membrane, parameters, level=level),)

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        return self.elements[0].evaluate(x, force)

    def split(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " parts"], Int[Tensor, " parts"]]:
        """Energy of each triangle [J] at the last evaluated positions, and the triangle's garment."""
        return self.elements[0].energy, self._level.membrane_garment

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of each corner's block, without limits, geometric part only if stiffening [N/m].

        With g = (g1, g2) the gradient of the corner's shape function, d_i = f_i / |f_i|, r_i the derivative of the sine
        by f_i and s_i the stress along f_i: trace = C11 g1^2 + C22 g2^2 + 2 C12 g1 g2 d1.d2 + G |g1 r1 + g2 r2|^2
        + 2 sum_i max(0, s_i / |f_i|) g_i^2.
        """
        corners = x[self._level.membrane.long()]
        sides = corners[:, 1:] - corners[:, :1]
        f = torch.einsum("tsc,tsm->tmc", sides, self._level.membrane_inverse.reshape(-1, 2, 2))
        length = f.norm(dim=2).clamp_min(1e-6)
        reach = (length**2 + COLLAPSED_SIDE**2).sqrt().unsqueeze(2)
        u = f / reach
        sine = (u[:, 0] * u[:, 1]).sum(dim=1)
        turn = (1.0 + COLLAPSED_SIDE**2) * (u.flip(1) - u * sine[:, None, None]) / reach
        c11, c22, c12, c66 = (stiffness[:, None] for stiffness in self._stiffnesses)
        cosine = (f[:, 0] * f[:, 1]).sum(dim=1, keepdim=True) / length.prod(dim=1, keepdim=True)
        g = shape_gradients(self._level)
        g1, g2 = g.unbind(dim=2)
        value = c11 * g1**2 + c22 * g2**2 + 2.0 * c12 * g1 * g2 * cosine
        value = value + c66 * torch.einsum("tim,tmc->tic", g, turn).square().sum(dim=2)
        e1, e2 = (length - 1.0).split(1, dim=1)
        stress = torch.cat([c11 * e1 + c12 * e2, c22 * e2 + c12 * e1], dim=1)
        value = (value + 2.0 * (g**2 * (stress / length).clamp_min(0.0).unsqueeze(1)).sum(dim=2)) / 3.0
        total = torch.zeros_like(self._level.spacing)
        return add_at(total, self._level.membrane.long().reshape(-1), value.reshape(-1))

    def rest_springs(self) -> tuple[np.ndarray, float]:
        """The trace of each block of the Hessian at rest [N/m]: C11 + C66 along the warp, C22 + C66 along the weft.

        On an equilateral mesh with G = 0.375 Y these are the edge springs, shape (S,).
        """
        level, (g1, g2) = self._level, shape_gradients(self._level).double().unbind(dim=2)
        c11, c22, _, c66 = (stiffness.double()[:, None] for stiffness in self._stiffnesses)
        coupling = (c11 + c66) * g1 * g1.roll(-1, 1) + (c22 + c66) * g2 * g2.roll(-1, 1)
        sides, values = (array.cpu().numpy().ravel() for array in (level.sides, -coupling))
        return np.bincount(sides, values, len(level.springs)), 0.0

    @property
    def _stiffnesses(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """C11, C22, C12 and C66 times the rest area [N m], each of shape (T,)."""
        coupling = POISSON * (self.warp_stiffness * self.weft_stiffness).sqrt()
        return self.warp_stiffness, self.weft_stiffness, coupling, self.shear_stiffness


def sliver_weight(level: Level) -> Float[Tensor, " triangles"]:
    """1 for sound triangles; for slivers, the factor limiting stiffness to the stiffest sound triangle's, shape (T,).

    A corner's move strains a triangle by the gradient g of its shape function, with a stiffness proportional to A
    |g|^2:
    0.58 for an equilateral triangle, unbounded for slivers.
    """
    gradient = shape_gradients(level).square().sum(dim=2).amax(dim=1)
    return (STIFFEST / (level.membrane_area * gradient).clamp_min(1e-12)).clamp_max(1.0)


def shape_gradients(level: Level) -> Float[Tensor, "triangles 3 2"]:
    """Gradients of the corners' shape functions along warp and weft [1/m]."""
    gradients = level.membrane_inverse.reshape(-1, 2, 2)
    return torch.cat([-gradients.sum(dim=1, keepdim=True), gradients], dim=1)


def in_plane_terms(level: Level, fabrics: Sequence[Fabric]) -> tuple[Force, ...]:
    """Edge springs for the garments with a suitable fabric, the membrane for the others.

    Returns:
        The terms needed by some garment; each term is zero on the garments of the opposite kind.
    """
    woven = torch.tensor([fabric.has_membrane for fabric in fabrics], dtype=torch.bool)

    def per_garment(values: Sequence[float]) -> Tensor:
        return torch.tensor(values, dtype=level.dtype)

    youngs = per_garment([fabric.stretch for fabric in fabrics])
    terms: list[Force] = []
    if not bool(woven.all()) or not fabrics:
        terms.append(Stretch(level, torch.where(woven, 0.0, youngs)))
    if bool(woven.any()):
        weft = per_garment([fabric.stretch if f is None else f for fabric in fabrics for f in (fabric.weft_stretch,)])
        shear = per_garment([shear_stiffness(fabric) for fabric in fabrics])
        limit = per_garment([NO_LIMIT if f.stretch_limit is None else f.stretch_limit for f in fabrics])
        youngs, weft, shear = (torch.where(woven, value, 0.0) for value in (youngs, weft, shear))
        terms.append(Membrane(level, youngs, shear, weft=weft, limit=limit))
    return tuple(terms)


def shear_stiffness(fabric: Fabric) -> float:
    """Shear stiffness of a fabric [N/m]; by default the value of an isotropic sheet."""
    if fabric.shear is not None:
        return fabric.shear
    weft = fabric.stretch if fabric.weft_stretch is None else fabric.weft_stretch
    return ISOTROPIC * (fabric.stretch * weft) ** 0.5
