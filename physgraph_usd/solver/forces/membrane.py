"""Membrane: triangles with a shear stiffness of their own.

    E = sum_t A_t (1/2 C11 (e11^2 + e22^2) + C12 e11 e22 + 1/2 C66 (2 e12)^2),   e = (F^T F - 1) / 2

    C11 = Y / (1 - nu^2),   C12 = nu C11,   C66 = G,   nu = 1/3

| symbol | here | meaning |
|---|---|---|
| Y | ``youngs`` | 2D Young's modulus along warp and weft [N/m] |
| G | ``shear`` | shear stiffness [N/m] |
| F | columns ``f1``, ``f2`` | deformation gradient, 3 x 2, in the material's axes |
| e | Green strain | St. Venant-Kirchhoff |
| A_t | ``level.triangle_area`` | rest area [m^2] |

With G = 0.375 Y the sheet is isotropic and equals the edge springs of an equilateral mesh for small strains. Otherwise
the material's axes matter: `triangle_shape` defines them for a triangle. Painted stretch scales multiply all three
constants. The paper has no membrane: with potential="paper" each triangle is weighted by 2 A_t / A, which is what the
paper's springs are to the continuum's on an equilateral mesh.

St. Venant-Kirchhoff softens under compression and has no barrier against inversion. Cloth buckles long before
either matters, and a flat collapsed triangle still has the energy C11 / 8 per area and axis to gain from unfolding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from ..fabric import Fabric
from ..level import Level
from ..mesh.stencil import add_at
from .base import Elements, Force, element_overloads
from .stretch import Stretch, garment_area

wp.set_module_options({"enable_backward": False})

POISSON = 1.0 / 3.0
"""Poisson's ratio between warp and weft; edge springs have the same."""


@wp.kernel
def _membrane(
    first: wp.int32,
    x: wp.array(dtype=Any),
    corners: wp.array(dtype=wp.vec3i),
    a: wp.array(dtype=Any),
    b: wp.array(dtype=Any),
    c: wp.array(dtype=Any),
    d: wp.array(dtype=Any),
    normal_stiffness: wp.array(dtype=Any),
    shear_stiffness: wp.array(dtype=Any),
    energy: wp.array(dtype=Any),
    corner_force: wp.array(dtype=Any),
):
    t = first + wp.tid()
    half = normal_stiffness.dtype(0.5)
    one = normal_stiffness.dtype(1.0)
    nu = one / normal_stiffness.dtype(3.0)
    x0 = x[corners[t][0]]
    side1 = x[corners[t][1]] - x0
    side2 = x[corners[t][2]] - x0
    f1 = side1 * a[t] + side2 * c[t]
    f2 = side1 * b[t] + side2 * d[t]
    e11 = half * (wp.dot(f1, f1) - one)
    e22 = half * (wp.dot(f2, f2) - one)
    angle = wp.dot(f1, f2)
    # The stiffnesses carry the rest area: s is stress times area.
    s11 = normal_stiffness[t] * (e11 + nu * e22)
    s22 = normal_stiffness[t] * (e22 + nu * e11)
    s12 = shear_stiffness[t] * angle
    energy[t] = half * (s11 * e11 + s22 * e22 + s12 * angle)
    p1 = f1 * s11 + f2 * s12
    p2 = f1 * s12 + f2 * s22
    at1 = -(p1 * a[t] + p2 * b[t])
    at2 = -(p1 * c[t] + p2 * d[t])
    corner_force[3 * t] = -(at1 + at2)
    corner_force[3 * t + 1] = at1
    corner_force[3 * t + 2] = at2


_KERNELS = element_overloads(_membrane, width=3, parameters=6)


