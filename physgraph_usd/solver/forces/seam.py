"""Seams: transforms forces for cloth with sewn points, of two garments, of three sheets, and of unequal borders.

    E'(x) = E(A x),    F'(x) = A^T F(A x)

| symbol | here | meaning |
|---|---|---|
| A | ``Seam.closed`` | moves sewn points to their mean, to a fixed vertex, or onto the followed edge |
| A^T | ``Seam.shared`` | each of n coincident points gets an n-th of the total force |

Seams hold exactly, however stiff the cloth, and need no support by integrators: steps that would open a seam change
neither energy nor force.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from torch import Tensor

from ..level import Level
from ..mesh.borders import OnEdge, finer_side, nearest_edges
from ..mesh.stencil import Stencil
from ..mesh.topology import edges_of, joined_by
from ..mesh.weld import WELDED, pairs_within
from ..scene import Garment
from .base import ForceModule


class Seam:
    """Sewn points of a level.

    Attributes:
        pairs: Vertices treated as one, possibly repeated, shape (N, 2): coincident vertices, and each vertex following
            an edge with the nearer end of the edge.
        label: A number for each vertex, equal for vertices treated as one, shape (V,).
    """

    def __init__(self, level: Level, pairs: np.ndarray, between: OnEdge | None = None) -> None:
        """Group the vertices.

        Args:
            pairs: Coincident vertices, possibly repeated, shape (N, 2).
            between: Vertices lying on edges. The ends of the edges do not lie on edges themselves.
        """
        self._between = None
        joined = pairs
        if between is not None and len(between.vertex):
            self._between = _Between(level, between)
            nearer = np.where(between.part < 0.5, between.edge[:, 0], between.edge[:, 1])
            joined = np.concatenate([pairs, np.stack([between.vertex, nearer], axis=1)])
        self.pairs = joined
        self.label = _lowest(joined, level.vertex_count)
        sewn = np.unique(pairs)
        group = np.unique(_lowest(pairs, level.vertex_count)[sewn], return_inverse=True)[1].reshape(-1)
        free = level.free[:, 0].cpu().numpy()[sewn]
        has_fixed = np.bincount(group, ~free, minlength=1)[group] > 0
        leads = np.where(has_fixed, ~free, True)
        member = sp.csr_matrix(
            (leads.astype(float), (group, np.arange(len(sewn)))), shape=(group.max(initial=-1) + 1, len(sewn))
        )
        mean = sp.csr_matrix(sp.diags(1.0 / np.asarray(member.sum(axis=1)).ravel()) @ member)[group]
        leading = np.flatnonzero(leads)  # Each group has one, and without groups there is none.
        first = leading[np.unique(group[leading], return_index=True)[1]][group]
        device, dtype = level.device, level.dtype
        self._sewn, self._first = (torch.as_tensor(vertices, device=device) for vertices in (sewn, first))
        self._free = level.free[self._sewn]
        self._mean = Stencil(mean, dtype=dtype, device=device)
        self._fraction = Stencil(sp.csr_matrix(sp.diags((~has_fixed).astype(float)) @ mean), dtype=dtype, device=device)

    def closed(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Positions with sewn points moved together; coincident points are unchanged to the bit."""
        points = x[self._sewn]
        first = points[self._first]
        out = x.clone()
        out[self._sewn] = torch.where(self._free, first + self._mean.apply(points - first), points)
        return out if self._between is None else self._between.placed(out)

    def least(self, values: Float[Tensor, " vertices"]) -> Float[Tensor, " vertices"]:
        """Values with the least of those sewn together at each; ends of edges have the least on the edge, too."""
        value = values if self._between is None else self._between.least(values)
        label = torch.as_tensor(self.label, device=value.device).long()
        return torch.full_like(value, torch.inf).scatter_reduce(0, label, value, "amin")[label]

    def shared(self, force: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Forces on sewn points, A^T F; zero on points sewn to a fixed vertex."""
        out = force.clone() if self._between is None else self._between.handed_on(force)
        out[self._sewn] = self._fraction.apply(out[self._sewn])
        return out


class _Between:
    """Vertices following points on edges."""

    def __init__(self, level: Level, on: OnEdge) -> None:
        device, dtype = level.device, level.dtype
        self._vertex, self._start, self._end = (
            torch.as_tensor(vertices, device=device) for vertices in (on.vertex, on.edge[:, 0], on.edge[:, 1])
        )
        self._part = torch.as_tensor(on.part, dtype=dtype, device=device).unsqueeze(1)
        self._free = level.free[self._vertex]
        weights = np.concatenate([1.0 - on.part, on.part]) * np.tile(self._free[:, 0].cpu().numpy(), 2)
        columns = np.tile(np.arange(len(on.vertex)), 2)
        shape = (level.vertex_count, len(on.vertex))
        ends = sp.csr_matrix((weights, (on.edge.T.ravel(), columns)), shape=shape)
        self._ends = Stencil(ends, dtype=dtype, device=device)

    def placed(self, x: Tensor) -> Tensor:
        """Positions with the vertices on their edges; x is modified in place."""
        start = x[self._start]
        x[self._vertex] = torch.where(self._free, start + self._part * (x[self._end] - start), x[self._vertex])
        return x

    def least(self, values: Tensor) -> Tensor:
        """Values with those of the vertices at the ends of their edges, if less."""
        ends = torch.cat([self._start, self._end])
        return values.scatter_reduce(0, ends.long(), values[self._vertex].repeat(2), "amin")

    def handed_on(self, force: Tensor) -> Tensor:
        """Forces with the vertices' forces moved to the ends of their edges."""
        out = force + self._ends.apply(force[self._vertex].contiguous())
        out[self._vertex] = 0.0
        return out


def _lowest(pairs: np.ndarray, count: int) -> np.ndarray:
    """The lowest vertex connected to each vertex by pairs, shape (V,)."""
    label = joined_by(pairs, count) if len(pairs) else np.arange(count)
    return np.unique(label, return_index=True)[1][label]


class SewnForces:
    """The forces on cloth with closed seams."""

    def __init__(self, field: ForceModule, seam: Seam) -> None:
        """Take the forces of the unsewn cloth, and the seam."""
        self._field, self._seam = field, seam

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, ""], Float[Tensor, "vertices 3"]]:
        """Energy [J] and force [N] with the seams of x [m] closed."""
        energy, force = self._field.energy_and_force(self._seam.closed(x))
        return energy, self._seam.shared(force)

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of each vertex's Hessian block [N/m], averaged over sewn points."""
        diagonal = self._field.diagonal(self._seam.closed(x)).unsqueeze(1).expand(-1, 3)
        averaged = self._seam.shared(diagonal.contiguous())[:, 0]
        return torch.where(averaged > 0, averaged, diagonal[:, 0])


