"""Frames that break: a sheet over a ball, refined from frame to frame while one frame is scaled, shifted or turned."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh

from physgraph_usd.errors import PhysGraphError
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.colliders.pose import Collider, MeshPose
from physgraph_usd.solver.fabric import PRESETS
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.scene import Frame, Garment, GarmentFrame, Scene


@dataclass(frozen=True)
class SheetOverBall:
    """A sheet of quads with an edge [m], and a ball of a radius [m] whose top is at the origin."""

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
        """The sheet bent over the ball, at a height above it [m], and flared with folds turned by a phase [rad]."""
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


BEFORE = 5
"""Clean frames before the broken one."""
SHEET = SheetOverBall(side=24, edge=0.025, radius=0.15)
DRIFT = np.array([1e-6, 0.0, 0.0])
"""Of a held cage, a frame [m]: equal frames would be taken over as they are."""
Glitch = Callable[[Frame], Frame]


def _cage(change: Callable[[np.ndarray], np.ndarray]) -> Glitch:
    def broken(frame: Frame) -> Frame:
        return replace(frame, garments=tuple(replace(each, points=change(each.points)) for each in frame.garments))

    return broken


def _ball(change: Callable[[np.ndarray], np.ndarray]) -> Glitch:
    def broken(frame: Frame) -> Frame:
        poses = [MeshPose(change(p.points), p.triangles) for p in frame.colliders if isinstance(p, MeshPose)]
        return replace(frame, colliders=tuple(poses))

    return broken


def _scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda points: points.mean(axis=0) + factor * (points - points.mean(axis=0))


GLITCHES: dict[str, Glitch] = {
    "ball eight times its size": _ball(_scaled(8.0)),
    "ball four times its size": _ball(_scaled(4.0)),
    "ball 10 cm higher": _ball(lambda points: points + np.array([0.0, 0.1, 0.0])),
    "ball gone to one point": _ball(_scaled(0.0)),
    "cage inside out": _cage(lambda points: points * np.array([1.0, -1.0, 1.0])),
    "cage in one point": _cage(_scaled(0.0)),
    "cage a hundred times its size": _cage(_scaled(100.0)),
    "cage 10 cm aside": _cage(lambda points: points + np.array([0.1, 0.0, 0.0])),
}
"""What happens to the broken frame."""


def run(
    level: int, after: int, *, travel: float, glitch: Glitch | None = None, at: int = BEFORE, first: int = 0
) -> list[tuple[np.ndarray, dict[str, Any]]]:
    """Fine positions [m] and telemetry of frames in order, one of them broken; where one failed those before it."""
    scene, ball = SHEET.scene(subdivisions=4)
    refiner = Refiner(scene, RefineOptions().solve_settings(), levels=[level], threads=2)
    told: list[tuple[np.ndarray, dict[str, Any]]] = []
    for index in range(first, at + 1 + after):
        points = SHEET.draped(0.002, travel * index) + index * DRIFT
        frame = Frame(float(index), (GarmentFrame(points, PRESETS["jersey"]),), (ball,))
        frame = glitch(frame) if glitch is not None and index == at else frame
        try:
            state = refiner.solve(frame)
        except PhysGraphError:
            told.append(told[-1] if told else (points, {}))
            continue
        assert state.points[0] is not None
        told.append((state.points[0], dict(state.telemetry[0])))
    return told
