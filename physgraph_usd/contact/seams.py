"""Points that the input has at one place: garments that meet at a seam, or one whose mesh is cut along it."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from scipy.sparse import csgraph
from scipy.spatial import cKDTree
from torch import Tensor

from ..forces.seam import Seam
from ..level import Level

AT_ONE_PLACE = 1e-3
"""Distance under which points are at one place, in mean cage edges."""
STRONG = 10.0
"""Stiffness of a seam's springs, in stretch stiffnesses."""


class Seams:
    """The seams of one frame."""

    def __init__(self, cage: Level, coarse: Float[Tensor, "coarse 3"], stretch: float) -> None:
        """Find cage points at one place, in this frame and, of one garment, at rest too.

        Args:
            cage: The cage.
            coarse: Its positions [m].
            stretch: Stretch stiffness of the cloth [N/m].
        """
        self._stiffness = STRONG * stretch
        self._near = AT_ONE_PLACE * float(cage.spacing.mean())
        self._garment, self._rest = cage.vertex_garment.cpu().numpy(), cage.rest.double().cpu().numpy()
        used = np.flatnonzero((cage.vertex_area > 0).cpu().numpy())
        pairs = self._pairs(coarse.double().cpu().numpy(), used, self._garment, self._rest)
        self.sewn = np.zeros(cage.vertex_count, bool)
        self.sewn[pairs.reshape(-1)] = True
        self._terms: dict[int, tuple[Seam, np.ndarray] | None] = {}

    @staticmethod
    def find(cage: Level, coarse: Float[Tensor, "coarse 3"], stretch: float) -> Seams | None:
        """The seams of a frame, or None when there are none; arguments as for the class."""
        seams = Seams(cage, coarse, stretch)
        return seams if seams.sewn.any() else None

    def term(self, level: Level, base: Float[Tensor, "vertices 3"]) -> Seam | None:
        """The springs of a level, or None without seams; ``base`` is the upsampled cage [m]."""
        found = self._of(level, base)
        return None if found is None else found[0]

    def close(
        self, level: Level, base: Float[Tensor, "vertices 3"], x: Float[Tensor, "vertices 3"]
    ) -> Float[Tensor, "vertices 3"]:
        """Bring what is sewn together: to its mean, or to what may not move."""
        found = self._of(level, base)
        if found is None:
            return x
        count = level.vertex_count
        joined = sp.coo_matrix((np.ones(len(found[1]), bool), tuple(found[1].T)), shape=(count, count))
        label = csgraph.connected_components(joined, directed=False)[1]
        weight = np.where(level.free[:, 0].cpu().numpy(), 1.0, 1e9)
        total = np.bincount(label, weight)
        points = x.double().cpu().numpy()
        mean = np.stack([np.bincount(label, weight * points[:, axis]) / total for axis in range(3)], axis=1)[label]
        sewn = np.unique(found[1])
        out = x.clone()
        place = torch.as_tensor(sewn, device=x.device)
        out[place] = torch.where(level.free[place], torch.as_tensor(mean[sewn]).to(x), x[place])
        return out

    def _of(self, level: Level, base: Tensor) -> tuple[Seam, np.ndarray] | None:
        if level.index not in self._terms:
            # A fine point lies on a seam if all that it is made of does.
            share = np.asarray(level.from_coarse @ self.sewn.astype(np.float64)).ravel()
            which = np.flatnonzero(share > 1.0 - 1e-9)
            garment, rest = level.vertex_garment.cpu().numpy(), level.rest.double().cpu().numpy()
            pairs = self._pairs(base.double().cpu().numpy(), which, garment, rest)
            ends = torch.as_tensor(pairs, device=level.rest.device)
            self._terms[level.index] = (Seam(ends, self._stiffness), pairs) if len(pairs) else None
        return self._terms[level.index]

    def _pairs(self, points: np.ndarray, which: np.ndarray, garment: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """Pairs of some points at one place, shape (N, 2)."""
        finite = which[np.isfinite(points[which]).all(axis=1)]
        if len(finite) < 2:
            return np.zeros((0, 2), np.int64)
        pairs = finite[cKDTree(points[finite]).query_pairs(self._near, output_type="ndarray")].reshape(-1, 2)
        apart = garment[pairs[:, 0]] != garment[pairs[:, 1]]
        at_rest = np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1) < self._near
        return pairs[apart | at_rest]