def level_seams(levels: Sequence[Level], garments: Sequence[Garment]) -> list[Seam | None]:
    """The seam of each level, None where nothing is sewn; garments as `Garment.sewn_at` has them."""
    positions = [np.full((len(g.rest), 3), np.nan) if g.sewn_at is None else g.sewn_at for g in garments]
    sewn_at = np.concatenate(positions) if positions else np.zeros((0, 3))
    return [_seam(level, sewn_at) for level in levels]


def _seam(level: Level, sewn_at: Float[np.ndarray, "coarse 3"]) -> Seam | None:
    """The seam of one level, by the places at which sewn vertices of the cage lie in one pose [m]."""
    sewn = np.asarray(np.isfinite(sewn_at).all(axis=1))
    if not sewn.any():
        return None
    # A fine vertex is sewn if all cage vertices of its stencil are. Vertices without area are no cloth.
    share = np.asarray(level.from_coarse @ sewn.astype(np.float64)).ravel()
    on_seam = (share > 1.0 - 1e-9) & (level.vertex_area > 0).cpu().numpy()
    points = np.asarray(level.from_coarse @ np.where(sewn[:, None], sewn_at, 0.0))
    within = WELDED * float(level.spacing.mean())
    pairs = pairs_within([points], np.flatnonzero(on_seam), within)
    unpaired = on_seam.copy()
    unpaired[pairs] = False
    between = _between(level, points, on_seam, np.flatnonzero(unpaired), within)
    return Seam(level, pairs, between) if len(pairs) or len(between.vertex) else None


def _between(level: Level, points: np.ndarray, on_seam: np.ndarray, unpaired: np.ndarray, within: float) -> OnEdge:
    """Border vertices between the vertices of another border, with the edge under each."""
    edges = edges_of(level.triangles.cpu().numpy(), level.vertex_count)
    border = edges.vertices[edges.face_count == 1].astype(np.int64)
    border = border[on_seam[border].all(axis=1)]
    return finer_side(points, border, nearest_edges(points, unpaired, border, np.full(len(unpaired), within)))
