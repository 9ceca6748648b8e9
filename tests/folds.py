"""Sheets folded, rolled and crumpled onto themselves, and scenes of several garments, without a stage."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from cloth import DOWN, FABRIC, GUIDE, Answer, Solver, settings_of
from meshes import grid
from sheets import garment_of

from physgraph_usd.solver.collide.distance import weights
from physgraph_usd.solver.collide.pairs import Reach
from physgraph_usd.solver.collide.parts import Parts
from physgraph_usd.solver.collide.search import near_parts
from physgraph_usd.solver.colliders.pose import Collider, Pose
from physgraph_usd.solver.contact.cloth import ClothContact, LevelContact
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.contact.springs import NearSprings
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.forces.seam import Seam
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.level import Level, build_levels, refine_garments
from physgraph_usd.solver.mesh.topology import PolygonMesh
from physgraph_usd.solver.scene import Frame, Garment, GarmentFrame, Scene
from physgraph_usd.usd.read.seams import sewn_garments

EDGE = 0.05
LEVEL_TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
Cloth = tuple[PolygonMesh, np.ndarray]


def square(cells: int = 4, *, edge: float = EDGE, kind: str = "triangles") -> Cloth:
    """A square sheet about the origin, in the plane of x and z, its front down."""
    mesh, points = grid(cells, cells, kind)
    return mesh, edge * (points - points.mean(axis=0)) @ LEVEL_TURN.T


def strip(length: int = 16, width: int = 4, *, edge: float = EDGE) -> Cloth:
    """A long sheet from x = 0, level, its front up."""
    mesh, points = grid(length, width, "triangles")
    return mesh, edge * (points - [0.0, 0.5 * width, 0.0]) @ LEVEL_TURN.T


def flat(points: np.ndarray) -> np.ndarray:
    return points


def curved(points: np.ndarray, turn: float = 1.0) -> np.ndarray:
    """Bent about z so that both ends together turn by an angle [rad]."""
    radius = np.ptp(points[:, 0]) / turn
    angle = points[:, 0] / radius
    return np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), points[:, 2]], axis=1)


def folded(points: np.ndarray, gap: float = 0.01) -> np.ndarray:
    """Laid back over itself at a third of its length, a gap apart."""
    middle, radius = points[:, 0].min() + 0.4 * np.ptp(points[:, 0]), 0.5 * gap
    past = points[:, 0] - middle
    angle = (past / radius).clip(0.0, np.pi)
    back = (past - np.pi * radius).clip(0.0)
    x = np.where(past > 0, middle + radius * np.sin(angle) - back, points[:, 0])
    return np.stack([x, radius * (1 - np.cos(angle)), points[:, 2]], axis=1)


def rolled(points: np.ndarray, pitch: float = 0.02, inner: float = 0.04) -> np.ndarray:
    """Rolled up along x into a spiral whose turns are a pitch apart."""
    along = points[:, 0] - points[:, 0].min()
    slope = pitch / (2 * np.pi)
    angle = (np.sqrt(inner**2 + 2 * slope * along) - inner) / slope
    radius = inner + slope * angle
    return np.stack([radius * np.sin(angle), -radius * np.cos(angle), points[:, 2]], axis=1)


def crumpled(points: np.ndarray, seed: int = 0, *, size: float = 0.35) -> np.ndarray:
    """Pressed together along x and z and waved at random, so that it passes through itself in places."""
    rng = np.random.default_rng(seed)
    out = points * np.array([size, 1.0, size])
    for wave in rng.normal(size=(6, 3)) * 30.0:
        out = out + 0.15 * EDGE * rng.normal(size=3) * np.sin(points @ wave + rng.uniform(0, 6))[:, None] * 4
    return out + 0.1 * EDGE * rng.normal(size=points.shape)


SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "folded": folded,
    "rolled": rolled,
    "rolled through itself": lambda points: rolled(points, 0.004) + 0.01 * np.sin(60 * points[:, [2, 0, 0]]),
    "crumpled": crumpled,
    "crumpled more": lambda points: crumpled(points, 3, size=0.2),
}


def named(cloth: Cloth, name: str = "Sheet", **fields: Any) -> Garment:
    return replace(garment_of(*cloth), path=f"/World/{name}", **fields)


def levels_of(*garments: Garment, level: int = 1, dtype: torch.dtype = torch.float32) -> tuple[Level, ...]:
    return build_levels(garments, refine_garments(garments, [level] * len(garments)), dtype=dtype)


def fine(levels: Sequence[Level], *points: np.ndarray) -> torch.Tensor:
    """Cages placed linearly at the finest level."""
    level = levels[-1]
    return level.base.apply(torch.as_tensor(np.concatenate(points), dtype=level.dtype))


def placed(level: Level, shape: Callable[[np.ndarray], np.ndarray], rest: torch.Tensor | None = None) -> torch.Tensor:
    """A level's own rest positions bent into a shape, so that fine folds are fine."""
    points = (level.rest if rest is None else rest).double().numpy()
    return torch.as_tensor(shape(points), dtype=level.dtype)


