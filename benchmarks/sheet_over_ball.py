"""A square sheet that lies over one ball: the scene of several benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from physgraph_usd.solver.colliders.pose import Collider, MeshPose
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.scene import Garment, Scene


@dataclass(frozen=True)
class SheetOverBall:
    """The sheet and the ball.

    Attributes:
        side: Quads along an edge of the cage.
        edge: Length of a quad [m].
        radius: Of the ball, whose top is at the origin [m].
    """

    side: int
    edge: float
    radius: float

    def scene(self, *, subdivisions: int) -> tuple[Scene, MeshPose]:
        """The sheet, which feels the ball, and the ball with so many subdivisions of an icosahedron."""
        ids = np.arange((self.side + 1) ** 2).reshape(self.side + 1, self.side + 1)
        quads = np.stack([ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]], axis=-1).reshape(-1, 4)
        one = np.ones(ids.size)
        mesh = PolygonMesh(np.full(len(quads), 4), quads.ravel(), ids.size)
        garment = Garment("/Sheet", mesh, self._flat(), 2, False, one, one, one, one, 0.0 * one, colliders=(0,))
        ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=self.radius)
        points = np.asarray(ball.vertices) - np.array([0.0, self.radius, 0.0])
        scene = Scene((garment,), np.array([0.0, -9.81, 0.0]), (), (Collider("/Ball", "mesh"),))
        return scene, MeshPose(points, np.asarray(ball.faces, np.int32))

    def draped(self, height: float, phase: float = 0.0) -> np.ndarray:
        """The sheet bent over the ball and flared with folds outside it.

        Args:
            height: Of its middle above the ball [m].
            phase: Angle by which the folds are turned [rad].

        Returns:
            Positions [m], shape (V, 3).
        """
        flat = self._flat()
        radius, angle = np.hypot(flat[:, 0], flat[:, 2]), np.arctan2(flat[:, 2], flat[:, 0])
        bend, beyond = np.minimum(radius / self.radius, 1.2), np.maximum(radius - 1.2 * self.radius, 0.0)
        out = self.radius * np.sin(bend) + 0.3 * beyond * (1.0 + 0.2 * np.cos(9 * (angle - phase)))
        down = self.radius * (np.cos(bend) - 1.0) - 0.9 * beyond
        return np.stack([out * np.cos(angle), down + height, out * np.sin(angle)], axis=1)

    def _flat(self) -> np.ndarray:
        axis = self.edge * (np.arange(self.side + 1) - 0.5 * self.side)
        x, z = np.meshgrid(axis, axis)
        return np.stack([x, 0.0 * x, -z], axis=-1).reshape(-1, 3)
