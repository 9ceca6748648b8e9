"""Penetrations and crossings: of a frame before and after the solve for reports, and per vertex for heat maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.crossings import Crossings, all_crossings, crossings
from ..colliders.mesh import MeshSurface
from ..level import Level
from .bodies import LevelBodies
from .cloth import ContactState, LevelContact
from .cloth_mesh import ClothMesh
from .measure import Penetration, depths, penetration


def measured(
    view: LevelContact,
    before: Float[Tensor, "vertices 3"],
    x: Float[Tensor, "vertices 3"],
    *,
    smooth: Float[Tensor, "vertices 3"],
) -> tuple[dict[str, object], Bool[Tensor, " vertices"]]:
    """Penetrations and crossings before and after, and a mask of the vertices of crossing cloth after.

    Positions reached by safe moves from a start without crossings have no crossings and are not searched again.

    Args:
        view: The finest level's cloth.
        before: The upsampled cage [m].
        x: The result [m].
        smooth: The smoothly subdivided cage [m], measured as "before" if the result has more faults than the upsampled
            cage: cloth may follow it, and tangled cages cross a little more or less often when smooth.
    """
    first, last = view.at_base if torch.equal(before, view.at_base.x) else view.of_cage(before), view.look(x)
    contours = last.hopeful if view.given_up is None else crossings(view.mesh.parts, x)
    base = _crossed_before(view, first)
    if contours.count + sum(last.in_bodies) > base.count + sum(first.in_bodies):
        before, first = smooth, view.detect(smooth)
        base = _crossed_before(view, first)
    figures: dict[str, object] = {}
    if view.bodies is not None:
        figures["bodies"] = _of_bodies(view.bodies, before, first, x, last)
    if view.keeps_sides:
        crossed = {
            name: {"crossings": state.count, "between_garments": int(np.triu(view.mesh.between(state), 1).sum())}
            for name, state in (("before", base), ("after", contours))
        }
        crossed["after"]["given_up"] = contours.count - last.hopeful.count
        near = bool(view.came_near) or any(state["crossings"] for state in crossed.values())
        figures["cloth"] = {"near": near, **crossed}
    return figures, view.mesh.crossed(contours)


def _crossed_before(view: LevelContact, state: ContactState) -> Crossings:
    return state.crossings if view.given_up is None else crossings(view.mesh.parts, state.x)


def _of_bodies(
    bodies: LevelBodies, before: Tensor, first: ContactState, x: Tensor, last: ContactState
) -> dict[str, object]:
    """Penetrations and crossings of each body before and after the solve."""
    figures: dict[str, object] = {}
    for index, body in enumerate(bodies.frame.touching):
        name = body.path if body.surface.has_inside else f"{body.path} (open part)"
        buried = None if bodies.buried is None else bodies.buried[index]
        figures[name] = {
            "before": asdict(_penetration(bodies, index, before, first, buried=None)),
            "after": asdict(_penetration(bodies, index, x, last, buried=buried)),
        }
    return figures


def _penetration(
    bodies: LevelBodies, index: int, x: Tensor, look: ContactState, *, buried: Tensor | None
) -> Penetration:
    crossings = int((look.pierced.body == index).sum()) if look.pierced.count else 0
    if look.inside is None:
        return Penetration(crossings=crossings)
    surface = bodies.frame.touching[index].surface
    return penetration(
        surface,
        bodies.level,
        x + bodies.frame.shifts[index],
        look.inside[index],
        longest=bodies.frame.longest,
        crossings=crossings,
        buried=buried,
        exits=partial(bodies.frame.exits, index) if surface.closed else None,
    )


def swallowed(
    bodies: LevelBodies, x: Float[Tensor, "vertices 3"], inside: Bool[Tensor, "bodies vertices"] | None
) -> list[tuple[float, str]]:
    """Mean depth [m] and body path of each garment that is wholly inside a body, or behind its fixed side, at x [m]."""
    deepest = [(0.0, "")] * len(bodies.level.spans)
    for index, in_body in enumerate(() if inside is None else inside):
        body = bodies.frame.touching[index]
        for garment, span in enumerate(bodies.level.spans):
            if body.surface.has_inside and span.stop > span.start and bool(in_body[span].all()):
                at = x[span] + bodies.frame.shifts[index]
                near = body.surface.closest(at)
                deepest[garment] = max(deepest[garment], (float(near.distance.mean()), body.path))
    return deepest


def penetration_map(surfaces: Sequence[MeshSurface], points: np.ndarray, *, device: str = "cpu") -> np.ndarray:
    """Depth of each vertex in the deepest of some bodies [mm].

    In a closed body the depth is the length of the way out; behind an open surface with a fixed side, the distance.
    Open surfaces whose side comes from the cage have no inside.

    Args:
        surfaces: The posed bodies.
        points: World positions [m], shape (V, 3), float64.
        device: "cpu" or a CUDA device.

    Returns:
        Shape (V,), float32, 0 outside.
    """
    deepest = torch.zeros(len(points), dtype=torch.float64, device=device)
    for surface in surfaces:
        x = torch.as_tensor(points - surface.origin, dtype=torch.float64, device=device)
        if surface.closed:
            depth = depths(surface, x, surface.inside(x), float("inf"))[0]
        else:
            nearest = surface.closest(x)
            depth = torch.where(nearest.is_behind(surface.fixed_side or 0.0), nearest.distance, 0.0)
        deepest = torch.maximum(deepest, depth)
    return (1e3 * deepest).to(torch.float32).cpu().numpy()


def body_crossings(level: Level, surfaces: Sequence[MeshSurface], points: np.ndarray) -> np.ndarray:
    """Mask of the corners of cloth edges and faces that cross a body, shape (V,), bool.

    Args:
        surfaces: The posed bodies.
        points: World positions [m], shape (V, 3), float64.
    """
    if not surfaces or not len(level.triangles):
        return np.zeros(len(points), bool)
    cloth, bodies = len(level.spans), len(surfaces)
    meets = np.zeros((cloth + bodies, cloth + bodies), bool)
    meets[:cloth, cloth:] = meets[cloth:, :cloth] = True
    mesh = ClothMesh(level, meets, np.zeros((0, 2), np.int64), solids=tuple(surface.solid for surface in surfaces))
    x = np.concatenate([points, *(surface.world for surface in surfaces)]) - points.mean(axis=0)
    pierced = all_crossings(mesh.parts, torch.as_tensor(x, device=level.device))[1]
    return mesh.crossed(pierced.crossings).cpu().numpy()