class Membrane:
    """Triangles of one level.

    Attributes:
        normal_stiffness: C11 times the rest area [N m], shape (T,).
        shear_stiffness: C66 times the rest area [N m], shape (T,).
    """

    name = "membrane"

    def __init__(
        self,
        level: Level,
        youngs: Float[Tensor, " garments"],
        shear: Float[Tensor, " garments"],
        *,
        potential: str = "continuum",
    ) -> None:
        """Weigh the triangles of a level.

        Args:
            level: The level.
            youngs: 2D Young's modulus of each garment [N/m]; zero for garments of edge springs.
            shear: Shear stiffness of each garment [N/m]; zero for garments of edge springs.
            potential: "continuum" or "paper".
        """
        owner = level.triangle_garment.long()
        weight = level.triangle_scale * level.triangle_area
        if potential == "paper":
            weight = weight * 2.0 * level.triangle_area / garment_area(level)[owner]
        # A triangle without area has no rest shape to strain from.
        weight = weight * level.triangle_inverse.any(dim=1)
        self.normal_stiffness = weight * youngs.to(level.rest)[owner] / (1.0 - POISSON**2)
        self.shear_stiffness = weight * shear.to(level.rest)[owner]
        self._level = level
        parameters = [column.contiguous() for column in level.triangle_inverse.T]
        parameters += [self.normal_stiffness, self.shear_stiffness]
        self._elements = Elements(_KERNELS, level.triangles, parameters, level=level)

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        return self._elements.evaluate(x, force)

    def split(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " parts"], Int[Tensor, " parts"]]:
        """Energy of each triangle [J] where the force was added last, and its garment."""
        return self._elements.energy, self._level.triangle_garment

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of each corner's block, geometric part only where it stiffens [N/m].

        With g = (g1, g2) the gradient of the corner's shape function and s the stress:
        trace = C11 (g1^2 |f1|^2 + g2^2 |f2|^2) + 2 C12 g1 g2 f1.f2 + C66 |g1 f2 + g2 f1|^2 + 3 max(0, g.s g).
        """
        corners = x[self._level.triangles.long()]
        sides = corners[:, 1:] - corners[:, :1]
        f = torch.einsum("tsc,tsm->tmc", sides, self._level.triangle_inverse.reshape(-1, 2, 2))
        metric = torch.einsum("tmc,tnc->tmn", f, f)
        m11, m22, m12 = metric[:, 0, 0, None], metric[:, 1, 1, None], metric[:, 0, 1, None]
        e11, e22 = (m11 - 1.0) / 2.0, (m22 - 1.0) / 2.0
        c11, c66 = self.normal_stiffness[:, None], self.shear_stiffness[:, None]
        g1, g2 = self._shape_gradients().unbind(dim=2)
        material = c11 * (g1**2 * m11 + g2**2 * m22 + 2.0 * POISSON * g1 * g2 * m12)
        material = material + c66 * (g1**2 * m22 + g2**2 * m11 + 2.0 * g1 * g2 * m12)
        geometric = c11 * (g1**2 * (e11 + POISSON * e22) + g2**2 * (e22 + POISSON * e11)) + 2.0 * c66 * m12 * g1 * g2
        value = material / 3.0 + geometric.clamp_min(0.0)
        total = torch.zeros_like(self._level.spacing)
        return add_at(total, self._level.triangles.long().reshape(-1), value.reshape(-1))

    def rest_matrix(self) -> sp.csr_matrix:
        """The trace of each block of the Hessian at rest: (C11 + C66) times the cotangent Laplacian [N/m].

        On an equilateral mesh with G = 0.375 Y it equals the springs' matrix.
        """
        triangles = self._level.triangles.cpu().numpy()
        gradient = self._shape_gradients().double().cpu().numpy()
        stiffness = (self.normal_stiffness + self.shear_stiffness).double().cpu().numpy()
        blocks = stiffness[:, None, None] * np.einsum("tim,tjm->tij", gradient, gradient)
        rows, columns = np.repeat(triangles, 3, axis=1).ravel(), np.tile(triangles, (1, 3)).ravel()
        count = self._level.vertex_count
        return sp.csr_matrix((blocks.ravel(), (rows, columns)), shape=(count, count))

    def _shape_gradients(self) -> Float[Tensor, "triangles 3 2"]:
        """Gradients of the corners' shape functions in the material's axes [1/m]."""
        others = self._level.triangle_inverse.reshape(-1, 2, 2)
        return torch.cat([-others.sum(dim=1, keepdim=True), others], dim=1)


def in_plane_terms(level: Level, fabrics: Sequence[Fabric], *, potential: str = "continuum") -> tuple[Force, ...]:
    """Edge springs for the garments whose fabric has no shear stiffness, the membrane for the others.

    Args:
        level: The level.
        fabrics: Fabric of each garment.
        potential: "continuum" or "paper".

    Returns:
        The terms that some garment needs; each is zero on the other's garments.
    """
    sheared = torch.tensor([fabric.shear is not None for fabric in fabrics], dtype=torch.bool)
    youngs = torch.tensor([fabric.stretch for fabric in fabrics], dtype=level.dtype)
    shear = torch.tensor([fabric.shear or 0.0 for fabric in fabrics], dtype=level.dtype)
    terms: list[Force] = []
    if not bool(sheared.all()) or not fabrics:
        terms.append(Stretch(level, torch.where(sheared, 0.0, youngs), potential=potential))
    if bool(sheared.any()):
        terms.append(Membrane(level, torch.where(sheared, youngs, 0.0), shear, potential=potential))
    return tuple(terms)