def view_of(
    levels: Sequence[Level],
    garments: Sequence[Garment],
    *,
    thickness: float = 0.001,
    stiffness: float = 1e5,
    form: str = "pairs",
    seam: Seam | None = None,
) -> LevelContact:
    """The finest level's contact in a frame."""
    lasting = ClothContact(levels, garments)
    each = torch.full((len(garments),), thickness, dtype=levels[-1].dtype)
    settings = ContactSettings(cloth=form, stiffness=stiffness)
    base = levels[-1].base.apply(levels[0].rest)
    base = base + 1e3 * levels[-1].vertex_garment.unsqueeze(1)  # The input has no two garments near one another.
    given = {"base": base, "thickness": each, "settings": settings, "seam": seam}
    return LevelContact(lasting, levels[-1], **given, doubtful=levels[-1].free[:, 0] | True)


def sewn(garments: Sequence[Garment], *cages: np.ndarray) -> list[Garment]:
    """Garments whose vertices at one place in these cages are sewn."""
    return sewn_garments(garments, [1e-3 * EDGE] * len(garments), lambda _: iter([cages]))[0]


def refiner_with(
    garments: Sequence[Garment],
    kinds: Sequence[str] = (),
    *,
    side: str = "auto",
    level: int = 1,
    gravity: np.ndarray = DOWN,
    contact: ContactSettings | None = None,
    times: Sequence[float] = (),
    dtype: torch.dtype = torch.float32,
    **options: Any,
) -> Solver:
    """A refiner of garments that feel every collider, and one another."""
    feel = [replace(garment, colliders=tuple(range(len(kinds)))) for garment in garments]
    colliders = tuple(Collider(f"/World/Body{index}", kind, side=side) for index, kind in enumerate(kinds))
    settings = settings_of(contact=contact or ContactSettings(), **options)
    scene = Scene(tuple(feel), gravity, tuple(times), colliders)
    return Solver(Refiner(scene, settings, levels=[level] * len(feel), dtype=dtype))


def frame_with(
    cages: Sequence[np.ndarray],
    *poses: Pose | tuple[np.ndarray, np.ndarray] | None,
    time: float | None = None,
    fabric: Fabric = FABRIC,
    guide: float = GUIDE,
    offset: float = 0.002,
) -> Frame:
    """Several garments and bodies, or soups of triangles, at one time code."""
    bodies = tuple(Pose(*pose) if isinstance(pose, tuple) else pose for pose in poses)
    return Frame(time, tuple(GarmentFrame(cage, fabric, guide, offset=offset) for cage in cages), bodies)


def measured(answer: Answer, which: str = "after", body: int = 0) -> dict[str, Any]:
    """What was measured against one body, before or after."""
    return list(answer.telemetry[0]["contact"]["bodies"].values())[body][which]


def near_pairs(parts: Parts, x: torch.Tensor, near: Reach) -> NearSprings:
    """The pairs found near one another, with their shortest vectors, without those that only rest distances let in."""
    at, pairs = x.double(), near_parts(parts, x, near).pairs
    weight, corners = weights(at, pairs.corners, pairs.face), pairs.corners.long()
    way, radius = (weight.unsqueeze(2) * at[corners]).sum(dim=1), near.radius[corners]
    of_face = radius[:, 0] + radius[:, 1:].amax(dim=1)
    of_edges = radius[:, :2].amax(dim=1) + radius[:, 2:].amax(dim=1)
    kept = torch.nonzero(way.norm(dim=1) < torch.where(pairs.face, of_face, of_edges)).squeeze(1)
    of_kept = (weight[kept].to(x), way[kept].to(x), pairs.face[kept], radius.new_zeros(len(kept)))
    return NearSprings(pairs.corners[kept], *of_kept)
