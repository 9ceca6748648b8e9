"""Finds seams of a shot not closed by welding, and adjacent borders not sewn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ...solver.mesh.borders import OnEdge, finer_side, nearest_edges, open_edges
from ...solver.mesh.topology import joined_by
from ...solver.mesh.weld import pairs_within, seam_reach
from ...solver.scene import Garment
from ..stage import Notice

POSES = 10
"""Number of frames, spread over the shot, in which sewn points must coincide."""
BESIDE = 0.1
"""Distance below which two borders count as adjacent, in border edges."""
LONG = 4
"""Fewest adjacent border edges for a warning."""
Cages = Sequence[np.ndarray | None]
"""World positions of each garment [m] in one frame; None for an absent garment."""


def sewn_garments(
    garments: Sequence[Garment], tolerances: Sequence[float], poses: Callable[[int], Iterator[Cages]]
) -> tuple[list[Garment], list[Notice]]:
    """Garments with the positions of their sewn vertices, and notices of adjacent unsewn borders.

    Vertices of different garments are sewn if coincident in every pose; vertices of the same garment must also coincide
    in the rest shape; on an edge, within a border edge there.

    Args:
        garments: The garments, welded.
        tolerances: Seam tolerance of each garment [m], as in `seam_reach`.
        poses: Cages in at most the given number of frames.
    """
    first = next(poses(1), None)
    if first is None:
        return [*garments], []
    pieces = zip(garments, first, tolerances, strict=True)
    reaches = [0.0 if x is None else seam_reach(garment.mesh, x, tolerance) for garment, x, tolerance in pieces]
    cloth = _Cloth(garments, reaches)
    points = cloth.together(first)
    pairs, between, beside = cloth.look(points)
    if not len(pairs) and not len(between.vertex) and not len(beside.vertex):
        return [*garments], []
    for cages in poses(POSES):
        at = cloth.together(cages)
        apart = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1) > cloth.reach(*pairs.T)
        pairs = pairs[~apart]
        between = between.where(~(between.at(at).distance > cloth.reach(between.vertex, between.edge[:, 0])))
        away = beside.at(at).distance > BESIDE * cloth.edge_at(at, beside.vertex)
        beside = beside.where(~away)
    return cloth.sewn(points, pairs, between), cloth.notices(points, beside)


class _Cloth:
    """All garments of a shot combined; vertices are numbered consecutively."""

    def __init__(self, garments: Sequence[Garment], reaches: Sequence[float]) -> None:
        self._garments = garments
        self._starts = np.cumsum([0, *(len(garment.rest) for garment in garments)])
        self._owner = np.repeat(np.arange(len(garments)), np.diff(self._starts))
        self._reach = np.asarray(reaches)[self._owner]
        self._rest = np.concatenate([garment.rest for garment in garments])
        meshes = [(garment.mesh, self._starts[index]) for index, garment in enumerate(garments)]
        self._borders = np.concatenate([open_edges(mesh) + start for mesh, start in meshes])
        self._used = np.concatenate([np.unique(mesh.indices) + start for mesh, start in meshes])

    def together(self, cages: Cages) -> np.ndarray:
        """World positions of all vertices [m], NaN for absent garments."""
        none = [np.full((len(garment.rest), 3), np.nan) for garment in self._garments]
        return np.concatenate([blank if cage is None else cage for cage, blank in zip(cages, none, strict=True)])

    def reach(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Distance within which pairs of vertices are sewn [m]."""
        return np.maximum(self._reach[first], self._reach[second])

    def edge_at(self, points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Length of the shortest border edge at each vertex [m]."""
        length = np.linalg.norm(points[self._borders[:, 0]] - points[self._borders[:, 1]], axis=1)
        shortest = np.full(len(points), np.inf)
        np.minimum.at(shortest, self._borders, length[:, None])
        return shortest[vertices]

    def look(self, points: np.ndarray) -> tuple[np.ndarray, OnEdge, OnEdge]:
        """Pairs of coincident vertices, border vertices on an edge of another border, and those beside an edge."""
        pairs = pairs_within([points], self._used, float(self._reach.max(initial=0.0)))
        are_near = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) <= self.reach(*pairs.T)
        pairs = pairs[are_near & self._rest_together(pairs)]
        is_finite = np.asarray(np.isfinite(points).all(axis=1))
        borders = self._borders[is_finite[self._borders].all(axis=1)]
        unpaired = np.setdiff1d(borders, pairs)
        near = nearest_edges(points, unpaired, borders, BESIDE * self.edge_at(points, unpaired))
        on = near.distance <= self.reach(near.vertex, near.edge[:, 0])
        return pairs, near.where(on & self._rest_on(near)), near.where(~on)

    def _rest_together(self, pairs: np.ndarray) -> np.ndarray:
        apart = self._owner[pairs[:, 0]] != self._owner[pairs[:, 1]]
        return apart | (
            np.linalg.norm(self._rest[pairs[:, 0]] - self._rest[pairs[:, 1]], axis=1) <= self.reach(*pairs.T)
        )

    def _rest_on(self, near: OnEdge) -> np.ndarray:
        """Whether vertices are of another garment, or at rest within a border edge: a fitted rest shape moves them."""
        apart = self._owner[near.vertex] != self._owner[near.edge[:, 0]]
        within = np.maximum(self.reach(near.vertex, near.edge[:, 0]), self.edge_at(self._rest, near.vertex))
        return apart | (near.at(self._rest).distance <= within)

    def sewn(self, points: np.ndarray, pairs: np.ndarray, between: OnEdge) -> list[Garment]:
        """Garments with the closed positions of their sewn vertices: the mean of a pair, or a point on an edge."""
        between = finer_side(points, self._borders, between)
        group = joined_by(pairs, len(points)) if len(pairs) else np.arange(len(points))
        sums, count = np.zeros((group.max(initial=-1) + 1, 3)), np.bincount(group)
        np.add.at(sums, group, points)
        closed = (sums / count[:, None])[group]
        out = np.full_like(points, np.nan)
        for used in (pairs.ravel(), between.edge.ravel()):
            out[used] = closed[used]
        out[between.vertex] = between.place(closed)
        pieces = zip(self._garments, np.split(out, self._starts[1:-1]), strict=True)
        return [replace(piece, sewn_at=at) if np.isfinite(at).any() else piece for piece, at in pieces]

    def notices(self, points: np.ndarray, beside: OnEdge) -> list[Notice]:
        """A notice of each garment with a border adjacent to another border and not sewn."""
        matches = []
        is_matched = np.zeros(len(points), bool)
        is_matched[beside.vertex] = True
        distance = np.zeros(len(points))
        distance[beside.vertex] = beside.distance
        partner = np.full(len(points), -1)
        partner[beside.vertex] = self._owner[beside.edge[:, 0]]
        along = self._borders[is_matched[self._borders].all(axis=1)]
        for index, garment in enumerate(self._garments):
            own_edges = along[self._owner[along[:, 0]] == index]
            if len(own_edges) < LONG:
                continue
            length = float(np.linalg.norm(points[own_edges[:, 0]] - points[own_edges[:, 1]], axis=1).sum())
            gap = float(distance[own_edges].max())
            partners = {self._garments[number].path for number in partner[own_edges].ravel().tolist()} - {garment.path}
            partner_names = "one another" if not partners else " and ".join(f"<{path}>" for path in sorted(partners))
            message = f"borders run along {partner_names} for {length:.3g} m, at most {1e3 * gap:.2g} mm apart"
            message += ", and are not sewn"
            matches.append(Notice(garment.path, None, f"{message}; sew them with --set seam:tolerance={1.5 * gap:.2g}"))
        return matches
