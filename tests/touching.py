"""Scenes of one sheet over one body, without a stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from cloth import DOWN, FABRIC, GUIDE, settings_of
from sheets import garment_of

from physgraph_usd.solver.colliders.pose import Collider, MeshPose, Pose
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.scene import Frame, GarmentFrame, Scene, State

Cloth = tuple[PolygonMesh, np.ndarray]


def refiner(
    cloth: Cloth,
    kinds: Sequence[str] = ("mesh",),
    *,
    felt: Sequence[int] | None = None,
    side: str = "auto",
    form: str = "quadratic",
    pin: np.ndarray | None = None,
    gravity: np.ndarray = DOWN,
    level: int = 2,
    dtype: torch.dtype = torch.float32,
    **options: Any,
) -> Refiner:
    """A refiner of one sheet that feels some colliders, all by default."""
    mesh, rest = cloth
    feels = tuple(range(len(kinds)) if felt is None else felt)
    garment = replace(garment_of(mesh, rest, pin=np.zeros(mesh.vertex_count) if pin is None else pin), colliders=feels)
    colliders = tuple(Collider(f"/World/Body{index}", kind, side=side) for index, kind in enumerate(kinds))
    settings = settings_of(contact=ContactSettings(form), **options)
    return Refiner(Scene((garment,), gravity, (), colliders), settings, levels=[level], dtype=dtype)


def frame(points: np.ndarray, *poses: Pose | None, time: float | None = None, offset: float = 0.002) -> Frame:
    """The sheet and its bodies at one time code."""
    return Frame(time, (GarmentFrame(points, FABRIC, GUIDE, offset=offset),), poses)


def mesh_pose(soup: tuple[np.ndarray, np.ndarray]) -> MeshPose:
    """A body of triangles."""
    return MeshPose(*soup)


def measured(state: State, which: str = "after", body: int = 0) -> dict[str, Any]:
    """What was measured against one body, before or after."""
    bodies: dict[str, Any] = state.telemetry[0]["contact"]["bodies"]  # type: ignore[index]
    return list(bodies.values())[body][which]
