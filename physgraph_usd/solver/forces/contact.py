"""Contact: pushes vertices out of bodies, each body approximated by a plane near each vertex.

    E = 1/2 sum_v k_c a_v phi_v^2

| symbol | here | meaning |
|---|---|---|
| phi_v | max(offset - n_v . (x_v - c_v), 0) | depth of v inside the body enlarged by the offset [m] |
| c_v, n_v | ``Planes`` | closest point of the body and its outward normal, found by the creator of the term |
| k_c | ``stiffness`` | [N/m^3] |

The planes are constant during the life of the term, so the energy is a function of x only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import scipy.sparse as sp
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..level import Level
from ..mesh.kernels import KERNELS, start_warp
from ..mesh.stencil import SCALAR, VECTOR, overloads, vectors
from ..mesh.threads import Launch, argument

wp.set_module_options(KERNELS)


@dataclass(frozen=True, eq=False)
class Planes:
    """One body as seen by some vertices; each vertex occurs once.

    Attributes:
        vertex: Vertex of each plane, ascending, shape (N,), int32.
        normal: Outward unit normals, shape (N, 3).
        height: n . c + offset [m], shape (N,).
    """

    vertex: Int[Tensor, " planes"]
    normal: Float[Tensor, "planes 3"]
    height: Float[Tensor, " planes"]


@wp.kernel
def _push(
    first: wp.int32,
    x: wp.array(dtype=Any),
    vertex: wp.array(dtype=wp.int32),
    normal: wp.array(dtype=Any),
    height: wp.array(dtype=Any),
    weight: wp.array(dtype=Any),
    energy: wp.array(dtype=Any),
    force: wp.array(dtype=Any),
):
    i = first + wp.tid()
    v = vertex[i]
    depth = height[i] - wp.dot(normal[i], x[v])
    zero = depth - depth
    depth = wp.max(depth, zero)
    pull = weight[i] * depth
    energy[i] = pull * depth
    force[v] = force[v] + pull * normal[i]


_PUSH = overloads(_push, VECTOR, wp.int32, VECTOR, SCALAR, SCALAR, SCALAR, VECTOR)


class Contact:
    """Springs between vertices and the planes representing bodies.

    Attributes:
        planes: One entry per body.
        stiffness: k_c [N/m^3].
    """

    name = "contact"

    def __init__(self, level: Level, planes: Sequence[Planes], stiffness: float | Float[Tensor, " vertices"]) -> None:
        """Weigh the planes.

        Args:
            level: The level.
            planes: One entry per body.
            stiffness: k_c, a single value or one per vertex.
        """
        self.stiffness = stiffness
        self.planes = tuple(each for each in planes if len(each.vertex))
        self._level = level
        weight = stiffness * level.vertex_area
        self._weights = [weight[each.vertex.long()] for each in self.planes]
        self._buffers = [torch.zeros_like(each) for each in self._weights]
        self._launches = [
            self._prepare(level, *parts) for parts in zip(self.planes, self._weights, self._buffers, strict=True)
        ]

    @staticmethod
    def _prepare(level: Level, planes: Planes, weight: Tensor, energy: Tensor) -> Launch:
        start_warp()  # Creating tensor views does not start Warp.
        x = vectors(torch.zeros_like(level.rest))
        plane_arrays = [argument(planes.vertex), vectors(planes.normal), argument(planes.height)]
        inputs = [x, *plane_arrays, argument(weight), argument(energy), x]
        return Launch(_PUSH[level.dtype], len(planes.vertex), inputs, device=level.device, threads=level.threads)

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the force [N] in place and return the energy [J]."""
        energy = torch.zeros((), dtype=torch.float64, device=x.device)
        for launch, buffer in zip(self._launches, self._buffers, strict=True):
            launch({0: vectors(x), 6: vectors(force)})
            energy = energy + 0.5 * buffer.sum(dtype=torch.float64)
        return energy

    def split(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, " parts"], Int[Tensor, " parts"]]:
        """Energy of each plane [J] at the last evaluated positions, and the vertex's garment."""
        owners = [self._level.vertex_garment[each.vertex.long()] for each in self.planes]
        return 0.5 * torch.cat(self._buffers), torch.cat(owners)

    def depths(self, x: Float[Tensor, "vertices 3"]) -> list[Float[Tensor, " planes"]]:
        """Depth of each vertex behind each of its planes [m], not below zero; one entry per body."""
        return [(each.height - (each.normal * x[each.vertex.long()]).sum(dim=1)).clamp_min(0.0) for each in self.planes]

    def near(self, level: Level) -> Bool[Tensor, "vertices 1"]:
        """Whether each vertex has a plane."""
        near = torch.zeros_like(level.free)
        for each in self.planes:
            near[each.vertex.long()] = True
        return near

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """k_c a_v / 3 at pushing planes [N/m]."""
        out = torch.zeros_like(x[:, 0])
        for planes, weight, depth in zip(self.planes, self._weights, self.depths(x), strict=True):
            out[planes.vertex.long()] += torch.where(depth > 0, weight / 3.0, torch.zeros_like(weight))
        return out

    def rest_matrix(self) -> sp.csr_matrix | None:
        """None: no contact at rest."""
        return None
