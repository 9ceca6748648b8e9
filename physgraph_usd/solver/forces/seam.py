"""Seams: what forces do to cloth whose sewn points are one.

    E'(x) = E(A x),    F'(x) = A^T F(A x)

| symbol | here | meaning |
|---|---|---|
| A | ``Seam.closed`` | sewn points at their mean, or at what may not move; all others where they are |
| A^T | ``Seam.shared`` | each of n sewn points feels an n-th of what all of them feel |

So a seam holds exactly, however stiff the cloth, and an integrator need not know of it: steps that would open it change
neither energy nor force.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from ..mesh.stencil import Stencil
from ..mesh.topology import joined_by
from .base import ForceModule


class Seam:
    """Points of a level that are sewn together.

    Attributes:
        pairs: Vertices that are, each any number of times, shape (N, 2).
        label: A number for each vertex, the same for what is sewn together, shape (V,).
    """

    def __init__(self, level: Level, pairs: np.ndarray) -> None:
        """Group pairs of vertices, each vertex any number of times.

        Args:
            level: The level.
            pairs: Vertices, shape (N, 2), N > 0.
        """
        self.pairs = pairs
        sewn, ends = np.unique(pairs, return_inverse=True)
        count = len(sewn)
        group = joined_by(ends.reshape(-1, 2), count)
        self.label = np.arange(level.vertex_count)
        self.label[sewn] = sewn[np.unique(group, return_index=True)[1]][group]
        free = level.free[:, 0].cpu().numpy()[sewn]
        held = np.bincount(group, ~free)[group] > 0
        leads = np.where(held, ~free, True)
        member = sp.csr_matrix((leads.astype(float), (group, np.arange(count))))
        mean = sp.csr_matrix(sp.diags(1.0 / np.asarray(member.sum(axis=1)).ravel()) @ member)[group]
        first = np.asarray(member.argmax(axis=1)).ravel()[group]
        device, dtype = level.device, level.dtype
        self._place, self._first = (torch.as_tensor(each, device=device) for each in (sewn, first))
        self._free = level.free[self._place]
        self._mean = Stencil(mean, dtype=dtype, device=device)
        self._fraction = Stencil(sp.csr_matrix(sp.diags((~held).astype(float)) @ mean), dtype=dtype, device=device)

    def closed(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Sewn points brought together; to the last bit as they are where they are together."""
        points = x[self._place]
        first = points[self._first]
        out = x.clone()
        out[self._place] = torch.where(self._free, first + self._mean.apply(points - first), points)
        return out

    def shared(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Forces shared by sewn points; none on what is sewn to something that may not move."""
        out = force.clone()
        out[self._place] = self._fraction.apply(force[self._place])
        return out


class SewnForces:
    """The forces on cloth whose seams are closed."""

    def __init__(self, field: ForceModule, seam: Seam) -> None:
        """Take the forces of the cloth as if it were in pieces, and its seam."""
        self._field, self._seam = field, seam

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, ""], Float[Tensor, "vertices 3"]]:
        """Energy [J] and force [N] with the seams of x [m] closed."""
        energy, force = self._field.energy_and_force(self._seam.closed(x))
        return energy, self._seam.shared(force)

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of each vertex's Hessian block [N/m], the mean of those of sewn points."""
        apart = self._field.diagonal(self._seam.closed(x)).unsqueeze(1).expand(-1, 3)
        together = self._seam.shared(apart.contiguous())[:, 0]
        return torch.where(together > 0, together, apart[:, 0])
