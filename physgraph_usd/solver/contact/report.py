"""Penetrations and crossings of a frame before and after the solve, as plain values for reports."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..collide.crossings import crossings
from .bodies import LevelBodies
from .cloth import ClothView
from .look import Look
from .measure import Penetration, penetration


def measured(
    view: ClothView, before: Float[Tensor, "vertices 3"], x: Float[Tensor, "vertices 3"]
) -> tuple[dict[str, object], Bool[Tensor, " vertices"]]:
    """Penetrations and crossings before and after, and a mask of the vertices of crossing cloth after.

    Positions that safe moves reached from a start without crossings have none and are not searched again.

    Args:
        view: The finest level's cloth.
        before: The upsampled cage [m].
        x: The result [m].
    """
    first, last = view.at_base if torch.equal(before, view.at_base.x) else view.of_cage(before), view.look(x)
    said: dict[str, object] = {}
    if view.bodies is not None:
        said["bodies"] = _of_bodies(view.bodies, before, first, x, last)
    kept = last.crossings if last.tangles is None else last.tangles.hopeful(last.crossings)
    found = kept if view.given_up is None else crossings(view.parts, x)
    if view.keeps_sides:
        base = first.crossings if view.given_up is None else crossings(view.parts, before)
        crossed = {
            name: {"crossings": each.count, "between_garments": int(np.triu(view.mesh.between(each), 1).sum())}
            for name, each in (("before", base), ("after", found))
        }
        crossed["after"]["given_up"] = found.count - kept.count
        near = bool(view.came_near) or any(each["crossings"] for each in crossed.values())
        said["cloth"] = {"near": near, **crossed}
    return said, view.mesh.crossed(found)


def _of_bodies(bodies: LevelBodies, before: Tensor, first: Look, x: Tensor, last: Look) -> dict[str, object]:
    """Penetrations and crossings of each body before and after the solve."""
    found: dict[str, object] = {}
    for index, each in enumerate(bodies.frame.touching):
        name = each.path if each.surface.closed else f"{each.path} (open part)"
        lost = None if bodies.lost is None else bodies.lost[index]
        found[name] = {
            "before": asdict(_penetration(bodies, index, before, first, lost=None)),
            "after": asdict(_penetration(bodies, index, x, last, lost=lost)),
        }
    return found


def _penetration(bodies: LevelBodies, index: int, x: Tensor, look: Look, *, lost: Tensor | None) -> Penetration:
    inside = torch.zeros_like(bodies.level.free[:, 0]) if look.inside is None else look.inside[index]
    count = 0 if look.pierced is None else int((look.pierced.body == index).sum())
    known = {"longest": bodies.frame.longest, "lost": lost, "crossings": count}
    surface, at = bodies.frame.touching[index].surface, x + bodies.frame.shifts[index]
    return penetration(surface, bodies.level, at, inside, **known)


def swallowed(
    bodies: LevelBodies, x: Float[Tensor, "vertices 3"], inside: Bool[Tensor, "bodies vertices"] | None
) -> list[tuple[float, str]]:
    """Mean depth [m] and body path of each garment that is wholly inside a closed body at x [m]."""
    found = [(0.0, "")] * len(bodies.level.spans)
    for index, own in enumerate(() if inside is None else inside):
        each = bodies.frame.touching[index]
        for place, span in enumerate(bodies.level.spans):
            if each.surface.closed and span.stop > span.start and bool(own[span].all()):
                at = x[span] + bodies.frame.shifts[index]
                near = each.surface.closest(at, torch.full_like(at[:, 0], float("inf")))
                found[place] = max(found[place], (float(near.distance.mean()), each.path))
    return found
