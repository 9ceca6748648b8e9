"""Points that the input has at one place: garments that meet at a seam, or one whose mesh is cut along it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from ..forces.seam import Seam
from ..level import Level

AT_ONE_PLACE = 1e-3
"""Distance under which points are at one place, in mean cage edges."""


class Seams:
    """The seams of one frame."""

    def __init__(self, cage: Level, coarse: Float[Tensor, "coarse 3"]) -> None:
        """Find cage points at one place, in this frame and, of one garment, at rest too.

        Args:
            cage: The cage.
            coarse: Its positions [m].
        """
        self._near = AT_ONE_PLACE * float(cage.spacing.mean())
        self._garment, self._rest = cage.vertex_garment.cpu().numpy(), cage.rest.double().cpu().numpy()
        used = np.flatnonzero((cage.vertex_area > 0).cpu().numpy())
        pairs = self._pairs(coarse.double().cpu().numpy(), used, self._garment, self._rest)
        self.sewn = np.zeros(cage.vertex_count, bool)
        self.sewn[pairs.reshape(-1)] = True
        self._levels: dict[int, Seam | None] = {}

    @staticmethod
    def find(cage: Level, coarse: Float[Tensor, "coarse 3"]) -> Seams | None:
        """The seams of a frame, or None when there are none; arguments as for the class."""
        seams = Seams(cage, coarse)
        return seams if seams.sewn.any() else None

    def at(self, level: Level, base: Float[Tensor, "vertices 3"]) -> Seam | None:
        """What is sewn at a level, or None where nothing is; ``base`` is the upsampled cage [m]."""
        if level.index not in self._levels:
            # A fine point lies on a seam if all that it is made of does; one without area is no cloth to sew.
            share = np.asarray(level.from_coarse @ self.sewn.astype(np.float64)).ravel()
            which = np.flatnonzero((share > 1.0 - 1e-9) & (level.vertex_area > 0).cpu().numpy())
            garment, rest = level.vertex_garment.cpu().numpy(), level.rest.double().cpu().numpy()
            pairs = self._pairs(base.double().cpu().numpy(), which, garment, rest)
            self._levels[level.index] = Seam(level, pairs) if len(pairs) else None
        return self._levels[level.index]

    def _pairs(self, points: np.ndarray, which: np.ndarray, garment: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """Pairs of some points at one place, shape (N, 2)."""
        finite = which[np.isfinite(points[which]).all(axis=1)]
        if len(finite) < 2:
            return np.zeros((0, 2), np.int64)
        pairs = finite[cKDTree(points[finite]).query_pairs(self._near, output_type="ndarray")].reshape(-1, 2)
        apart = garment[pairs[:, 0]] != garment[pairs[:, 1]]
        at_rest = np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1) < self._near
        return pairs[apart | at_rest]
