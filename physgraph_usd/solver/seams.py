"""Seams that welding cannot close: of two garments, of three sheets, and of borders with unequal resolution."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .forces.seam import Seam
from .level import Level
from .mesh.borders import OnEdge, finer_side, nearest_edges
from .mesh.topology import find_edges
from .mesh.weld import AT_ONE_PLACE, pairs_within
from .scene import Garment


def level_seams(levels: Sequence[Level], garments: Sequence[Garment]) -> list[Seam | None]:
    """The seam of each level, None where nothing is sewn; garments as `Garment.sewn_at` has them."""
    places = [np.full((len(g.rest), 3), np.nan) if g.sewn_at is None else g.sewn_at for g in garments]
    sewn_at = np.concatenate(places) if places else np.zeros((0, 3))
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
    within = AT_ONE_PLACE * float(level.spacing.mean())
    pairs = pairs_within([points], np.flatnonzero(on_seam), within)
    alone = on_seam.copy()
    alone[pairs] = False
    between = _between(level, points, on_seam, np.flatnonzero(alone), within)
    return Seam(level, pairs, between) if len(pairs) or len(between.vertex) else None


def _between(level: Level, points: np.ndarray, on_seam: np.ndarray, alone: np.ndarray, within: float) -> OnEdge:
    """Border vertices between the vertices of another border, with the edge under each."""
    edges, triangles = (each.cpu().numpy().astype(np.int64) for each in (level.edges, level.triangles))
    sides = find_edges(edges, triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))
    border = edges[np.bincount(sides, minlength=len(edges)) == 1]
    border = border[on_seam[border].all(axis=1)]
    return finer_side(points, border, nearest_edges(points, alone, border, np.full(len(alone), within)))
