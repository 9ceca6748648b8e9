"""The limits of a level in one frame, from the garments' max distances and backstops."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..contact.cloth import LevelContact
from ..contact.cloth_mesh import RINGS
from ..forces.limit import Limit
from ..level import Level
from ..mesh.stencil import add_at
from ..scene import GarmentFrame
from .level_forces import LevelForces


def limit_of(
    lasting: LevelForces,
    frames: Sequence[GarmentFrame],
    coarse: Float[Tensor, "coarse 3"],
    *,
    outward: Float[Tensor, " garments"],
    view: LevelContact | None,
) -> Limit | None:
    """The limits of a level in one frame; None if no garment has limits.

    Contact has precedence where the subdivided cage crosses something: within `RINGS` rings of its crossings with cloth
    there is no limit, and where it is inside or through a body, distances are from its place moved out of the body.
    Vertices sewn together have the smallest of their limits.

    Args:
        frames: The garments in that frame.
        coarse: The recentred coarse positions [m].
        outward: Sign of each garment's normals.
        view: Contact of the level's cloth in that frame.
    """
    radius, backstop = (_distances(lasting.level, frames, name) for name in ("max_distance", "backstop"))
    if radius is None and backstop is None:
        return None
    level, centre = lasting.level, lasting.level.smooth_base.apply(coarse)
    normal = torch.zeros_like(centre) if backstop is None else _normals(level, centre, outward)
    if view is not None:
        if view.seam is not None:
            centre, normal = view.closed(centre), torch.nn.functional.normalize(view.closed(normal), dim=1)
            radius, backstop = (None if limit is None else view.seam.least(limit) for limit in (radius, backstop))
        state = view.detect(centre)
        if state.crossings.count:
            crossed = view.mesh.grown(view.mesh.crossed(state.crossings), RINGS)[: len(centre)]
            radius, backstop = (
                None if limit is None else torch.where(crossed, torch.inf, limit) for limit in (radius, backstop)
            )
        centre = view.pushed_out(centre, state)
    return Limit(level, lasting.stretch, centre=centre, normal=normal, radius=radius, backstop=backstop)


def _distances(level: Level, frames: Sequence[GarmentFrame], name: str) -> Float[Tensor, " vertices"] | None:
    """Limits of one kind at a level's vertices, infinite for garments without [m]; None if no garment has one."""
    limits = [frame.limits for frame in frames]
    values = [None if limit is None else getattr(limit, name) for limit in limits]
    if all(value is None for value in values):
        return None
    scales = [
        np.zeros(len(frame.points)) if value is None else value * getattr(frame.limits, f"{name}_scale")
        for frame, value in zip(frames, values, strict=True)
    ]
    distances = np.asarray(level.from_coarse @ np.concatenate(scales))
    for value, span in zip(values, level.spans, strict=True):
        distances[span] = np.inf if value is None else distances[span]
    return torch.as_tensor(distances, dtype=level.dtype, device=level.device)


def _normals(
    level: Level, x: Float[Tensor, "vertices 3"], outward: Float[Tensor, " garments"]
) -> Float[Tensor, "vertices 3"]:
    """Outward unit normals at a level's vertices; zero at vertices without faces of some area."""
    areas = level.normals(x).repeat(3, 1)
    total = add_at(torch.zeros_like(x), level.triangles.long().T.reshape(-1), areas)
    signs = outward.to(x)[level.vertex_garment.long()].unsqueeze(1)
    return signs * torch.nn.functional.normalize(total, dim=1, eps=1e-30)
