"""How crowded cages are in a frame: what decides how long it takes to solve, measured before anything is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from ..collide.crossings import crossings
from ..collide.parts import Parts
from ..colliders.sign import signed_distances
from ..level import build_levels
from ..mesh.kernels import start_warp
from ..scene import Frame, Garment, GarmentFrame, Scene
from .broad_phase import Bodies, bounds_of, reach_of, touch_one_another

APART = 2.5
"""Mean edges that two vertices are apart at rest, from which they count as near within one edge."""


@dataclass(frozen=True)
class Crowding:
    """How crowded the cages of a frame are.

    Attributes:
        crossings: Edges through faces of cloth, over the vertices.
        near: Share of the vertices that are within an edge of another garment, or of cloth that is not at rest.
        inside: Share of the vertices inside a body.
        touches: Whether any vertex is inside a body or as near as the cloth stays to it and half an edge more.
    """

    crossings: float = 0.0
    near: float = 0.0
    inside: float = 0.0
    touches: bool = False


class CrowdingMeter:
    """Measures the frames of one scene."""

    def __init__(self, scene: Scene) -> None:
        """Gather the cages, which together are one level."""
        start_warp()
        self._scene = scene
        self._level = build_levels(list(scene.garments), [()] * len(scene.garments))[0]
        feel = [[a is b or touch_one_another(a, b) for b in scene.garments] for a in scene.garments]
        self._parts = Parts(self._level, np.array(feel, dtype=bool))
        self._bodies = Bodies(scene.colliders, device="cpu", threads=1)

    def measure(self, frame: Frame) -> Crowding:
        """How crowded a frame is."""
        points = np.concatenate([own.points for own in frame.garments])
        if not len(points):
            return Crowding()
        centred = points - points.mean(axis=0)
        crossing = crossings(self._parts, torch.as_tensor(centred)).count / len(points)
        distance = self._distances(frame)
        inside = float((distance < 0).mean())
        return Crowding(crossing, self._near(centred), inside, bool((distance < 0.5 * self._edge()).any()))

    def _edge(self) -> float:
        """Mean edge at rest [m]."""
        return float(self._level.rest_length.mean()) if len(self._level.rest_length) else 0.0

    def _near(self, points: np.ndarray) -> float:
        """Share of vertices that cloth came near which is apart at rest."""
        edge, rest = self._edge(), self._level.rest.double().numpy()
        pairs = cKDTree(points).query_pairs(edge, output_type="ndarray")
        folded = np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1) > APART * edge
        owner = self._level.vertex_garment.numpy()
        folded |= owner[pairs[:, 0]] != owner[pairs[:, 1]]
        return len(np.unique(pairs[folded])) / len(points)

    def _distances(self, frame: Frame) -> np.ndarray:
        """Distance of each vertex to the nearest body less the offset that it keeps [m], at least -its depth."""
        self._bodies.pose(frame.colliders)
        found = [self._of(garment, own) for garment, own in zip(self._scene.garments, frame.garments, strict=True)]
        return np.concatenate(found)

    def _of(self, garment: Garment, own: GarmentFrame) -> np.ndarray:
        """Distances of one garment's vertices, as `_distances` gives them."""
        least = np.full(len(own.points), np.inf)
        near = self._bodies.near(garment, bounds_of(own.points), reach_of(garment, own))
        edges = torch.as_tensor(garment.mesh.half_edges.edges)
        for each in self._bodies.touching(near, [[0.0] * len(near)]):
            at = torch.as_tensor(own.points - each.surface.origin)
            signed = signed_distances(each.surface, at, edges, reach=reach_of(garment, own)).numpy()
            least = np.minimum(least, np.where(signed > 0, np.maximum(signed - own.offset, 1e-12), signed))
        return least
