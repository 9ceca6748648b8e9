"""What no solve moves: fixed vertices, which the cage places, and corners of faces without area, which follow cloth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from ..level import PIN_MARGIN, Level, Placed
from ..mesh.topology import PolygonMesh

NEAREST = 1e-6
"""Distance under which points count as at one place, in edge lengths."""


class Followers:
    """Fixed vertices, and corners of faces without area, which move with what lies beside them, by nearness."""

    def __init__(self, level: Level, meshes: Sequence[PolygonMesh]) -> None:
        """Find them at a level; ``meshes`` are its garments' polygons."""
        parts = zip(meshes, level.spans, strict=True)
        edges = np.concatenate([mesh.half_edges.edges.astype(np.int64) + span.start for mesh, span in parts])
        ends = np.concatenate([edges, edges[:, ::-1]])
        idle = ((level.vertex_area == 0) & (level.pin < 1.0 - PIN_MARGIN)).cpu().numpy()
        ends = ends[idle[ends[:, 0]] & (ends[:, 0] != ends[:, 1])]
        self._which, row = np.unique(ends[:, 0], return_inverse=True)
        rest = level.rest.double().cpu().numpy()
        length = np.linalg.norm(rest[ends[:, 0]] - rest[ends[:, 1]], axis=1)
        near = 1.0 / np.maximum(length, NEAREST * float(level.spacing.mean()))
        beside = sp.csr_matrix((near, (row, ends[:, 1])), shape=(len(self._which), level.vertex_count))
        # What hangs together with no cloth at all stays: the margin makes its matrix one that can be inverted.
        degree = sp.diags(np.bincount(row, near, len(self._which)) * (1.0 + 1e-9))
        self._inverse = splu(sp.csc_matrix(degree - beside[:, self._which])) if len(row) else None
        self._fixed = np.flatnonzero(~level.free.cpu().numpy().ravel())
        self._place_fixed = sp.csr_matrix(level.from_coarse[self._fixed])
        self._beside, self._from_coarse = sp.csr_matrix(beside @ sp.diags(1.0 - idle)), level.from_coarse

    def placed(self, x: Placed, origin: np.ndarray, coarse: np.ndarray) -> np.ndarray:
        """World positions [m], shape (V, 3), of which these are placed by the cage's and by the others.

        Fixed vertices are the upsampled cage's own; a corner is moved off it as its neighbours are on the mean.

        Args:
            x: Where the cloth is, about the origin [m].
            origin: World position [m], shape (3,).
            coarse: The cage's world positions [m], shape (C, 3).
        """
        out = x.double().cpu().numpy() + origin
        out[self._fixed] = self._place_fixed @ coarse
        if self._inverse is not None:
            base = self._from_coarse @ coarse
            out[self._which] = base[self._which] + self._inverse.solve(self._beside @ (out - base))
        return out
